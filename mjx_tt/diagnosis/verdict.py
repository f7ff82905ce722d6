"""Verdict of a diagnosis: plain data, its JSON (docs/reference/verdict.schema.json), and the parts it is made of."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path

from ballmodel.io.atomic_files import replacing
from mjx_tt.sim.randomisation import Randomised, Range, Samples

NOT_ADOPTED = (
    "causes are named beside something that no entry explains, which they may stand for: the extended model does not "
    "hold them"
)


@dataclass(frozen=True)
class Estimate:
    """A parameter of SimModel: nominal, fitted, 90 % interval."""

    nominal: float
    estimate: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Cause:
    """One named cause, and what the data cannot tell from it."""

    name: str
    group: tuple[str, ...]  # the name first, then its equals
    confidence: float  # share of bootstrap draws in which this group is chosen
    parameters: dict[str, Estimate]  # by dotted path of SimModel, of a joint by joint.parameter
    effect_mm: float  # median shift of a flight's last sample; rms movement of a joint [mrad], an axis [mm]
    separating_measurement: str
    share: float = 0.0  # of the nominal model's error that it takes away; 0 for hits


@dataclass(frozen=True)
class Left:
    """What the named causes leave of the flights' error, after each ball's own start and without the noise."""

    mm: float  # root mean square
    share: float  # of the nominal model's mean square
    nominal_mm: float  # root mean square under the nominal model


@dataclass(frozen=True)
class Unexplained:
    """The largest pattern that no entry of the catalogue explains."""

    block: str
    where: str
    direction: str
    size: str


@dataclass(frozen=True)
class Together:
    """Change of one effect where all effects of the ball are fitted at once, named or not."""

    name: str
    change: float
    low: float  # 90 % interval
    high: float
    prior: float  # size that would surprise nobody
    unit: str


@dataclass(frozen=True)
class HeldOut:
    """Prediction of data that the fit did not use."""

    metric: str
    before: float
    after: float
    low: float  # 90 % interval of before - after
    high: float


@dataclass(frozen=True)
class Experiment:
    """One way to learn more."""

    what: str
    separates: tuple[str, ...]
    gain: float  # expected evidence


@dataclass(frozen=True)
class Verdict:
    """The answer."""

    verdict: str
    causes: tuple[Cause, ...]
    unexplained: Unexplained | None
    held_out: HeldOut | None
    not_identifiable: tuple[str, ...]
    not_excited: tuple[str, ...]
    next_experiment: tuple[Experiment, ...]
    runners_up: tuple[dict, ...] = field(default=())
    warnings: tuple[str, ...] = field(default=())
    together: tuple[Together, ...] = field(default=())
    left: Left | None = None

    def to_dict(self) -> dict[str, object]:
        """Plain data; a number that is not finite (a limit that was never reached) is null."""
        return {name: _plain(value) for name, value in asdict(self).items()}

    def save(self, path: Path) -> None:
        """Writes the JSON; to a temporary file first."""
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Expressed:
    """A named cause, and the parameters of the extended model that express it."""

    cause: Cause
    values: dict[str, float]  # by dotted path of SimModel
    ranges: tuple[Range, ...] = ()

    @classmethod
    def by(cls, cause: Cause, parameters: Mapping[str, Estimate]) -> Expressed:
        """A cause by estimates of parameters, which training may draw from their intervals."""
        ranges = tuple(Range(path, e.low, e.high) for path, e in parameters.items())
        return cls(cause, {path: e.estimate for path, e in parameters.items()}, ranges)


@dataclass(frozen=True)
class Part:
    """Contribution of one plant, ball or robot, to the verdict."""

    named: tuple[Expressed, ...] = ()
    beside: dict[str, float] = field(default_factory=dict)  # values fitted beside the named causes
    unexplained: Unexplained | None = None
    held_out: HeldOut | None = None
    not_identifiable: tuple[str, ...] = ()
    not_excited: tuple[str, ...] = ()
    next_experiment: tuple[Experiment, ...] = ()
    runners_up: tuple[dict, ...] = ()
    warnings: tuple[str, ...] = ()
    together: tuple[Together, ...] = ()
    samples: tuple[Samples, ...] = ()  # of what is open in the model, in place of the named causes' ranges
    adopted: bool = False  # the named causes predict unseen data better
    left: Left | None = None


def combined(
    parts: Sequence[Part], notes: Sequence[str] = ()
) -> tuple[Verdict, dict[str, float], tuple[Randomised, ...]]:
    """Verdict of all parts, and values of the extended model with what training may draw around them.

    The verdict has room for one unexplained and one held-out error: that of the first part that has one. A part with
    something unexplained changes the extended model only if its causes were adopted. A part that predicts worse changes
    nothing. notes: warnings that stand before the parts' own.
    """

    def every(name: str) -> tuple:
        return tuple(chain.from_iterable(getattr(part, name) for part in parts))

    named: tuple[Expressed, ...] = every("named")
    unexplained = next((p.unexplained for p in parts if p.unexplained is not None), None)
    held_out = next((p.held_out for p in parts if p.held_out is not None), None)
    worse = bool(named) and held_out is not None and held_out.high < 0.0
    if unexplained is not None:
        kind = "unexplained"
    elif worse:
        # What makes the prediction of unseen balls worse is no cause to act on.
        kind = "undetermined"
    else:
        kind = "named" if named else "none"
    warnings = [*notes, *every("warnings")]
    if any(p.unexplained is not None and p.named and not p.adopted for p in parts):
        warnings.append(NOT_ADOPTED)
    verdict = Verdict(
        kind,
        tuple(n.cause for n in named),
        unexplained,
        held_out,
        every("not_identifiable"),
        every("not_excited"),
        every("next_experiment"),
        every("runners_up"),
        tuple(warnings),
        every("together"),
        next((p.left for p in parts if p.left is not None), None),
    )
    if kind == "undetermined":
        return verdict, {}, ()
    # Beside what no entry explains a name may stand for just that: only what predicts unseen data better is adopted.
    sound = [p for p in parts if p.unexplained is None or p.adopted]
    values = {path: value for p in sound for path, value in p.beside.items()}
    values |= {path: value for p in sound for n in p.named for path, value in n.values.items()}
    samples = tuple(s for p in sound for s in p.samples)
    known = {path for s in samples for path in s.paths}
    ranges = tuple(r for p in sound for n in p.named for r in n.ranges if r.path not in known)
    return verdict, values, (*samples, *ranges)
