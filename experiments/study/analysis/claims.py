"""The paper's claims, measured in a study and judged: ``paper.yaml`` names each claim's statistic and what is expected.

The rules of the verdicts stand in the report (``report/templates/study.html``). Intervals are 95 % bootstrap intervals
over seeds and rallies (``statistics``); those of changes of the human models are Student's t.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from experiments.runs import metrics
from experiments.runs.run_dir import Run
from experiments.stats import welch_interval
from experiments.study.analysis import scoring
from experiments.study.analysis.paper import BY_SKILL, CLAIMS, FINAL, TEN, Claim, of_level
from experiments.study.analysis.scoring import Rallies
from experiments.study.analysis.statistics import (
    DRAWS,
    Bootstrap,
    Estimate,
    Interval,
    average_over_seeds,
    exponentiate,
    normalise_by_model,
    normalise_by_player,
    t_mean,
)
from experiments.study.analysis.study_folder import StudyFolder, changes_of, paper_models
from mjx_tt.rally.end_reasons import End

WIDEST = 4.0  # high over low end of a ratio's interval that still shows "no difference": from half to double
PLAYS = 2.0  # touches; the shortest rally in the paper's table of player skill
LARGEST = 1e4  # number that is printed as one
SHORT_RALLY = 5  # touches
TUNED = {"is2r-sim1": "is2r-ft35", "is2r-sim2": "is2r-ft65", "is2r-sim3": "is2r-ft100", "oracle-sim": "oracle-ft"}
"""Zero-shot policies, and what fine-tuning makes of them."""
SMOOTH = 10  # updates over which a fine-tuning's return rate is averaged
ONE_SEED = "the players of one seed alone, who share its reality"
VERDICTS = "agrees", "agrees in direction", "differs", "undecided", "not comparable"
AGREES, DIRECTION, DIFFERS, UNDECIDED, NOT_COMPARABLE = VERDICTS
RATIO, DIFFERENCE, SHARE, HITS = "ratio", "difference", "share", "hits"
NULL = {RATIO: 1.0, DIFFERENCE: 0.0, SHARE: 0.5}
"""Value of "no difference" by unit."""
UNITS = (
    dict.fromkeys(("length_ratio", "kept_ratio", "model_change", "model_change_by_level", "tuning_cost"), RATIO)
    | dict.fromkeys(("normalised_difference", "short_share_difference"), DIFFERENCE)
    | dict.fromkeys(("longer_share", "robot_ended_share"), SHARE)
    | dict.fromkeys(("mean_length", "longest_rally"), HITS)
)
"""Unit of each statistic, a method of ``Measurements``."""
Changes = dict[tuple[int, str], tuple[float, float]]  # of the human model, M0 to M1 and M1 to M2, by seed and player


@dataclass(frozen=True)
class Finding:
    """A claim with what was measured.

    interval: None where nothing could be measured
    paper: the paper's number, which its text states or which follows from its table of ball distributions
    """

    claim: Claim
    unit: str
    interval: Interval | None
    verdict: str
    why: str
    paper: float | None


class Measurements:
    """Statistics of a study's rallies and human models. Bootstraps are made once.

    A statistic is None where the study lacks what it needs.
    """

    def __init__(self, study: StudyFolder) -> None:
        self.study = study

    @cached_property
    def raw(self) -> Bootstrap:
        """Rally lengths that the paper reports, own and cross-evaluations."""
        return Bootstrap(self.study.pick(own=None, selected=False), longest=True)

    @cached_property
    def normalised(self) -> Bootstrap:
        """Own evaluations of the ten models, normalised by player."""
        rallies = self.study.pick(TEN, selected=False)
        return self._finite(rallies, normalise_by_player(rallies))

    @cached_property
    def cross_normalised(self) -> Bootstrap:
        """Own and cross-evaluations of the final models, normalised by the trainer's own evaluation of the model."""
        rallies = self.study.pick(FINAL, own=None, selected=False)
        return self._finite(rallies, normalise_by_model(rallies))

    @cached_property
    def changes(self) -> Changes:
        """Changes of the human models wherever all three are there."""
        models = {(s, p): self.study.models_of(s, p) for s in self.study.seeds for p in self.study.players}
        return {key: changes_of(three) for key, three in models.items() if len(three) == 3}

    @cached_property
    def findings(self) -> dict[str, Finding]:
        """All claims by their keys, in the paper's order."""
        return {claim.key: evaluate(claim, self) for claim in CLAIMS}

    def length_ratio(self, a: str, b: str, group: str = "all", others: bool = False) -> Estimate | None:
        """Mean length of model a over that of b, over the players of a group that have both.

        others: with players who did not train the policy
        """
        pair = self.raw.pair(a, b, of_level(group), not others)
        return pair and pair[0] / pair[1]

    def kept_ratio(self, models: Sequence[str]) -> Estimate | None:
        """Mean length with other players over that with the trainer, all models together."""
        pair = self.raw.pair(models, models, BY_SKILL, False, True)
        return pair and pair[0] / pair[1]

    def mean_length(self, model: str) -> Estimate | None:
        """Mean length of a model's own evaluations."""
        return self.raw.mean(model, BY_SKILL)

    def longest_rally(self, model: str) -> Estimate | None:
        """Longest of a model's own rallies; its draws reach no further than the longest that was played."""
        lengths = self.study.pick((model,), selected=False).length
        if not lengths.size:
            return None
        draws = np.random.default_rng(0).choice(lengths, (DRAWS, lengths.size)).max(axis=1)
        return Estimate(float(lengths.max()), draws, lengths.size)

    def normalised_difference(self, a: str, b: str, group: str = "all", others: bool = False) -> Estimate | None:
        """Mean normalised length of model a minus that of b."""
        return self._difference(self.cross_normalised if others else self.normalised, a, b, group, others)

    def short_share_difference(self, a: str, b: str) -> Estimate | None:
        """Share of rallies below SHORT_RALLY of model a minus that of b."""
        rallies = self.study.pick(FINAL, selected=False)
        boot = Bootstrap(rallies, rallies.length < SHORT_RALLY, longest=True)
        return self._difference(boot, a, b, "all", False)

    def longer_share(self, a: str, b: str) -> Estimate | None:
        """Share of players whose rallies are longer under model a than under b."""
        pairs = [pair for player in self.study.players if (pair := self.raw.pair(a, b, (player,)))]
        if not pairs:
            return None
        value = np.mean([first.value > second.value for first, second in pairs])
        draws = np.mean([first.draws > second.draws for first, second in pairs], axis=0)
        return Estimate(float(value), draws, len(pairs), max(e.value for pair in pairs for e in pair))

    def robot_ended_share(self) -> Estimate | None:
        """Share of the ten models' own rallies that the robot ended: by a mistake, or by an unplayable return."""
        rallies = self.study.pick(TEN, selected=False)
        rallies = rallies.take(rallies.end != End.NONE)
        ended = (rallies.robot_ended == 1) | np.isin(rallies.end, (End.ROBOT_GRAZES_NET, End.ROBOT_CORNER))
        return Bootstrap(rallies, ended).mean(TEN, BY_SKILL)

    def model_change(self, group: str = "all") -> Interval | None:
        """Geometric mean of the human model's second change over its first, over the players of a group."""
        players = of_level(group)
        both = {(s, p): ab for (s, p), ab in self.changes.items() if min(ab) > 0 and p in players}
        return _geometric_mean({key: float(np.log(b / a)) for key, (a, b) in both.items()})

    def model_change_by_level(self) -> Interval | None:
        """Second change of beginners over that of intermediate players, geometric means.

        Student's t over seeds; of one seed Welch's interval over players.
        """
        logs: dict[int, tuple[list[float], list[float]]] = {}
        for (seed, player), (_, second) in self.changes.items():
            for k, level in enumerate(("beginner", "intermediate")):
                if player in of_level(level) and second > 0:
                    logs.setdefault(seed, ([], []))[k].append(float(np.log(second)))
        both = {seed: pair for seed, pair in logs.items() if all(pair)}
        if len(both) > 1:
            apart = {(s, ""): float(np.mean(a) - np.mean(b)) for s, (a, b) in both.items()}
            return exponentiate(average_over_seeds(apart))
        beginners, intermediate = next(iter(both.values()), ([], []))
        if min(len(beginners), len(intermediate)) < 2:
            return None
        count = len(beginners) + len(intermediate)
        return exponentiate(Interval(*welch_interval(intermediate, beginners), count, ONE_SEED))

    def tuning_cost(self) -> Interval | None:
        """Updates of fine-tuning after a player's worst zero-shot policy over those after the best, to an equal level.

        The level is the highest return rate, averaged over SMOOTH updates, that all of the player's fine-tunings reach.
        """
        logs = {}
        for seed, player in ((s, p) for s in self.study.seeds for p in self.study.players):
            found = []
            for zero_shot, tuned in TUNED.items():
                lengths = self.raw.cells.get((seed, player, player, zero_shot))
                run = Run(self.study.paths.model(seed, player, tuned))
                rates = [row["return_rate"] for row in metrics.read(run.metrics)]
                if lengths is not None and len(rates) >= SMOOTH:
                    found.append((lengths.mean(), np.convolve(rates, np.full(SMOOTH, 1.0 / SMOOTH), "valid")))
            if len(found) > 1:
                level = min(rates.max() for _, rates in found)
                (_, worst), *_, (_, best) = sorted(found, key=lambda pair: pair[0])
                taken = [int(np.argmax(rates >= level)) + SMOOTH for rates in (worst, best)]
                logs[seed, player] = float(np.log(taken[0] / taken[1]))
        return _geometric_mean(logs)

    def _difference(self, boot: Bootstrap, a: str, b: str, group: str, others: bool) -> Estimate | None:
        """Mean of a minus mean of b; ``larger`` is of the rally lengths."""
        pair, lengths = (x.pair(a, b, of_level(group), not others) for x in (boot, self.raw))
        if pair is None or lengths is None:
            return None
        return replace(pair[0] - pair[1], larger=max(e.value for e in lengths))

    def _finite(self, rallies: Rallies, values: np.ndarray) -> Bootstrap:
        good = np.isfinite(values)
        return Bootstrap(rallies.take(good), values[good], longest=True)


def _geometric_mean(logs: dict[tuple[int, str], float]) -> Interval | None:
    """Of two logarithms by seed and player at least: Student's t over seeds, over players where there is one."""
    if len(logs) < 2:
        return None
    found = average_over_seeds(logs)
    return exponentiate(found if found.n > 1 else replace(t_mean([*logs.values()]), over=ONE_SEED))


def paper_changes(player: str) -> tuple[float, float]:
    """The paper's changes M0 to M1 and M1 to M2 of a player, from its table ball_dist."""
    return changes_of(paper_models(player))


def paper_number(claim: Claim) -> float | None:
    """The number that the paper states, or that follows from its human models."""
    if claim.statistic not in ("model_change", "model_change_by_level"):
        return claim.paper
    paper = Measurements(StudyFolder(Path(), {}, scoring.join([])))
    paper.changes = {(0, player): paper_changes(player) for player in BY_SKILL}
    interval = getattr(paper, claim.statistic)(**claim.of)
    return None if interval is None else interval.value


def evaluate(claim: Claim, m: Measurements) -> Finding:
    """Measures a claim's statistic and judges it."""
    unit, found, paper = UNITS[claim.statistic], getattr(m, claim.statistic)(**claim.of), paper_number(claim)
    interval, larger = (found.interval, found.larger) if isinstance(found, Estimate) else (found, np.inf)
    if interval is None or not np.isfinite(interval.value):
        return Finding(claim, unit, None, NOT_COMPARABLE, "the study lacks what this needs", paper)
    if larger < PLAYS:
        verdict, why = NOT_COMPARABLE, f"both rally lengths are below {PLAYS:g}: neither policy returns balls"
    elif claim.expect == "open":
        verdict, why = NOT_COMPARABLE, "the paper leaves it open; this is our answer"
    else:
        verdict, why = judge(claim.expect, unit, interval, claim.paper)
        why += f"; it is over {interval.over}" if interval.over else ""
    return Finding(claim, unit, interval, verdict, why, paper)


def judge(expect: str, unit: str, interval: Interval, paper: float | None) -> tuple[str, str]:
    """Verdict and its reason, from the interval, what is expected and the number that the paper states."""
    low, high = interval.low, interval.high
    where = f"the interval {show_interval(unit, interval)}"
    wide = high > WIDEST * low
    holds = paper is not None and low <= paper <= high
    if expect == "number":
        if not holds:
            return DIFFERS, f"{where} does not hold the paper's number"
        if wide:
            return UNDECIDED, f"{where} holds the paper's number, but is too wide to tell"
        return AGREES, f"{where} holds the paper's number"
    null = NULL[unit]
    inside = low <= null <= high
    if expect == "alike":
        if not inside:
            return DIFFERS, f"{where} excludes no difference"
        if unit == RATIO and wide:
            return UNDECIDED, f"{where} is too wide to call it the same"
        return AGREES, f"{where} holds no difference"
    if inside:
        if paper is not None and not holds:
            return DIFFERS, f"{where} holds no difference, but not the paper's number"
        return UNDECIDED, f"{where} allows both"
    if (low > null) != (expect == "more"):
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


def show_interval(unit: str, interval: Interval) -> str:
    """An interval as the report prints it."""
    return f"{show(unit, interval.low)} to {show(unit, interval.high)}"
