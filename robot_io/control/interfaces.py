"""Parts that a bridge is made of, as it sees them, its settings and its states; options of a control process."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np

from robot_io.calibrated import Frame
from robot_io.contract import PAPER, Contract
from robot_io.control.observation import HERE, ObservationDelays
from robot_io.control.rally import Box
from robot_io.devices.frame_check import NEEDED


class BridgeState(Enum):
    DISARMED = "disarmed"
    READY = "ready"
    ACTIVE = "active"
    STOPPING = "stopping"
    FAULT = "fault"


class Policy(Protocol):
    """``robot_io.policy.numpy_policy.StreamingPolicy`` or one that computes the same."""

    def reset(self) -> None: ...

    def step(self, observation: np.ndarray) -> np.ndarray: ...


def action_of(policy: Policy, observation: np.ndarray) -> np.ndarray:
    """The policy's answer (n,). Raises ValueError for another shape, and whatever the policy raises."""
    action = np.asarray(policy.step(observation), float)
    joints = observation.shape[0] - 3
    if action.shape != (joints,):
        raise ValueError(f"an action of shape {action.shape}, needed is ({joints},)")
    return action


class Axes(Protocol):
    """``FestoAxes`` or the thread that drives it."""

    def command(self, position: np.ndarray, velocity: np.ndarray, now: float) -> None: ...

    @property
    def homed(self) -> bool: ...

    @property
    def homing(self) -> bool: ...

    def stop(self) -> None: ...

    def preparable(self, now: float) -> bool: ...

    def problem(self, now: float) -> str | None: ...


@dataclass(frozen=True)
class BridgeConfig:
    """Settings of play.

    delays           of the observations
    home             (8,) joint positions to wait at; None: the geometry's
    home_speed       share of the policy's velocity limits on the way home
    home_braking     share of the acceleration limits there
    box              what the policy was trained for; None: no ball is out of distribution
    base             where the robot stands, from where the model has it
    jog              once armed it stays where it is, takes no balls and moves as ``jog`` asks
    overtravel       [m] beyond their range that the linear axes may go while they search their references
    contract         of the robot
    balls_needed     balls that must have shown the tracker's frame before the robot is armed; jogged, it plays none
    """

    delays: ObservationDelays = ObservationDelays()
    home: tuple[float, ...] | None = None
    home_speed: float = 0.5
    home_braking: float = 0.3
    box: Box | None = None
    base: Frame = HERE
    jog: bool = False
    overtravel: float = 0.0
    contract: Contract = PAPER
    balls_needed: int = NEEDED


STANDARD_PLAY = BridgeConfig()


@dataclass(frozen=True)
class ControlOptions:
    """artefact: folder, None: a policy that stands still. contract: of the robot; an artefact's must be the same.

    backend: of ``robot_io.policy.backends``; log_folder and log_name of the MCAP, None: no log.
    box: balls that the policy was trained for; None: nothing is out of distribution
    dry: nothing is sent to arm and axes, which move in thought; jog: no balls are taken, the operator moves the robot
    balls_needed: as of BridgeConfig
    """

    artefact: str | None
    backend: str = "auto"
    log_folder: str | None = None
    log_name: str = "session"
    box: Box | None = None
    metadata: tuple[tuple[str, str], ...] = ()
    attachments: tuple[tuple[str, str | bytes], ...] = ()
    dry: bool = False
    jog: bool = False
    contract: Contract = PAPER
    balls_needed: int = NEEDED
