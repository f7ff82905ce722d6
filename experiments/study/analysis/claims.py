"""The paper's claims measured in a study and judged by rules, the same for every claim and fixed before the data.

more, less      the paper says that a quantity is above or below what "no difference" would give
                agrees: the whole interval is on the paper's side and holds the paper's number, if it states one
                agrees in direction: the whole interval is on the paper's side, its number is not in it
                differs: the whole interval is on the other side; or it holds "no difference" but not the paper's number
                undecided: the interval holds "no difference"
alike           the paper says that two things do not differ
                agrees: the interval holds "no difference" and spans less than a factor of WIDEST
                differs: it does not hold it;  undecided: it holds it, but is wider
number          agrees: the interval holds the paper's number;  differs: it does not
                undecided: it holds it, but spans more than a factor of WIDEST
not comparable  the study lacks what the claim is about; or the paper makes no statement that could be right or wrong;
                or two policies are compared whose rallies are both shorter than PLAYS on average: they hardly return a
                ball

"No difference" is a ratio of one, a difference of zero, and of a share, one half.

Intervals are 95 % bootstrap intervals over seeds and rallies (``study_statistics``) unless a measure says otherwise.
Those of the human models' changes are Student's t over seeds, or over the players of a single seed: the reason says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ballmodel import constants as c
from ballmodel.distribution import BallDistribution
from experiments.stats import welch_interval
from experiments.study.analysis.paper import CLAIMS, FINAL, GROUPS, TEN, WITHOUT, Claim, of_level
from experiments.study.analysis.scoring import Rallies
from experiments.study.analysis.statistics import (
    DRAWS,
    Bootstrap,
    Difference,
    Estimate,
    Interval,
    Models,
    difference,
    exponential,
    normalised_by_model,
    normalised_by_player,
    t_mean,
    t_over_seeds,
)
from experiments.study.analysis.study_folder import BallLog, Study, change, paper_models, widths
from mjx_tt.rally.end_reasons import End

WIDEST = 4.0  # of an interval of a ratio that still tells "alike": from half to double
PLAYS = 2.0  # touches; the shortest rally in the paper's table of player skill
LARGEST = 1e4  # number that is printed as one
ONE_SEED = "the players of one seed alone, who share its reality"
SHORT = 5  # touches; the paper's "shorter" rallies
AGREES, DIRECTION, DIFFERS, UNDECIDED, NOT_COMPARABLE = (
    "agrees",
    "agrees in direction",
    "differs",
    "undecided",
    "not comparable",
)
VERDICTS = (AGREES, DIRECTION, DIFFERS, UNDECIDED, NOT_COMPARABLE)
RATIO, DIFFERENCE, SHARE, HITS = "ratio", "difference", "share", "hits"
NULL = {RATIO: 1.0, DIFFERENCE: 0.0, SHARE: 0.5}
IS2R, S2R, ORACLE = FINAL


@dataclass(frozen=True)
class Finding:
    """A claim, what was measured, and the verdict; interval is None where nothing could be measured.

    paper: the paper's number: one that its text states, or one that follows from its table of ball distributions
    """

    claim: Claim
    unit: str
    interval: Interval | None
    verdict: str
    why: str
    paper: float | None


def judge(kind: str, unit: str, interval: Interval, paper: float | None) -> tuple[str, str]:
    """Verdict and its reason by the rules of this module."""
    low, high = interval.low, interval.high
    where = f"the interval {span(unit, interval)}"
    holds = paper is not None and low <= paper <= high
    if kind == "number":
        if holds and high > WIDEST * low:
            return UNDECIDED, f"{where} holds the paper's number, but is too wide to tell"
        return (AGREES if holds else DIFFERS), f"{where} {'holds' if holds else 'does not hold'} the paper's number"
    null = NULL[unit]
    inside = low <= null <= high
    if kind == "alike":
        if not inside:
            return DIFFERS, f"{where} excludes no difference"
        if unit == RATIO and high > WIDEST * low:
            return UNDECIDED, f"{where} is too wide to call it the same"
        return AGREES, f"{where} holds no difference"
    if inside:
        if paper is not None and not holds:
            return DIFFERS, f"{where} holds no difference, but not the paper's number"
        return UNDECIDED, f"{where} allows both"
    if (low > null) != (kind == "more"):
        return DIFFERS, f"{where} lies on the other side"
    if paper is None:
        return AGREES, f"{where} lies on the paper's side"
    if holds:
        return AGREES, f"{where} holds the paper's number"
    return DIRECTION, f"{where} lies on the paper's side, its number outside"


def show(unit: str, value: float) -> str:
    """A number as the report prints it."""
    if not abs(value) < LARGEST:
        return "∞" if value > 0 else "-∞"
    if unit == RATIO:
        return f"{value:.2f}"
    if unit == SHARE:
        return f"{100 * value:.0f} %"
    return f"{value:+.2f}" if unit == DIFFERENCE else f"{value:.1f}"


def span(unit: str, interval: Interval) -> str:
    """An interval as the report prints it."""
    return f"{show(unit, interval.low)} to {show(unit, interval.high)}"


class Measurements:
    """Everything that is measured on a study's rallies and human models; bootstraps are made once."""

    def __init__(self, study: Study, over_seeds: bool = True) -> None:
        self.study, self.over_seeds = study, over_seeds

    @cached_property
    def raw(self) -> Bootstrap:
        """Rally lengths that the paper reports, own and cross-evaluations."""
        return Bootstrap(self.study.pick(own=None, selected=False), over_seeds=self.over_seeds, longest=True)

    @cached_property
    def unselected(self) -> Bootstrap:
        """Lengths of all rallies that are not filtered."""
        return Bootstrap(self.study.pick(own=None, selected=False), over_seeds=self.over_seeds)

    @cached_property
    def normalised(self) -> Bootstrap:
        """Own evaluations of the ten models, normalised by player."""
        rallies = self.study.pick(TEN, selected=False)
        return _finite(rallies, normalised_by_player(rallies), self.over_seeds)

    @cached_property
    def cross_normalised(self) -> Bootstrap:
        """Own and cross-evaluations of the final models, normalised by the trainer's own evaluation of the model."""
        rallies = self.study.pick(FINAL, own=None, selected=False)
        return _finite(rallies, normalised_by_model(rallies), self.over_seeds)

    def ratio(
        self,
        a: Models,
        b: Models,
        group: str,
        own: bool = True,
        own_b: bool | None = None,
        boot: Bootstrap | None = None,
    ) -> Estimate | None:
        """Mean of a over mean of b, over the players of a group that have both."""
        pair = (boot or self.raw).pair(a, b, of_level(group), own, own_b)
        return pair and pair[0] / pair[1]

    def minus(self, boot: Bootstrap, a: str, b: str, group: str, own: bool = True) -> Estimate | None:
        """Mean of a minus mean of b, over the players of a group that have both; ``larger`` is of the rally lengths."""
        pair, lengths = (x.pair(a, b, of_level(group), own) for x in (boot, self.raw))
        if pair is None or lengths is None:
            return None
        return replace(pair[0] - pair[1], larger=max(e.value for e in lengths))

    def short(self) -> Estimate | None:
        """Share of rallies below SHORT, S2R+FT minus i-S2R."""
        rallies = self.study.pick(FINAL, selected=False)
        boot = Bootstrap(rallies, rallies.length < SHORT, self.over_seeds, longest=True)
        return self.minus(boot, S2R, IS2R, "all")

    def longer(self) -> Estimate | None:
        """Share of players whose rallies are longer under i-S2R than under S2R+FT."""
        ratios = [r for p in self.study.players if (r := self.raw.pair(IS2R, S2R, (p,)))]
        if not ratios:
            return None
        more = [(a.value > b.value, a.draws > b.draws) for a, b in ratios]
        larger = max(e.value for pair in ratios for e in pair)
        return Estimate(float(np.mean([v for v, _ in more])), np.mean([d for _, d in more], axis=0), len(more), larger)

    def robot_ends(self) -> Estimate | None:
        """Share of counted rallies that the robot ended, by a mistake or by a return that the human could not continue.

        The ten models with their own trainers.
        """
        rallies = self.study.pick(TEN, selected=False)
        rallies = rallies.take(rallies.end != End.NONE)
        ended = (rallies.robot_ended == 1) | np.isin(rallies.end, (End.ROBOT_GRAZES_NET, End.ROBOT_CORNER))
        return Bootstrap(rallies, ended, self.over_seeds).mean(TEN, of_level("all"))

    def over(self) -> Estimate | None:
        """Of the balls that were not returned, the share hit over the human's end line, the advanced player's i-S2R."""

        def chosen(log: BallLog) -> tuple[np.ndarray, np.ndarray]:
            with np.errstate(invalid="ignore"):
                far = log.hit.astype(bool) & (log.return_landing[1] > c.TABLE_LENGTH / 2)
            return far, np.isfinite(log.landing).all(axis=0) & ~log.returned.astype(bool)

        return self._of_balls(of_level("advanced"), chosen)

    def middle(self, outgoing: bool) -> Estimate | None:
        """Share of the balls that bounce in the middle ninth of the robot's half, player 3's i-S2R.

        outgoing: only of the balls that the robot touched.
        """

        def chosen(log: BallLog) -> tuple[np.ndarray, np.ndarray]:
            x, y = log.landing
            inside = (np.abs(x) <= c.TABLE_WIDTH / 6) & (np.abs(y + c.TABLE_LENGTH / 4) <= c.TABLE_LENGTH / 12)
            return inside, np.isfinite(x) & np.isfinite(y) & (log.hit.astype(bool) | (not outgoing))

        return self._of_balls(("player3",), chosen)

    def _of_balls(
        self, trainers: Iterable[str], chosen: Callable[[BallLog], tuple[np.ndarray, np.ndarray]]
    ) -> Estimate | None:
        """A share of the balls of i-S2R's own evaluations, all seeds together; whole rallies are drawn anew.

        chosen: of a log, which balls are in the share, and which are counted at all, both (n,) bool.
        """
        tables = []
        for log in (log for trainer in trainers for log in self.study.logs(trainer, IS2R)):
            inside, counted = chosen(log)
            _, rally = np.unique(log.rally, return_inverse=True)
            tables.append(np.array([np.bincount(rally, inside & counted), np.bincount(rally, counted)]))
        table = np.concatenate(tables, axis=1) if tables else np.zeros((2, 0))
        if not table[1].sum():
            return None
        drawn = table[:, np.random.default_rng(0).integers(0, table.shape[1], (DRAWS, table.shape[1]))].sum(axis=2)
        share = float(table[0].sum() / table[1].sum())
        return Estimate(share, drawn[0] / np.maximum(drawn[1], 1), int(table[1].sum()))

    @cached_property
    def changes(self) -> dict[tuple[int, str], tuple[float, float]]:
        """Changes M0 to M1 and M1 to M2 by seed and player: mean over the 16 numbers, each in units of its quantity's
        width over the three models."""
        out: dict[tuple[int, str], tuple[float, float]] = {}
        for seed in self.study.seeds:
            for player in self.study.players:
                models = self.study.models_of(seed, player)
                if len(models) == 3:
                    out[seed, player] = _changes(models)
        return out

    def model_change(self) -> Interval | None:
        """Geometric mean over players and seeds of the second change over the first; t over seeds, else players."""
        logs = {at: float(np.log(b / a)) for at, (a, b) in self.changes.items() if a > 0 and b > 0}
        if len(logs) < 2:
            return None
        found = t_over_seeds(logs)
        return exponential(found if found.n > 1 else replace(t_mean([*logs.values()]), over=ONE_SEED))

    def change_levels(self) -> Interval | None:
        """Second change of beginners over that of intermediate players, geometric means.

        Student's t over seeds; of one seed Welch's interval over players.
        """
        found: dict[int, tuple[list[float], list[float]]] = {}
        for (seed, player), (_, b) in self.changes.items():
            for k, level in enumerate(("beginner", "intermediate")):
                if player in of_level(level) and b > 0:
                    found.setdefault(seed, ([], []))[k].append(float(np.log(b)))
        both = {seed: logs for seed, logs in found.items() if all(logs)}
        if len(both) > 1:
            means = {(seed, ""): float(np.mean(low) - np.mean(high)) for seed, (low, high) in both.items()}
            return exponential(t_over_seeds(means))
        low, high = next(iter(both.values()), ([], []))
        if min(len(low), len(high)) < 2:
            return None
        return exponential(Interval(*welch_interval(high, low), len(low) + len(high), ONE_SEED))

    def differences(self) -> list[tuple[str, str, str, str, Difference]]:
        """Every pair of final models in every group, raw and normalised: group, scale, a, b, difference."""
        out = []
        for group in GROUPS:
            for scale, boot in (("raw", self.raw), ("normalised", self.normalised)):
                for a, b in ((IS2R, S2R), (IS2R, ORACLE), (ORACLE, S2R)):
                    found = difference(boot, a, b, of_level(group))
                    if found is not None:
                        out.append((group, scale, a, b, found))
        return out


Measure = Callable[[Measurements], Estimate | Interval | None]


def paper_changes(player: str) -> tuple[float, float]:
    """The paper's changes M0 to M1 and M1 to M2 of a player, from its table ball_dist."""
    return _changes(paper_models(player))


def findings(m: Measurements) -> list[Finding]:
    """All claims, in the paper's order, measured and judged."""
    out = []
    for claim in CLAIMS:
        kind, unit, measure = _MEASURES[claim.key]
        found = measure(m)
        interval = found.interval if isinstance(found, Estimate) else found
        larger = found.larger if isinstance(found, Estimate) else np.inf
        if interval is None or not np.isfinite(interval.value):
            interval, verdict, why = None, NOT_COMPARABLE, "the study lacks what this needs"
        elif larger < PLAYS:
            verdict, why = NOT_COMPARABLE, f"both rally lengths are below {PLAYS:g}: neither policy returns balls"
        elif kind == "open":
            verdict, why = NOT_COMPARABLE, "the paper leaves it open; this is our answer"
        else:
            verdict, why = judge(kind, unit, interval, claim.value)
            why += f"; it is over {interval.over}" if interval.over else ""
        out.append(Finding(claim, unit, interval, verdict, why, _paper(claim)))
    return out


def _paper(claim: Claim) -> float | None:
    """The number to show as the paper's; those of the human models follow from its table."""
    if claim.key == "model-change":
        return float(np.exp(np.mean([np.log(b / a) for a, b in map(paper_changes, of_level("all"))])))
    if claim.key == "change-levels":
        low, high = (np.mean([np.log(paper_changes(p)[1]) for p in of_level(g)]) for g in ("beginner", "intermediate"))
        return float(np.exp(low - high))
    return claim.value


def _ratio(a: str, b: str, group: str, own: bool = True) -> Measure:
    return lambda m: m.ratio(a, b, group, own)


def _keeps(models: Models, group: str = "all") -> Measure:
    return lambda m: m.ratio(models, models, group, False, True)


def _normalised(a: str, b: str, group: str) -> Measure:
    return lambda m: m.minus(m.normalised, a, b, group)


_MEASURES: dict[str, tuple[str, str, Measure]] = {
    "all-ratio": ("more", RATIO, _ratio(IS2R, S2R, "all")),
    "all-raw": ("alike", RATIO, _ratio(IS2R, S2R, "all")),
    "all-normalised": ("more", DIFFERENCE, _normalised(IS2R, S2R, "all")),
    "all-oracle": ("more", DIFFERENCE, _normalised(ORACLE, S2R, "all")),
    "short": ("more", DIFFERENCE, lambda m: m.short()),
    "beginner": ("more", RATIO, _ratio(IS2R, S2R, "beginner")),
    "intermediate": ("more", RATIO, _ratio(IS2R, S2R, "intermediate")),
    "advanced": ("less", RATIO, _ratio(IS2R, S2R, "advanced")),
    "players": ("number", SHARE, lambda m: m.longer()),
    "without-raw": ("more", RATIO, _ratio(IS2R, S2R, WITHOUT)),
    "without-normalised": ("more", DIFFERENCE, _normalised(IS2R, S2R, WITHOUT)),
    "oracle-beginner": ("alike", RATIO, _ratio(ORACLE, IS2R, "beginner")),
    "oracle-intermediate": ("alike", RATIO, _ratio(ORACLE, IS2R, "intermediate")),
    "converge-beginner": ("alike", RATIO, _ratio(IS2R, "is2r-ft65", "beginner")),
    "converge-intermediate": ("more", RATIO, _ratio(IS2R, "is2r-ft65", "intermediate")),
    "converge-advanced": ("alike", RATIO, _ratio(IS2R, "is2r-ft65", "advanced")),
    "first-advanced": ("less", RATIO, _ratio(IS2R, "is2r-ft35", "advanced")),
    "drop-sim2": ("less", RATIO, _ratio("is2r-sim2", "is2r-ft35", "all")),
    "drop-sim3": ("less", RATIO, _ratio("is2r-sim3", "is2r-ft65", "all")),
    "fine-tuning": ("more", RATIO, _ratio("is2r-ft35", "is2r-sim1", "all")),
    "model-change": ("less", RATIO, lambda m: m.model_change()),
    "change-levels": ("less", RATIO, lambda m: m.change_levels()),
    "cross": ("more", RATIO, _ratio(IS2R, S2R, "all", False)),
    "cross-normalised": ("more", DIFFERENCE, lambda m: m.minus(m.cross_normalised, IS2R, S2R, "all", False)),
    "cross-advanced": ("more", RATIO, _ratio(IS2R, S2R, "advanced", False)),
    "cross-oracle": ("more", RATIO, _ratio(ORACLE, S2R, "all", False)),
    "keeps-is2r": ("number", RATIO, _keeps(IS2R)),
    "keeps-s2r": ("number", RATIO, _keeps(S2R)),
    "keeps-less": ("less", RATIO, _keeps(FINAL)),
    "mean": ("number", HITS, lambda m: m.raw.mean(IS2R, of_level("all"))),
    "robot-ends": ("more", SHARE, lambda m: m.robot_ends()),
    "over": ("more", SHARE, lambda m: m.over()),
    "middle-in": ("number", SHARE, lambda m: m.middle(False)),
    "middle-out": ("number", SHARE, lambda m: m.middle(True)),
    "large": ("less", RATIO, _ratio("large", "oracle", "all")),
    "medium": ("alike", RATIO, _ratio("medium", "oracle", "all")),
    "carried": ("open", RATIO, _ratio(IS2R, "fresh-ft100", "all")),
}


def _changes(models: dict[str, BallDistribution]) -> tuple[float, float]:
    scale = widths(models)
    return change(models["M0"], models["M1"], scale), change(models["M1"], models["M2"], scale)


def _finite(rallies: Rallies, values: np.ndarray, over_seeds: bool) -> Bootstrap:
    good = np.isfinite(values)
    return Bootstrap(rallies.take(good), values[good], over_seeds, longest=True)
