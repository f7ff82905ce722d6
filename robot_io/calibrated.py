"""Calibrations of one robot, as its robot.yaml holds them and the bridge applies them.

``mjx-tt calibrate`` finds them. An empty date means that a part was never calibrated; it then changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from functools import cached_property

import numpy as np

from robot_io.ranges import check_ranges

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Frame:
    """A frame in another one: position (3) [m] of its origin, rotation vector (3) [rad]."""

    position: Triple = ZERO
    rotation: Triple = ZERO

    @cached_property
    def matrix(self) -> np.ndarray:
        """Rotation (3, 3)."""
        vector = np.array(self.rotation)
        angle = math.sqrt(vector @ vector)
        if not angle:
            return np.eye(3)
        x, y, z = vector / angle
        skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew

    @property
    def neutral(self) -> bool:
        return self.position == ZERO and self.rotation == ZERO

    def outward(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of this frame, in the other one."""
        return points if self.neutral else points @ self.matrix.T + np.array(self.position)

    def inward(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the other frame, in this one."""
        return points if self.neutral else (points - np.array(self.position)) @ self.matrix


@dataclass(frozen=True)
class TrackerCalibration(Frame):
    """The tracker's frame in the table's.

    position, rotation  of the frame: origin [m], rotation vector [rad]
    residual            [m] root mean square distance of the points that were used
    points              how many they were
    date                YYYY-MM-DD, empty: never
    """

    residual: float = 0.0
    points: int = 0
    date: str = ""


@dataclass(frozen=True)
class RobotCalibration:
    """The robot's base in the table's frame, and its joints' zeros.

    base_position   (3) [m] of the base from where the model has it
    base_rotation   (3) [rad] its turn, a rotation vector in the table frame
    joint_zeros     [rad] of the arm's joints, six of the paper's robot, added to what the controller reports
    tip             (3) [m] of the paddle from where the model has it, in the last joint's frame; recorded, not applied:
                    policies know one paddle
    axes_zero       [m] zeros of the linear axes with which it was measured
    residual, points, date  as of the tracker
    """

    base_position: Triple = ZERO
    base_rotation: Triple = ZERO
    joint_zeros: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tip: Triple = ZERO
    axes_zero: tuple[float, ...] = (0.0, 0.0)
    residual: float = 0.0
    points: int = 0
    date: str = ""

    @property
    def base(self) -> Frame:
        return Frame(self.base_position, self.base_rotation)

    def zeros(self, joints: int) -> tuple[float, ...]:
        """``joint_zeros``; as many as the arm has joints where they were never calibrated."""
        return self.joint_zeros if self.date else (0.0,) * joints


@dataclass(frozen=True)
class ClockCalibration:
    """The tracker's clock against the bridge's.

    drift     seconds per second that the bridge's clock gains on the tracker's
    lag       [s] by which joint positions are logged after the ball that they touch; null: not measured
    residual  [s] of the offset, root mean square
    date      as of the tracker
    """

    drift: float = 0.0
    lag: float | None = None
    residual: float = 0.0
    date: str = ""


# Allowed in a calibration; a residual beyond its range says that the points contradict each other.
RANGES = {
    "tracker.position": (-20.0, 20.0),
    "tracker.rotation": (-3.1416, 3.1416),
    "tracker.residual": (0.0, 0.005),
    "tracker.points": (0, 1_000_000),
    "robot.base_position": (-0.03, 0.03),
    "robot.base_rotation": (-0.03, 0.03),
    "robot.joint_zeros": (-0.05, 0.05),
    "robot.tip": (-0.01, 0.01),
    "robot.axes_zero": (-5.0, 5.0),
    "robot.residual": (0.0, 0.004),
    "robot.points": (0, 1_000_000),
    "clock.drift": (-5e-4, 5e-4),
    "clock.lag": (-0.1, 0.2),
    "clock.residual": (0.0, 0.002),
}


@dataclass(frozen=True)
class Calibration:
    """All of one robot."""

    tracker: TrackerCalibration = TrackerCalibration()
    robot: RobotCalibration = RobotCalibration()
    clock: ClockCalibration = ClockCalibration()

    def __post_init__(self) -> None:
        for name in ("tracker", "robot", "clock"):
            when = getattr(self, name).date
            try:
                if when and date.fromisoformat(when).isoformat() != when:
                    raise ValueError
            except ValueError:
                raise ValueError(f"{name}.date is {when!r}, allowed is YYYY-MM-DD or nothing") from None
            if not when and getattr(self, name) != type(getattr(self, name))():
                raise ValueError(f"{name}.date is empty, but {name} was changed; allowed is the day of its measurement")
        check_ranges(self, RANGES)


UNCALIBRATED = Calibration()
