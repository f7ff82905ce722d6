"""Calibrations of one robot, as its robot.yaml holds them and the bridge applies them.

``mjx-tt calibrate`` finds them. An empty date means that a part was never calibrated; it then changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within, check_fields

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)
# [m] root mean square; a larger residual says that the points contradict each other.
LARGEST_TRACKER_RESIDUAL, LARGEST_ROBOT_RESIDUAL = 0.005, 0.004
TrackerPosition = Annotated[float, Within(-20.0, 20.0, "m")]
Angle = Annotated[float, Within(-3.1416, 3.1416, "rad")]
BaseShift = Annotated[float, Within(-0.03, 0.03, "m")]
BaseTurn = Annotated[float, Within(-0.03, 0.03, "rad")]
TipShift = Annotated[float, Within(-0.01, 0.01, "m")]


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

    position: tuple[TrackerPosition, TrackerPosition, TrackerPosition] = ZERO
    rotation: tuple[Angle, Angle, Angle] = ZERO
    residual: Annotated[float, Within(0.0, LARGEST_TRACKER_RESIDUAL, "m")] = 0.0
    points: Annotated[int, Within(0, 1000000)] = 0
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

    base_position: tuple[BaseShift, BaseShift, BaseShift] = ZERO
    base_rotation: tuple[BaseTurn, BaseTurn, BaseTurn] = ZERO
    joint_zeros: tuple[Annotated[float, Within(-0.05, 0.05, "rad")], ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tip: tuple[TipShift, TipShift, TipShift] = ZERO
    axes_zero: tuple[Annotated[float, Within(-5.0, 5.0, "m")], ...] = (0.0, 0.0)
    residual: Annotated[float, Within(0.0, LARGEST_ROBOT_RESIDUAL, "m")] = 0.0
    points: Annotated[int, Within(0, 1000000)] = 0
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

    drift: Annotated[float, Within(-5e-4, 5e-4)] = 0.0
    lag: Annotated[float, Within(-0.1, 0.2, "s")] | None = None
    residual: Annotated[float, Within(0.0, 0.002, "s")] = 0.0
    date: str = ""


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
                raise ValueError(f"{name}.date: expected YYYY-MM-DD or nothing, got {when!r}") from None
            if not when and getattr(self, name) != type(getattr(self, name))():
                raise ValueError(f"{name}.date: expected the day of the measurement, got nothing; {name} was changed")
        check_fields(self)


UNCALIBRATED = Calibration()
