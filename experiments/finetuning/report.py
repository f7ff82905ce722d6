"""A fine-tuning in numbers: its progress, rows of metrics, the evaluation before and after, the curve, the balls."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas
from rich.console import Console
from rich.table import Table

from ballmodel.io.tables import COLUMNS
from experiments.config.finetuning import FineTuning
from experiments.evaluation.figures import HIT_COLOUR, MISSED_COLOUR, RETURNED_COLOUR, drawing
from experiments.finetuning.journal import AFTER, BEFORE, TRAINING, Entry
from experiments.progress import ProgressBar, seconds_left
from experiments.runs import run_dir
from experiments.stats import t_interval, welch_interval, wilson
from mjx_tt.viz.html import INK
from robot_io.control.episode import HIT, RETURNED

CURVE_COLOUR = "#4575b4"
RATES = (
    ("hit_rate", HIT_COLOUR, "touched"),
    ("return_rate", RETURNED_COLOUR, "returned"),
    ("fault_rate", MISSED_COLOUR, "faults"),
)
SMOOTHING = 7  # updates
NAMES = {BEFORE: "evaluation before", AFTER: "evaluation after"}
SHORTEST = 2  # samples of a ball that is worth keeping


class FineTuningProgress(ProgressBar):
    """Counts balls. The remaining time is that of the balls still to play at the rate of this session."""

    def __init__(self, console: Console, name: str, planned: int, settings: FineTuning) -> None:
        super().__init__(console, name, planned, unit=" balls")
        self._updates = settings.updates
        self._counted = self._played = 0
        self._rate: float | None = None  # [s] per ball
        self._moment = time.monotonic()
        self._update_text = ""
        self._pausing = False

    def resumed(self, kept: int, attempts: int) -> None:
        """At the start: how many episodes are there already, and how many with the discarded ones."""
        self._counted, self._moment = kept, time.monotonic()
        if attempts:
            self.note(f"continues after {attempts:,} balls, {attempts - kept:,} of them discarded")

    def paused(self) -> None:
        if not self._pausing:
            self._pausing = True
            self.show(self._counted, "paused", plain=True)
        self._moment = time.monotonic()  # waiting says nothing of the rate

    def played(self, entry: Entry) -> None:
        """After every episode, discarded or not."""
        now = time.monotonic()
        self._pausing = False
        self._counted += not entry.discarded
        self._played += 1
        seconds, self._moment = now - self._moment, now
        self._rate = seconds if self._rate is None else self._rate + (seconds - self._rate) / min(self._played, 50)
        where = NAMES.get(entry.phase) or f"update {entry.update}/{self._updates}"
        outcome = f"fault: {entry.summary.fault}" if entry.summary.fault else entry.summary.outcome
        outcome = "discarded" if entry.discarded else outcome
        self.show(self._counted, f"{where}  {outcome}{self._update_text}  {self._left()} left", plain=False)

    def retracted(self) -> None:
        """After a ball that counted was discarded."""
        self._counted -= 1
        self.note("the ball before was discarded: it is played again")

    def updated(self, update: int, row: dict[str, Any]) -> None:
        """After every update with its row of measurements."""
        self._update_text = f"  mean return {row['mean_return']:.2f}, returned {row['return_rate']:.0%}"
        text = f"update {update}/{self._updates}{self._update_text}  {self._left()} left"
        self.show(self._counted, text, plain=True)

    def _left(self) -> str:
        return str(seconds_left((self._total - self._counted) * (self._rate or 0.0)))


def update_row(entries: list[Entry]) -> dict[str, float]:
    """One update's measurements of its perturbed policies; low, high: 95 % interval of the mean return."""
    return _measured(entries) | {f"reward/{name}": value for name, value in _terms(entries).items()}


def evaluated(entries: list[Entry]) -> dict[str, Any]:
    """One evaluation: the mean return with its 95 % interval, the rates, the terms."""
    measured = _measured(entries)
    low, high = wilson(round(measured["return_rate"] * len(entries)), len(entries))
    return {
        "balls": len(entries),
        **measured,
        "return_rate_low": low,
        "return_rate_high": high,
        "terms": _terms(entries),
        "faults": dict(Counter(entry.summary.fault for entry in entries if entry.summary.fault)),
    }


def compare(entries: list[Entry], repeatable: bool) -> dict[str, Any]:
    """Content of evaluation.json. Where both evaluations met the same balls, the difference is taken ball by ball."""
    kept = [entry for entry in entries if not entry.discarded]
    updates = max(e.update for e in kept if e.phase == AFTER)  # a run that was continued has several evaluations
    before = [e for e in kept if e.phase == BEFORE]
    after = [e for e in kept if e.phase == AFTER and e.update == updates]
    a, b = {e.episode: e.returns for e in before}, {e.episode: e.returns for e in after}
    paired = repeatable and set(a) == set(b)
    if paired:
        difference, low, high = t_interval([b[episode] - a[episode] for episode in a])
    else:
        difference, low, high = welch_interval(list(a.values()), list(b.values()))
    training = [e for e in entries if e.phase == TRAINING]
    return {
        "before": evaluated(before),
        "after": evaluated(after),
        "difference": {
            "mean_return": difference,
            "low": low,
            "high": high,
            "paired": paired,
            "significant": low > 0.0 or high < 0.0,
        },
        "updates": updates,
        "episodes": sum(not e.discarded for e in training),
        "discarded": sum(e.discarded for e in entries),
    }


def sentence(evaluation: dict[str, Any]) -> str:
    """One evaluation in words."""
    e = evaluation
    faults = ", ".join(f"{count} {cause}" for cause, count in e["faults"].items())
    return (
        f"mean return {e['mean_return']:.2f} (95 % interval {e['low']:.2f} to {e['high']:.2f}), "
        f"{e['return_rate']:.0%} of {e['balls']} balls returned" + (f"; faults: {faults}" if faults else "")
    )


def print_result(console: Console, result: dict[str, Any], title: str) -> None:
    """The comparison as a table."""
    table = Table(
        "", "before", "after", title=f"{title}: {result['updates']} updates on the robot", title_justify="left"
    )
    both = [result["before"], result["after"]]
    table.add_row(
        "mean return", *(f"{e['mean_return']:.2f}  ({e['low']:.2f} to {e['high']:.2f})" for e in both), style="bold"
    )
    table.add_row(
        "return rate",
        *(f"{e['return_rate']:.0%}  ({e['return_rate_low']:.0%} to {e['return_rate_high']:.0%})" for e in both),
    )
    table.add_row("hit rate", *(f"{e['hit_rate']:.0%}" for e in both))
    table.add_row("faults", *(f"{e['fault_rate']:.0%}" for e in both))
    for name in both[0]["terms"]:
        table.add_row(f"  {name}", *(f"{e['terms'][name]:.3f}" for e in both))
    console.print(table)
    d = result["difference"]
    how = "ball by ball" if d["paired"] else "different balls"
    verdict = "" if d["significant"] else "; no significant change"
    console.print(
        f"mean return {d['mean_return']:+.2f} (95 % interval {d['low']:+.2f} to {d['high']:+.2f}, {how}){verdict}",
        soft_wrap=True,
    )


def write_human_balls(path: Path, session: str, entries: list[Entry]) -> int:
    """Writes the measured balls as CSV (docs/reference/measured-balls.md); returns their number."""
    kept = [entry for entry in entries if len(entry.trajectory) >= SHORTEST]
    rows = ((session, f"{e.phase}{e.episode}", *map(repr, sample)) for e in kept for sample in e.trajectory.tolist())
    run_dir.write_csv(path, COLUMNS, rows)
    return len(kept)


def draw(path: Path, rows: list[dict[str, Any]], balls: int, result: dict[str, Any], title: str) -> Path:
    """Writes the curve of the mean return per update with the evaluations at its ends, as PNG.

    rows: of metrics.jsonl; balls: of an update.
    """
    with drawing(path):
        figure, (upper, lower) = plt.subplots(2, 1, figsize=(7.2, 6.4), sharex=True, height_ratios=(2, 1))
        column = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
        if rows:
            updates, mean = column["update"], column["mean_return"]
            style: Any = {"color": CURVE_COLOUR}
            upper.fill_between(updates, column["low"], column["high"], alpha=0.18, linewidth=0, **style)
            label = f"perturbed policies, {balls} balls an update, 95 %"
            upper.plot(updates, mean, "o", markersize=3, alpha=0.7, label=label, **style)
            upper.plot(updates, _smooth(mean), linewidth=1.8, label=f"mean over {SMOOTHING} updates", **style)
            for name, colour, label in RATES:
                lower.plot(updates, _smooth(column[name]), color=colour, label=label, linewidth=1.5)
        ends = (0, result["updates"] + 1)
        for at, name in zip(ends, (BEFORE, AFTER), strict=True):
            e = result[name]
            bars = [[e["mean_return"] - e["low"]], [e["high"] - e["mean_return"]]]
            legend = f"evaluated policy, {e['balls']} balls, 95 %" if name == BEFORE else None
            style = {"fmt": "D", "color": INK, "markersize": 5, "capsize": 3, "zorder": 4}
            upper.errorbar(at, e["mean_return"], bars, label=legend, **style)
        upper.axhline(result["before"]["mean_return"], color=INK, linewidth=0.8, linestyle=":", zorder=1)
        upper.set_ylabel("mean return")
        before, after, d = (result[name] for name in ("before", "after", "difference"))
        change = f"{d['mean_return']:+.2f} ({d['low']:+.2f} to {d['high']:+.2f})"
        upper.set_title(f"{title}\nmean return {before['mean_return']:.2f} to {after['mean_return']:.2f}: {change}")
        lower.set_ylim(-0.02, 1.02)
        lower.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
        lower.set_ylabel(f"balls, mean of {SMOOTHING}")
        lower.set_xlabel("update")
        lines = [pair for axes in (upper, lower) for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
        if lines:
            figure.legend(*zip(*lines, strict=True), loc="outside lower left", fontsize=9, ncols=2)
        for axes in (upper, lower):
            axes.grid(axis="y", alpha=0.25)
    return path


def _measured(entries: list[Entry]) -> dict[str, float]:
    """Mean return with its 95 % interval, and rates."""
    mean, low, high = t_interval([entry.returns for entry in entries])
    outcomes = [entry.summary.outcome for entry in entries]
    return {
        "mean_return": mean,
        "low": low,
        "high": high,
        "return_rate": outcomes.count(RETURNED) / len(outcomes),
        "hit_rate": (outcomes.count(RETURNED) + outcomes.count(HIT)) / len(outcomes),
        "fault_rate": sum(entry.summary.fault is not None for entry in entries) / len(entries),
    }


def _terms(entries: list[Entry]) -> dict[str, float]:
    return {name: float(np.mean([e.terms[name] for e in entries])) for name in entries[0].terms}


def _smooth(values: np.ndarray) -> np.ndarray:
    """Mean over the SMOOTHING updates around each; fewer at the ends."""
    return pandas.Series(values).rolling(SMOOTHING, min_periods=1, center=True).mean().to_numpy()
