"""What a diagnosis says: plain data, and its JSON (docs/reference/verdict.schema.json)."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ballmodel.io.atomic_files import replacing


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
    parameters: dict[str, Estimate]  # by dotted path of SimModel
    effect_mm: float  # median shift of a flight's last sample
    separating_measurement: str


@dataclass(frozen=True)
class Unexplained:
    """What no entry of the catalogue explains."""

    block: str
    where: str
    direction: str
    size: str


@dataclass(frozen=True)
class HeldOut:
    """Prediction of what was not used."""

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

    def to_dict(self) -> dict:
        """Plain data; a number that is not finite (a limit that was never reached) is null."""
        return _plain(asdict(self))

    def save(self, path: Path) -> None:
        """Writes the JSON; to a temporary file first."""
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value):
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
