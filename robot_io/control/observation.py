"""The observation that the policy sees, built from what came over the wire.

The simulator reads every quantity as it was a fixed delay ago, interpolated between the states around that moment; with
the same delays and the same motion this gives the same numbers. On a robot whose feedback is late by itself, the delay
to add is what is missing to the one in training.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within, check_fields
from robot_io.calibrated import Frame
from robot_io.contract import PAPER, Contract
from robot_io.devices.egm.arm_history import ArmHistory
from robot_io.history import History
from robot_io.safety.clearance import RobotGeometry

HERE = Frame()
LONGEST_DELAY = 0.1  # [s]
SPEED_SPAN = 0.04  # [s] of positions that a measured speed goes by
SPEED_SAMPLES = 3  # newest ones that count after a gap, however long it was: no speed would pass for rest


@dataclass(frozen=True)
class ObservationDelays:
    """Age [s] of what the policy sees: of the ball's capture, and of joint feedback since it was received."""

    ball: Annotated[float, Within(0.0, LONGEST_DELAY, "s")] = 0.040
    arm: Annotated[float, Within(0.0, LONGEST_DELAY, "s")] = 0.0
    axes: Annotated[float, Within(0.0, LONGEST_DELAY, "s")] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Feedback:
    """Histories of the three devices: ball (3,), axes (2,) [m], arm (6,) [rad]."""

    ball: History
    axes: History
    arm: ArmHistory


def observe(feedback: Feedback, delays: ObservationDelays, now: float, base: Frame = HERE) -> np.ndarray | None:
    """The observation (11,) at ``now`` in the order of the contract; None while a device has nothing recent to say.

    base  where the robot stands: policies know the ball as it is seen from there
    """
    ball = feedback.ball.at(now - delays.ball)
    axes, arm = feedback.axes.at(now - delays.axes), feedback.arm.at(now - delays.arm)
    return None if ball is None or axes is None or arm is None else np.concatenate([base.inward(ball), axes, arm])


def blade(feedback: Feedback, geometry: RobotGeometry, time: float) -> np.ndarray:
    """The blade's centre (3,) [m] at ``time``, infinite while that is not known."""
    axes, arm = feedback.axes.at(time), feedback.arm.at(time)
    if axes is None or arm is None:
        return np.full(3, np.inf)
    return geometry.middle(geometry.tip, np.concatenate([axes, arm]))


def joints(feedback: Feedback, contract: Contract = PAPER) -> tuple[np.ndarray, np.ndarray]:
    """Newest joint positions and velocities (n,); NaN and zero for what has not reported, zero under three samples."""
    n, axes = contract.n_joints, len(contract.carrying)
    position, velocity = np.full(n, np.nan), np.zeros(n)
    for history, rows in ((feedback.axes, slice(0, axes)), (feedback.arm, slice(axes, n))):
        if history.newest is not None:
            position[rows] = history.newest[1]
            slope = history.slope(SPEED_SPAN, SPEED_SAMPLES)
            if slope is not None:
                velocity[rows] = slope
    return position, velocity
