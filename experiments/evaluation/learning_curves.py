"""Learning curves: of one training, with what was changed on its way, and of several in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas

from experiments.config import build
from experiments.config.build import Experiment
from experiments.errors import RunError
from experiments.evaluation.figures import HIT_COLOUR, RETURNED_COLOUR, drawing
from experiments.runs import metrics
from experiments.runs.run_dir import Run
from mjx_tt.viz.html import INK

SMOOTHING = 25  # updates
NAMED = 2  # reward weights of a change that are written out
MARKS = ("#7b3294", "#a6611a")


@dataclass(frozen=True)
class Mark:
    """A change on the way: it holds from the row of this update on."""

    update: int
    text: str


def changes(experiment: Experiment) -> list[Mark]:
    """Changes on the way of a training: of reward weights, and of the scale of the perturbations."""
    config, found = experiment.config, []
    later = build.later_weights(config)
    if later is not None:
        update, weights = later
        terms = zip(experiment.task.terms, experiment.task.reward_weights, weights, strict=True)
        moved = [f"{name.replace('_', ' ')} {old:g} to {new:g}" for name, old, new in terms if old != new]
        more = f" and {len(moved) - NAMED} more" if len(moved) > NAMED else ""
        found.append(Mark(update, f"reward weights: {', '.join(moved[:NAMED]) or 'the same'}{more}"))
    fall = config.optimiser.sigma_fall
    if fall is not None:
        held = int(fall.hold * config.training.updates)
        found.append(Mark(held, f"sigma falls from {config.optimiser.sigma:g} to {fall.final:g} at the end"))
    return found


def draw_training(path: Path, rows: list[dict[str, Any]], title: str, marks: Sequence[Mark] = ()) -> Path:
    """Writes the training curve from the rows of metrics.jsonl."""
    with drawing(path):
        figure, (upper, lower) = plt.subplots(2, 1, figsize=(7.2, 6.2), sharex=True, height_ratios=(2, 1))
        minutes = np.array([row["seconds"] for row in rows]) / 60
        shown = [_smooth(rows, "hit_rate"), _smooth(rows, "return_rate")]
        upper.plot(minutes, shown[0], color=HIT_COLOUR, label="perturbed policies: touched")
        upper.plot(minutes, shown[1], color=RETURNED_COLOUR, label="perturbed policies: returned")
        evaluated = [row for row in rows if "evaluation/return_rate" in row]
        if evaluated:
            at = [row["seconds"] / 60 for row in evaluated]
            rate, low, high = (
                np.array([row[f"evaluation/{k}"] for row in evaluated]) for k in ("return_rate", "low", "high")
            )
            upper.errorbar(
                at,
                rate,
                (rate - low, high - rate),
                color=INK,
                fmt="o-",
                markersize=4,
                linewidth=1,
                capsize=2,
                label="evaluated policy: returned, 95 %",
            )
            shown.append(low)
        # A training that starts from a policy stays far above zero.
        bottom = min((float(np.nanmin(values)) for values in shown if np.isfinite(values).any()), default=0.0)
        upper.set_ylim(max(0.0, np.floor(10 * bottom - 0.5) / 10), 1.02)
        upper.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
        upper.set_ylabel("balls")
        upper.set_title(title)
        mean_return = _smooth(rows, "mean_return")
        lower.plot(minutes, mean_return, color="#4575b4")
        if np.isfinite(mean_return).any():  # the first, random policies would take all the room
            ends = np.nanpercentile(mean_return, (5, 100))
            margin = 0.05 * np.ptp(ends) + 0.01
            lower.set_ylim(ends[0] - margin, ends[1] + margin)
        lower.set_ylabel("mean return")
        lower.set_xlabel("training time [min]")
        for axes in (upper, lower):
            axes.grid(axis="y", alpha=0.25)
            axes.set_xlim(minutes[0], minutes[-1] + 0.01 * (minutes[-1] - minutes[0]) + 1e-9)
        updates = np.array([row["update"] for row in rows])
        for k, mark in enumerate(m for m in marks if updates[0] <= m.update <= updates[-1]):
            minute = float(np.interp(mark.update, updates, minutes))
            for axes in (upper, lower):
                style = {"color": MARKS[k % len(MARKS)], "linestyle": ("--", ":")[k % 2], "linewidth": 1.4, "zorder": 1}
                axes.axvline(minute, label=f"from here {mark.text}" if axes is upper else None, **style)
        figure.legend(loc="outside lower left", ncols=1)
    return path


@dataclass(frozen=True)
class Curve:
    """A training for ``draw_curves``: rows of its metrics.jsonl, and how many balls an update plays."""

    name: str
    rows: list[dict[str, Any]]
    balls: int


def read_curve(folder: str | Path) -> Curve:
    """The curve of a training in simulation. Raises RunError for a folder that holds none."""
    run = Run(folder)
    optimiser, rows = run.config().optimiser, metrics.read(run.metrics)
    if not rows:
        raise RunError(f"{run.metrics}: holds no update yet")
    if "fault_rate" in rows[0]:
        raise RunError(
            f"{folder}: is a fine-tuning, with another count of balls and time; wanted is a training in simulation"
        )
    return Curve(str(folder), rows, 2 * optimiser.num_directions * optimiser.repeats)


def draw_curves(path: Path, curves: list[Curve]) -> Path:
    """Writes the shares of balls that several trainings' policies return, over time and over balls."""
    with drawing(path):
        figure, panels = plt.subplots(1, 2, figsize=(9.6, 4.2 + 0.22 * len(curves)), sharey=True)
        for i, curve in enumerate(curves):
            colour = f"C{i % 10}"
            minutes = np.array([row["seconds"] for row in curve.rows]) / 60
            played = curve.balls * np.array([row["update"] for row in curve.rows])
            rate = _smooth(curve.rows, "return_rate")
            evaluated = np.array(["evaluation/return_rate" in row for row in curve.rows])
            at = [row["evaluation/return_rate"] for row, there in zip(curve.rows, evaluated, strict=True) if there]
            for axes, x in zip(panels, (minutes, played), strict=True):
                axes.plot(x, rate, color=colour, label=f"{curve.name}, perturbed")
                if at:
                    style = {"color": colour, "markersize": 4, "linewidth": 1}
                    axes.plot(x[evaluated], at, "o--", label=f"{curve.name}, evaluated", **style)
        for axes, label in zip(panels, ("training time [min]", "balls"), strict=True):
            axes.set_xscale("log")
            axes.set_xlim(left=min(line.get_xdata()[-1] for line in axes.lines) / 30)  # the first updates say nothing
            axes.xaxis.set_major_formatter(lambda v, _: f"{v:,g}" if v < 1e6 else f"{v / 1e6:g} million")
            axes.set_xlabel(label)
            axes.grid(alpha=0.25)
        panels[0].set_ylim(-0.02, 1.02)
        panels[0].yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
        panels[0].set_title("returned balls")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    return path


def _smooth(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """Trailing mean over up to SMOOTHING updates; what was not finite is left out."""
    values = pandas.Series([row[name] for row in rows], dtype=float).replace([np.inf, -np.inf], np.nan)
    return values.rolling(SMOOTHING, min_periods=1).mean().to_numpy()
