"""Means, differences and ratios of rally lengths with 95 % intervals, and normalised rally lengths.

The bootstrap draws rallies anew within each policy, and the
study's repetitions (seeds) as well, so that its interval holds for a policy that is trained again; players are always
the same ones. Of fewer than FEWEST_SEEDS seeds it would draw a handful of points, which are no 95 %: there it draws
rallies alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas
from numpy.typing import ArrayLike

from experiments.stats import t_interval
from experiments.study.analysis.scoring import Rallies, count_reported

DRAWS = 2000
FEWEST_SEEDS = 5  # drawn anew: 4 of 5 give 70 different means, 1 of 2 give two
CELL = ["seed", "trainer", "evaluator", "model"]
Cell = tuple[int, str, str, str]
Models = str | Iterable[str]  # one or several


def name_chance(seeds: int) -> str:
    """Name of what the bootstrap draws anew in a study of so many seeds."""
    return "seeds and rallies" if seeds >= FEWEST_SEEDS else "rallies"


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval; ``n`` of what it is the mean of; over: what the interval takes as independent,
    where that is not what the study's other intervals do."""

    value: float
    low: float
    high: float
    n: int = 0
    over: str = ""


def exponentiate(logs: Interval) -> Interval:
    """A mean of logarithms as a geometric mean."""
    with np.errstate(over="ignore"):
        value, low, high = np.exp([logs.value, logs.low, logs.high]).tolist()
    return Interval(value, low, high, logs.n, logs.over)


@dataclass(frozen=True)
class Estimate:
    """A number and what the bootstrap makes of it, (B,); draws of one Bootstrap belong together.

    larger: of a ratio or a difference, the larger of the two numbers that were compared
    """

    value: float
    draws: np.ndarray
    n: int = 0
    larger: float = np.inf

    @property
    def interval(self) -> Interval:
        """Percentiles 2.5 and 97.5 of the draws."""
        low, high = np.percentile(self.draws, (2.5, 97.5))
        return Interval(self.value, float(low), float(high), self.n)

    def __sub__(self, other: Estimate) -> Estimate:
        larger = max(self.value, other.value)
        return Estimate(self.value - other.value, self.draws - other.draws, self.n, larger)

    def __truediv__(self, other: Estimate) -> Estimate:
        with np.errstate(divide="ignore", invalid="ignore"):
            draws = np.nan_to_num(self.draws / other.draws, nan=np.inf)
        value = self.value / other.value if other.value else float("inf")
        return Estimate(value, draws, self.n, max(self.value, other.value))


class Bootstrap:
    """Means over cells (one seed's policy with one evaluator) whose rallies, and the seeds, are drawn anew.

    ``longest``: means of the rallies that are reported. The pool of each evaluation is drawn anew, and of each draw the
    longest are selected, since to draw from the selected ones alone takes the selection for granted.

    With S seeds, FEWEST_SEEDS at least, S - 1 of them are drawn with replacement: the spread of the draws is then an
    unbiased estimate of the spread of a mean over S seeds (Rao and Wu 1988), which drawing S makes too small by
    (S - 1) / S.
    """

    def __init__(
        self,
        rallies: Rallies,
        values: np.ndarray | None = None,
        draws: int = DRAWS,
        key: int = 0,
        longest: bool = False,
    ) -> None:
        """rallies: that count; values: (n,) of each rally, its length by default."""
        values = np.asarray(rallies.length if values is None else values, float)
        rng = np.random.default_rng(key)
        reported = rallies.selected if longest else np.ones(len(rallies), bool)
        self.cells = group_by_cell(rallies.take(reported), values[reported])
        pooled = rallies.pooled if longest else reported
        order = np.flatnonzero(pooled)[np.argsort(-rallies.length[pooled], kind="stable")]  # the longest first
        drawn = {
            cell: _means(v, count_reported(v.size) if longest else v.size, draws, rng)
            for cell, v in group_by_cell(rallies.take(order), values[order]).items()
        }
        # A row for each cell: its mean, then the draws of it.
        rows = [np.append(self.cells[cell].mean(), means) for cell, means in drawn.items()]
        index = pandas.MultiIndex.from_tuples(drawn, names=CELL) if drawn else None
        self._table = pandas.DataFrame(rows, index)
        # Which seeds each draw takes, by how many there are: the same for all means, so that their differences pair.
        seeds = len({cell[0] for cell in self.cells})
        self._chosen = {s: rng.integers(0, s, (s - 1, draws)) for s in range(FEWEST_SEEDS, seeds + 1)}

    def mean(self, models: Models, trainers: Iterable[str], own: bool | None = True) -> Estimate | None:
        """Mean over the models' cells of a trainer, then over trainers, then over seeds; None where there is no cell.

        own: evaluated by the trainer (True), by others (False) or by anybody (None).
        """
        found = self._find(models, trainers, own)
        return self._mean(found) if found else None

    def evaluated(self, model: str, trainer: str, evaluator: str) -> Estimate | None:
        """Mean of one trainer's policy with one evaluator over the seeds; None where it was not evaluated."""
        found = [cell for cell in self.cells if cell[1:] == (trainer, evaluator, model)]
        return self._mean(found) if found else None

    def pair(
        self, a: Models, b: Models, trainers: Iterable[str], own: bool = True, own_b: bool | None = None
    ) -> tuple[Estimate, Estimate] | None:
        """The means of two (sets of) models over the trainers and seeds that have both; own_b: like own by default."""
        found = self._find(a, trainers, own), self._find(b, trainers, own if own_b is None else own_b)
        both = {cell[:2] for cell in found[0]} & {cell[:2] for cell in found[1]}
        if not both:
            return None
        first, second = (self._mean([cell for cell in side if cell[:2] in both]) for side in found)
        return first, second

    def pooled(self, model: str, trainers: Iterable[str]) -> np.ndarray:
        """(n,) the values of a model with its own trainers."""
        found = [self.cells[cell] for cell in self._find(model, trainers, True)]
        return np.concatenate(found) if found else np.zeros(0)

    def _find(self, models: Models, trainers: Iterable[str], own: bool | None) -> list[Cell]:
        models, trainers = (models,) if isinstance(models, str) else tuple(models), tuple(trainers)
        chosen = (cell for cell in self.cells if cell[3] in models and cell[1] in trainers)
        return [cell for cell in chosen if own is None or (cell[1] == cell[2]) == own]

    def _mean(self, found: list[Cell]) -> Estimate:
        """Mean over the cells (at least one) of a trainer, then over trainers, then over seeds."""
        by_seed = self._table.loc[found].groupby(level=["seed", "trainer"]).mean().groupby(level="seed").mean()
        points, draws = by_seed.iloc[:, 0].to_numpy(), by_seed.iloc[:, 1:].to_numpy()
        chosen = self._chosen.get(len(draws))
        drawn = draws.mean(axis=0) if chosen is None else np.take_along_axis(draws, chosen, axis=0).mean(axis=0)
        return Estimate(float(points.mean()), drawn, sum(self.cells[cell].size for cell in found))


def _means(values: np.ndarray, first: int, draws: int, rng: np.random.Generator) -> np.ndarray:
    """(draws,) means of the ``first`` of values drawn with replacement and put in the order that they had."""
    drawn = rng.integers(0, values.size, (draws, values.size))
    if first < values.size:
        drawn = np.sort(drawn, axis=1)[:, :first]
    return values[drawn].mean(axis=1)


def group_by_cell(rallies: Rallies, values: np.ndarray) -> dict[Cell, np.ndarray]:
    """The values by seed, trainer, evaluator and model."""
    keys = [getattr(rallies, name) for name in CELL]
    return {cell: group.to_numpy() for cell, group in pandas.Series(values).groupby(keys, sort=False)}


def normalise_by_player(rallies: Rallies) -> np.ndarray:
    """(n,) (length - mean) / std, both over the reported own evaluations of the trainer in that seed (Normalization,
    Evaluations).

    ``rallies``: own evaluations of the ten models. NaN where all lengths of a player are equal.
    """
    return _standardise(rallies, ("seed", "trainer"), rallies.selected)


def normalise_by_model(rallies: Rallies) -> np.ndarray:
    """(n,) (length - mean) / std, both over what is reported of the trainer's own evaluation of that model
    (Normalization, Cross-Evaluations).

    ``rallies``: own and cross-evaluations; NaN where the trainer did not evaluate the model.
    """
    return _standardise(rallies, ("seed", "trainer", "model"), rallies.selected & rallies.own)


def _standardise(rallies: Rallies, group: Sequence[str], reference: np.ndarray) -> np.ndarray:
    """(n,) lengths standardised by the reference rallies, (n,) bool, of their group."""
    length, keys = pandas.Series(rallies.length.astype(float)), [getattr(rallies, name) for name in group]
    base = length.where(reference).groupby(keys)
    spread = base.transform("std")
    return ((length - base.transform("mean")) / spread.where(spread > 0.0)).to_numpy()


def average_over_seeds(values: Mapping[tuple[int, str], float]) -> Interval:
    """Mean of values by seed and player: over the players of each seed, then over seeds, with Student's t over seeds.

    The players of a seed share one hidden reality. Without an interval (NaN) where there is one seed only.
    """
    by_seed: dict[int, list[float]] = {}
    for (seed, _), value in values.items():
        by_seed.setdefault(seed, []).append(value)
    means = [float(np.mean(found)) for found in by_seed.values()]
    if len(means) < 2:
        return Interval(means[0], np.nan, np.nan, len(means))
    return Interval(*t_interval(means), len(means))


def t_mean(values: ArrayLike) -> Interval:
    """Mean with Student's t interval; without an interval where there are fewer than two values."""
    values = np.asarray(values, float)
    if values.size < 2:
        return Interval(float(values.mean()) if values.size else float("nan"), -np.inf, np.inf, values.size)
    return Interval(*t_interval(values), values.size)
