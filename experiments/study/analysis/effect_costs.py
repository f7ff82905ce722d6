"""Cost of each hidden effect: a study's policies in its reality with one effect omitted at a time.

Nothing is trained again: a policy from simulation meets a reality that is nearer to what it was trained in, and a
fine-tuned one a reality that lacks something that it may have adapted to.
"""

from __future__ import annotations

import csv
import math
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from ballmodel.io.atomic_files import replacing
from experiments.config.study import EFFECTS
from experiments.errors import ConfigError
from experiments.study.analysis.statistics import Interval, average_over_seeds, exponentiate

FILE = "effects.csv"
MODELS = ("is2r-sim1", "is2r-sim3", "oracle-sim", "is2r-ft100", "s2r-ft100", "oracle-ft")
NOTHING, ALL = "nothing", "all"
WORLDS = (NOTHING, *EFFECTS, ALL)
"""Omitted effects."""


@dataclass(frozen=True)
class Outcome:
    """Rallies of a policy with its own player in a reality without something, those that the table filters left out."""

    seed: int
    player: str
    model: str
    without: str
    rallies: int
    length: float
    """Mean number of paddle touches; NaN without rallies."""


def estimate_gain(outcomes: list[Outcome], model: str, without: str) -> Interval | None:
    """Rally length without an effect over that with all: geometric mean over the players of each seed, then over seeds.

    Student's t on the seeds' logarithms, since the players of a seed share one reality; no interval (NaN) for one seed,
    None where no player and seed have both.
    """
    found = {(o.seed, o.player, o.without): o.length for o in outcomes if o.model == model and o.length > 0.0}
    logs = {
        (seed, player): math.log(length / found[seed, player, NOTHING])
        for (seed, player, world), length in found.items()
        if world == without and (seed, player, NOTHING) in found
    }
    return exponentiate(average_over_seeds(logs)) if logs else None


def write(path: Path, outcomes: list[Outcome]) -> None:
    """One line per outcome."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([f.name for f in fields(Outcome)])
        writer.writerows(map(astuple, outcomes))


def read(path: Path) -> list[Outcome]:
    """Outcomes from the file of ``write``. Raises ConfigError naming file and line."""
    out = []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for number, row in enumerate(csv.DictReader(file), 2):
                try:
                    counts = int(row["rallies"]), float(row["length"])
                    out.append(Outcome(int(row["seed"]), row["player"], row["model"], row["without"], *counts))
                except (KeyError, TypeError, ValueError) as error:
                    wanted = ", ".join(f.name for f in fields(Outcome))
                    raise ConfigError(f"{path}: line {number}: {row}: {error!r}; wanted are {wanted}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: not readable as CSV in UTF-8: {error}") from None
    return out
