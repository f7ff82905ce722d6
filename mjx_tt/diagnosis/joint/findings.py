"""Findings about the joints' responses, joint by joint and merged."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.verdict import Cause


@dataclass(frozen=True)
class Undecided:
    """An effect about which the log holds no evidence."""

    name: str
    why: str


@dataclass(frozen=True)
class JointFinding:
    """A pattern of one joint that no effect of the catalogue explains."""

    joint: str
    block: str
    where: str
    direction: str
    size: float  # [mrad], an axis [mm]


@dataclass(frozen=True)
class JointGain:
    """Prediction error of positions on windows that the fit did not see; [rad], an axis [m]."""

    joint: str
    before: float  # rms, nominal model
    after: float  # rms, with the named causes
    low: float  # 90 % bootstrap interval over windows of before - after
    high: float
    unit: str = "rad"  # or m


@dataclass(frozen=True)
class JointResidual:
    """Measured and predicted positions, [s] and [rad] or [m]; predictions have each window's offset."""

    joint: str
    time: Float[np.ndarray, " m"]
    measured: Float[np.ndarray, " m"]
    nominal: Float[np.ndarray, " m"]
    extended: Float[np.ndarray, " m"]
    unit: str = field(default="rad", kw_only=True)  # or m


@dataclass(frozen=True)
class JointFindings:
    """All that the logs hold about the joints' responses."""

    causes: tuple[Cause, ...] = ()  # largest effect first; effects are rms movements [mrad], an axis [mm]
    not_excited: tuple[Undecided, ...] = ()
    not_identifiable: tuple[Undecided, ...] = ()
    unexplained_by_joint: tuple[JointFinding, ...] = ()  # largest first
    held_out: tuple[JointGain, ...] = ()
    next_experiment: tuple[str, ...] = ()
    residuals: tuple[JointResidual, ...] = ()
    responses: dict[str, JointResponse] = field(default_factory=dict)  # nominal, extended by the named causes

    @property
    def unexplained(self) -> JointFinding | None:
        """The largest residual that no effect of the catalogue explains."""
        return self.unexplained_by_joint[0] if self.unexplained_by_joint else None


def merge(parts: Sequence[JointFindings]) -> JointFindings:
    """All of the parts' findings."""

    def every(name: str) -> tuple:
        return tuple(itertools.chain.from_iterable(getattr(part, name) for part in parts))

    return JointFindings(
        causes=tuple(sorted(every("causes"), key=lambda c: -c.effect_mm)),
        not_excited=every("not_excited"),
        not_identifiable=every("not_identifiable"),
        unexplained_by_joint=tuple(sorted(every("unexplained_by_joint"), key=lambda u: -u.size)),
        held_out=every("held_out"),
        next_experiment=every("next_experiment"),
        residuals=every("residuals"),
        responses={joint: response for part in parts for joint, response in part.responses.items()},
    )
