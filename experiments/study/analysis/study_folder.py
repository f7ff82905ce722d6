"""A study's folder as data: rallies, human models; what is not there is named, not an error."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel import registry
from ballmodel.distribution import AXES, BallDistribution, load_distribution
from ballmodel.io.yaml import read as read_yaml
from experiments.errors import ConfigError, error_context
from experiments.study.analysis import scoring
from experiments.study.analysis.paper import BY_SKILL, CROSS, FINAL, IDENTIFIED, IS2R, METHOD_OF, METHODS, TEN
from experiments.study.analysis.statistics import Models
from experiments.study.paths import EVALUATIONS, SETTINGS, StudyPaths

ROUNDS = ("M0", "M1", "M2")
QUANTITIES = tuple(f"{part} {axis}" for part, axes in AXES.items() for axis in axes)
"""Quantities that a human model bounds: position and velocity at the start, landing point."""


@dataclass
class StudyFolder:
    """Content of a study's folder. Every reader raises ConfigError for a damaged file.

    missing: what the study that its settings ask for would have besides, in words
    """

    folder: Path
    settings: dict[str, Any]
    rallies: scoring.Rallies
    missing: list[str] = field(default_factory=list)

    @property
    def paths(self) -> StudyPaths:
        return StudyPaths(self.folder)

    @cached_property
    def seeds(self) -> tuple[int, ...]:
        """Seeds with evaluations or folders."""
        found = {int(path.name[4:]) for path in self.folder.glob("seed*") if path.name[4:].isdigit()}
        return tuple(sorted(found | set(self.rallies.seed.tolist())))

    @cached_property
    def players(self) -> tuple[str, ...]:
        """Players with evaluations or folders, from the lowest to the highest skill."""
        found = {path.name for path in self.folder.glob("seed*/player*")} | set(self.rallies.trainer.tolist())
        return tuple(p for p in BY_SKILL if p in found)

    def pick(
        self,
        models: Models | None = None,
        trainers: Models | None = None,
        own: bool | None = True,
        selected: bool = True,
    ) -> scoring.Rallies:
        """Rallies that count. own: by the trainer (True), by others (False), both (None); selected: reported ones."""
        r = self.rallies
        where = r.selected if selected else ~r.filtered
        for chosen, column in ((models, r.model), (trainers, r.trainer)):
            if chosen is not None:
                where = where & np.isin(column, [chosen] if isinstance(chosen, str) else list(chosen))
        if own is not None:
            where = where & (r.own == own)
        return r.take(where)

    def models_of(self, seed: int, player: str) -> dict[str, BallDistribution]:
        """The human models that were fitted: of M0, M1, M2 those that are there."""
        found = {}
        for name in ROUNDS:
            path = self.paths.human(seed, player, name)
            if path.exists():
                with error_context(str(path)):
                    found[name] = load_distribution(path)
        return found

    @cached_property
    def realities(self) -> dict[int, Any]:
        """The opened realities by seed."""
        found = {}
        for seed in self.seeds:
            path = self.paths.seed(seed) / "reality.yaml"
            if path.exists():
                with error_context(str(path)):
                    found[seed] = read_yaml(path)
        return found


def numbers(distribution: BallDistribution) -> np.ndarray:
    """(16,) the numbers of a human model: of each of QUANTITIES minimum and maximum."""
    ends = [[v for part in AXES for v in getattr(distribution, f"{part}_{end}")] for end in ("min", "max")]
    return np.array(ends).T.ravel()


def paper_models(player: str) -> dict[str, BallDistribution]:
    """The paper's M0, M1 and M2 of a player."""
    return {name: registry.load(f"{player}/{name}") for name in ROUNDS}


def widths(models: dict[str, BallDistribution]) -> np.ndarray:
    """(16,) the width of each quantity over all given models, the same for its minimum and its maximum."""
    table = np.array([numbers(m) for m in models.values()]).reshape(len(models), -1, 2)
    return np.repeat(table[:, :, 1].max(0) - table[:, :, 0].min(0), 2)


def changes_of(models: dict[str, BallDistribution]) -> tuple[float, float]:
    """Changes M0 to M1 and M1 to M2: mean over the 16 numbers, in units of each quantity's width over the models."""
    scale, (m0, m1, m2) = widths(models), (numbers(models[name]) for name in ROUNDS)
    return float(np.mean(np.abs(m1 - m0) / scale)), float(np.mean(np.abs(m2 - m1) / scale))


def load(folder: Path) -> StudyFolder:
    """Reads a study's folder, whole or partial.

    Raises ConfigError where there is nothing to report on, and for a file that is damaged.
    """
    folder = Path(folder)
    evaluated, asked = folder / EVALUATIONS, folder / SETTINGS
    if not evaluated.exists() and not asked.exists():
        raise ConfigError(f"{folder}: is no study: neither {SETTINGS} nor {EVALUATIONS} is there")
    rallies = scoring.read(evaluated) if evaluated.exists() else scoring.join([])
    known, unknown = _known(rallies)
    settings: dict[str, Any] = {}
    if asked.exists():
        with error_context(str(asked)):
            settings = read_yaml(asked)
            if not isinstance(settings, dict):
                raise ValueError(f"expected a mapping, got {type(settings).__name__}")
    study = StudyFolder(folder, settings, rallies.take(known))
    if not study.players:
        if unknown:
            raise ConfigError(f"{evaluated}: the figures have no place for any of its rallies: {'; '.join(unknown)}")
        raise ConfigError(f"{folder}: nothing to report on yet: there is no player's folder and no rally")
    study.missing = [*(f"a place for rallies with {which}" for which in unknown), *_missing(study)]
    return study


def _missing(study: StudyFolder) -> list[str]:
    """Parts that a study lacks of what its settings ask for, in words; without settings, of the paper's."""
    baselines = study.settings.get("baselines", True)
    models = {True: TEN, False: ()}.get(baselines, METHODS[IS2R])
    if study.settings.get("identification") is not None:
        models += METHODS[IDENTIFIED]
    cross = (study.settings.get("evaluation") or {}).get("cross", True)
    r = study.rallies
    evaluations = list(zip(*(a.tolist() for a in (r.seed, r.trainer, r.evaluator, r.model)), strict=True))
    counted = Counter(dict.fromkeys(evaluations, 0))
    counted.update(key for key, filtered in zip(evaluations, r.filtered.tolist(), strict=True) if not filtered)
    absent = [p for p in BY_SKILL if p not in study.players]
    out = [f"players {', '.join(absent)}"] if absent else []
    for seed, player in ((s, p) for s in study.seeds for p in study.players):
        lacking = {
            "evaluation of": [m for m in models if (seed, player, player, m) not in counted],
            "cross-evaluation by": [
                e for e in CROSS[player] if cross and any((seed, player, e, m) not in counted for m in FINAL)
            ],
            "human model": [m for m in ROUNDS if baselines and m not in study.models_of(seed, player)],
        }
        out += [f"seed {seed}, {player}: {what} {', '.join(names)}" for what, names in lacking.items() if names]
    return out + [
        f"seed {seed}, {trainer} with {evaluator}, {model}: {count} rallies that count of {scoring.POOL}, "
        f"the longest {scoring.count_reported(count)} are reported"
        for (seed, trainer, evaluator, model), count in counted.items()
        if count < scoring.POOL
    ]


def _known(rallies: scoring.Rallies) -> tuple[np.ndarray, list[str]]:
    """Which rallies the figures have a place for, (n,) bool, and in words those for which they have none."""
    where, out = np.ones(len(rallies), bool), []
    for column, known in (("trainer", BY_SKILL), ("evaluator", BY_SKILL), ("model", METHOD_OF)):
        fits = np.isin(getattr(rallies, column), list(known))
        where &= fits
        unknown = sorted(set(getattr(rallies, column)[~fits].tolist()))
        if unknown:
            out.append(f"{column} {', '.join(unknown)} (known are {', '.join(sorted(known))})")
    return where, out
