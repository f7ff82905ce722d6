"""The numbers of the safety gate that are not the joints' limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from ballmodel.io.ranges import Within
from robot_io.contract import JOINT_UNITS, N_JOINTS, Contract

SLACK = 5e-4  # [m] by which margins may be missed between two ticks


def _each(slide: float, hinge: float, units: tuple[str, ...] = JOINT_UNITS) -> tuple[float, ...]:
    return tuple(slide if unit == "m" else hinge for unit in units)


# Of a slide [m] and of a hinge [rad].
_OVERSHOOT, _STILL, _FOLLOWING_ERROR = (0.03, 0.09), (0.02, 0.05), (0.06, 0.2)
_DRIVE_DELAY = (0.0645, 0.071)  # [s], the paper's
_SILENCE = (0.05, 0.1)  # [s], the lead of an axis's target and the shipped RAPID's CommTimeout


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of the gate; lengths in m, angles in rad, times in s, tuples in the order of the robot's joints.

    The defaults are the paper's robot's; ``of`` has those of another one.

    speed_scale      (0, 1], share of every requested velocity and of every velocity limit
    head_room        (0, 1], share of the drives' highest speeds that is commanded: the rest is for their corrections
    table_margin     smallest gap of arm and paddle to the table and to everything under it
    self_margin      smallest gap of the watched pairs of the robot's own parts
    floor_margin     smallest gap of arm and paddle to the floor; the rails of the gantry end 0.15 m above it
    blade_speed      [m/s] of the blade's centre, and blade_acceleration [m/s^2], each as a mean over a control period
                     and also while braking; what would be more is braked as far as needed
    overshoot        (8,) by which a drive may run beyond its reference; kept from the ends of the range where it is
                     more than the limiter's margin
    escape_speed     share of the velocity limits while a gap is smaller than its margin
    still            measured speed (8,) above which the robot counts as moving and is not armed
    overspeed        ratio of measured speed to its limit above which there is a fault; ``monitor.UNSCALED`` is added to
                     a scaled limit
    following_error  distance (8,) of a measured position from everywhere the reference was in the last ``delay``
    drive_delay      (8,) time from a command to the motion that it makes, lag included
    drive_delay_error  by which the delay of the arm and that of the linear axes may be wrong, each
    feedback_delay   longest time from a motion to its measurement here
    following_ticks  commands in a row after which a following error is a fault
    late             longest time between two commands; more is a fault. The robot may continue with the last command
                     for this long: this path and the braking after it are proven clear
    silence          (8,) [s] for which each device goes on with its last command where none follows: the lead of a
                     linear axis's target, CommTimeout of the arm's controller. What it leads to touches nothing
    stale_*          longest age of what was last heard of a device, and of the policy's request; the tracker's is over
                     four frames: more would leave no time to stop within 0.15 s behind the arm's dead time
    """

    speed_scale: Annotated[float, Within(0.001, 1.0)] = 1.0
    head_room: Annotated[float, Within(0.5, 1.0)] = 0.9
    table_margin: Annotated[float, Within(0.01, 0.5, "m")] = 0.02
    self_margin: Annotated[float, Within(0.01, 0.5, "m")] = 0.02
    floor_margin: Annotated[float, Within(0.15, 0.7, "m")] = 0.17
    blade_speed: Annotated[float, Within(0.05, 10.0, "m/s")] = 8.0
    blade_acceleration: Annotated[float, Within(1.0, 180.0, "m/s^2")] = 150.0
    overshoot: tuple[Annotated[float, Within(0.005, 0.2)], ...] = _each(*_OVERSHOOT)
    escape_speed: Annotated[float, Within(0.001, 0.1)] = 0.05
    still: tuple[Annotated[float, Within(0.001, 0.1)], ...] = _each(*_STILL)
    overspeed: Annotated[float, Within(1.05, 2.0)] = 1.5
    following_error: tuple[Annotated[float, Within(0.005, 0.4)], ...] = _each(*_FOLLOWING_ERROR)
    drive_delay: tuple[Annotated[float, Within(0.0, 0.3, "s")], ...] = _each(*_DRIVE_DELAY)
    drive_delay_error: Annotated[float, Within(0.0, 0.05, "s")] = 0.017
    feedback_delay: Annotated[float, Within(0.004, 0.1, "s")] = 0.05
    following_ticks: Annotated[int, Within(1, 6)] = 3
    silence: tuple[Annotated[float, Within(0.004, 10.0, "s")], ...] = _each(*_SILENCE)
    late: Annotated[float, Within(0.02, 0.1, "s")] = 0.03
    stale_arm: Annotated[float, Within(0.01, 0.1, "s")] = 0.05
    stale_axes: Annotated[float, Within(0.01, 0.1, "s")] = 0.05
    stale_tracker: Annotated[float, Within(0.01, 0.05, "s")] = 0.035
    stale_policy: Annotated[float, Within(0.02, 0.1, "s")] = 0.05

    @classmethod
    def of(cls, contract: Contract) -> SafetyConfig:
        """The defaults for a contract's robot."""
        names, pairs = (
            ("overshoot", "still", "following_error", "drive_delay", "silence"),
            (_OVERSHOOT, _STILL, _FOLLOWING_ERROR, _DRIVE_DELAY, _SILENCE),
        )
        values: dict[str, Any] = {n: _each(*pair, contract.units) for n, pair in zip(names, pairs, strict=True)}
        return cls(**values)

    def __post_init__(self) -> None:
        for name in ("speed_scale", "head_room", "escape_speed"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected more than 0 and at most 1, got {getattr(self, name)}")
        for name in ("table_margin", "self_margin", "floor_margin"):
            if not SLACK < getattr(self, name) < 1.0:
                raise ValueError(f"{name}: expected {SLACK} to 1 m, got {getattr(self, name)}")
        ages = ("stale_arm", "stale_axes", "stale_tracker", "stale_policy")
        for name in ("blade_speed", "blade_acceleration", "overspeed", "late", "following_ticks", *ages):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: expected a positive, finite number, got {getattr(self, name)}")
        each = {
            name: getattr(self, name) for name in ("still", "overshoot", "following_error", "drive_delay", "silence")
        }
        lengths = {len(values) for values in each.values()}
        count = N_JOINTS if N_JOINTS in lengths else min(lengths)
        for name, values in each.items():
            if len(values) != count or not all(0.0 < v < math.inf for v in values):
                raise ValueError(f"{name}: expected {count} positive numbers, got {values}")
        if not 0.0 <= self.drive_delay_error < math.inf:
            raise ValueError(f"drive_delay_error: expected 0 s or more, got {self.drive_delay_error}")
        if not 0.0 < self.feedback_delay < math.inf:
            raise ValueError(f"feedback_delay: expected a positive, finite time [s], got {self.feedback_delay}")

    @property
    def delay(self) -> float:
        """Longest time [s] from a command to the measurement of its effect."""
        return max(self.drive_delay) + self.drive_delay_error + self.feedback_delay
