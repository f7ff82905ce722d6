"""What the logs say about the joints' responses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse


@dataclass(frozen=True)
class RobotCause:
    """One named effect of one joint."""

    name: str  # "joint_2.lag"
    group: tuple[str, ...]  # names that this log cannot tell from it, itself among them
    confidence: float  # that the cause is in the group
    parameters: dict[str, tuple[float, float, float, float, str]]  # nominal, estimate, low, high (90 %), unit
    effect: float  # rms movement that it explains [mrad], a gantry axis [mm]
    separating_measurement: str  # what would tell the members of the group apart; empty for a group of one


@dataclass(frozen=True)
class Undecided:
    """An effect that this log says nothing about."""

    name: str
    why: str


@dataclass(frozen=True)
class RobotGain:
    """Prediction error of positions on windows that the fit did not see; [rad], a gantry axis [m]."""

    joint: str
    before: float  # rms, nominal model
    after: float  # rms, with the named causes
    low: float  # 90 % bootstrap interval over windows of before - after
    high: float


@dataclass(frozen=True)
class JointResidual:
    """What was measured and predicted, (m,) each, [s] and [rad] or [m]; predictions have each window's offset."""

    joint: str
    time: np.ndarray
    measured: np.ndarray
    nominal: np.ndarray
    extended: np.ndarray


@dataclass(frozen=True)
class RobotFindings:
    """What the logs say about the joints' responses."""

    causes: tuple[RobotCause, ...] = ()  # largest effect first
    not_excited: tuple[Undecided, ...] = ()
    not_identifiable: tuple[Undecided, ...] = ()
    unexplained_by_joint: tuple[dict, ...] = ()  # joint, block, where, direction, size [mrad], [mm]; largest first
    held_out: tuple[RobotGain, ...] = ()
    next_experiment: tuple[str, ...] = ()
    residuals: tuple[JointResidual, ...] = ()
    responses: dict[str, JointResponse] = field(default_factory=dict)  # nominal, extended by the named causes

    @property
    def unexplained(self) -> dict | None:
        """The largest residual that no effect of the catalogue explains."""
        return self.unexplained_by_joint[0] if self.unexplained_by_joint else None


def merge(parts: Sequence[RobotFindings]) -> RobotFindings:
    """All of the parts' findings."""

    def every(name: str) -> tuple:
        return tuple(itertools.chain.from_iterable(getattr(part, name) for part in parts))

    return RobotFindings(
        causes=tuple(sorted(every("causes"), key=lambda c: -c.effect)),
        not_excited=every("not_excited"),
        not_identifiable=every("not_identifiable"),
        unexplained_by_joint=tuple(sorted(every("unexplained_by_joint"), key=lambda u: -u["size"])),
        held_out=every("held_out"),
        next_experiment=every("next_experiment"),
        residuals=every("residuals"),
        responses={joint: response for part in parts for joint, response in part.responses.items()},
    )
