"""Results of a comparison of algorithms: tables, pictures and a page, made from the finished runs alone."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter

from ballmodel.io.atomic_files import replacing
from experiments.config.baselines import Comparison
from experiments.evaluation.figures import STYLE
from experiments.runs import run_dir
from experiments.stats import wilson
from mjx_tt.viz.html import INK

COLOURS = ("#1b7837", "#7fbf7b", "#762a83", "#2166ac", "#b35806", "#b2182b", "#542788", "#4d4d4d")
WORLDS = {"simulation": "in simulation", "reality": "in a world that it has never seen"}
CURVE = ("episodes", "steps", "seconds", "cpu_seconds", "return_rate", "low", "high", "hit_rate", "mean_return")
NAMES_IN_A_ROW = 48  # letters of all names that fit side by side under the bars
RESTLESSNESS = {
    "action_change": "mean square of an action's change",
    "velocity": "velocity over its limit",
    "acceleration": "acceleration over its limit",
    "jerk": "jerk over its limit",
}

Runs = dict[str, dict[int, dict[str, Any]]]  # by algorithm and seed
Summary = dict[str, dict[str, Any]]  # by algorithm
Colours = dict[str, str]


def write(folder: Path, comparison: Comparison) -> None:
    """comparison.json, curves.csv, the pictures and comparison.md in a comparison's folder. Raises OSError."""
    found = {
        name: {seed: _run(folder / name / f"seed{seed}") for seed in comparison.seeds} for name in comparison.algorithms
    }
    summary = {name: _summary(seeds) for name, seeds in found.items()}
    colours = dict(zip(found, cycle(COLOURS), strict=False))
    run_dir.write_json(folder / "comparison.json", {"name": comparison.name, "algorithms": summary})
    _write_curves(folder / "curves.csv", found)
    with plt.rc_context(STYLE):
        pictures = {
            "curves.png": _curves(found, colours, comparison.budget.clock),
            "transfer.png": _transfer(summary, colours),
            "restlessness.png": _restlessness(summary, colours),
        }
        for name, figure in pictures.items():
            with replacing(folder / name) as temporary:
                figure.savefig(temporary, format="png")
            plt.close(figure)
    with replacing(folder / "comparison.md") as temporary:
        temporary.write_text(_page(comparison, summary), encoding="utf-8")


def _run(folder: Path) -> dict[str, Any]:
    training, evaluation = (json.loads((folder / f"{name}.json").read_text()) for name in ("training", "evaluation"))
    return {"curve": training["curve"], **{key: evaluation[key] for key in (*WORLDS, "restlessness")}}


def _summary(seeds: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Over the seeds: what was spent, and per world the balls of all of them together and the rate of each."""
    last = [run["curve"][-1] for run in seeds.values()]
    spent = {
        key: float(np.mean([point[key] for point in last])) for key in ("episodes", "steps", "seconds", "cpu_seconds")
    }
    worlds = {}
    for world in WORLDS:
        parts = [run[world] for run in seeds.values()]
        balls, returned = (
            sum(count) for count in zip(*((p["episodes"], p["outcomes"]["returned"]) for p in parts), strict=True)
        )
        low, high = wilson(returned, balls)
        worlds[world] = {
            "return_rate": returned / balls,
            "low": low,
            "high": high,
            "by_seed": {str(seed): run[world]["return_rate"] for seed, run in seeds.items()},
            "hit_rate": float(np.mean([p["hit_rate"] for p in parts])),
            "mean_return": _mean(p["mean_return"] for p in parts),
            "non_finite": sum(p["non_finite"] for p in parts),
        }
    restless = {key: _mean(run["restlessness"][key] for run in seeds.values()) for key in RESTLESSNESS}
    return {"spent": spent, **worlds, "restlessness": restless}


def _mean(values: Iterable[float | None]) -> float | None:
    """Over what is known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _write_curves(path: Path, found: Runs) -> None:
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("algorithm", "seed", *CURVE))
        for name, seeds in found.items():
            for seed, run in seeds.items():
                writer.writerows((name, seed, *(point[key] for key in CURVE)) for point in run["curve"])


def _curves(found: Runs, colours: Colours, clock: str) -> Figure:
    """Rates and mean return against episodes and against training time."""
    figure, grid = plt.subplots(3, 2, figsize=(11, 9), sharex="col", sharey="row")
    measures = {"return_rate": "returned", "hit_rate": "touched", "mean_return": "mean return"}
    for row, (measure, label) in zip(grid, measures.items(), strict=True):
        for axes, x in zip(row, ("episodes", "seconds" if clock == "wall" else "cpu_seconds"), strict=True):
            for name, seeds in found.items():
                for i, run in enumerate(seeds.values()):
                    # A logarithmic axis has no place for the evaluation before any episode.
                    points = [p for p in run["curve"] if p[measure] is not None and (p[x] > 0 or x != "episodes")]
                    at, value = ([p[key] for p in points] for key in (x, measure))
                    label_once = None if i else name
                    axes.plot(at, value, "o-", markersize=3, linewidth=1.4, color=colours[name], label=label_once)
                    if measure == "return_rate":
                        low, high = ([p[key] for p in points] for key in ("low", "high"))
                        axes.vlines(at, low, high, color=colours[name], alpha=0.35, linewidth=1.0)
            axes.grid(axis="y", alpha=0.25)
        row[0].set_ylabel(label)
    for row in grid[:2]:
        row[0].set_ylim(0.0, max(0.05, row[0].get_ylim()[1]))
        row[0].yaxis.set_major_formatter(PercentFormatter(1.0))
    # Random policies collide all the time; they would take all the room.
    ends = [run["curve"][-1]["mean_return"] for seeds in found.values() for run in seeds.values()]
    known = [value for value in ends if value is not None]
    if known:
        grid[2, 0].set_ylim(min(known) - 2, max(known) + 1)
    grid[2, 0].set_xscale("log")
    grid[2, 0].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    grid[2, 0].xaxis.set_major_formatter(lambda v, _: f"{v:,.0f}" if v < 1e6 else f"{v / 1e6:g} million")
    grid[2, 0].xaxis.set_minor_formatter(NullFormatter())
    grid[2, 0].set_xlabel("episodes of training")
    grid[2, 1].set_xlabel("training time [s]" if clock == "wall" else "processor time of training [s]")
    grid[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    title = "Learning curves: the policy without exploration, on balls that no training drew"
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold")
    return figure


def _bars(axes: Axes, heights: dict[str, float], colours: Colours) -> np.ndarray:
    """A bar per algorithm; returns their places."""
    place = np.arange(len(heights))
    axes.bar(place, list(heights.values()), width=0.62, color=[colours[name] for name in heights])
    many = len(heights) > 6 or sum(map(len, heights)) > NAMES_IN_A_ROW
    axes.set_xticks(place, list(heights), rotation=30 if many else 0, ha="right" if many else "center")
    axes.grid(axis="y", alpha=0.25)
    return place


def _transfer(summary: Summary, colours: Colours) -> Figure:
    figure, row = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True)
    for axes, (world, title) in zip(row, WORLDS.items(), strict=True):
        place = _bars(axes, {name: part[world]["return_rate"] for name, part in summary.items()}, colours)
        for at, part in zip(place, summary.values(), strict=True):
            found = part[world]
            rate, below = found["return_rate"], found["return_rate"] - found["low"]
            axes.errorbar(at, rate, [[below], [found["high"] - rate]], color=INK, capsize=4)
            by_seed = list(found["by_seed"].values())
            if len(by_seed) > 1:
                axes.plot(
                    np.full(len(by_seed), at + 0.2), by_seed, "o", markersize=4, color=INK, markerfacecolor="white"
                )
            top = max(found["high"], *by_seed)
            axes.annotate(f"{rate:.1%}", (at, top), (0, 5), textcoords="offset points", ha="center", fontsize=9)
        axes.set_title(f"Returned {title}")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    row[0].set_ylim(0.0, max(0.05, 1.12 * row[0].get_ylim()[1]))
    row[0].set_ylabel("return rate, 95 % interval of the balls")
    return figure


def _restlessness(summary: Summary, colours: Colours) -> Figure:
    figure, row = plt.subplots(1, len(RESTLESSNESS), figsize=(3.2 * len(RESTLESSNESS), 3.6))
    for axes, (key, title) in zip(row, RESTLESSNESS.items(), strict=True):
        _bars(axes, {name: part["restlessness"][key] or 0.0 for name, part in summary.items()}, colours)
        axes.set_title(title, fontsize=9)
        axes.tick_params(axis="x", labelrotation=45)
    row[0].set_yscale("log")  # from one algorithm to another by orders of magnitude
    figure.suptitle("How restless the motion is (less is smoother)", x=0.01, ha="left", fontweight="bold")
    return figure


def _page(comparison: Comparison, summary: Summary) -> str:
    budget, several = comparison.budget, len(comparison.seeds) > 1
    limits = []
    if budget.minutes is not None:
        limits.append(f"{60 * budget.minutes:g} s of {'processor time' if budget.clock == 'cpu' else 'time'}")
    if budget.episodes is not None:
        limits.append(f"{budget.episodes:,} episodes")
    lines = [
        f"# {comparison.name}: {', '.join(summary)}",
        "",
        f"Seed{'s' * several} {', '.join(map(str, comparison.seeds))}; each training at most {' or '.join(limits)}.",
        "Rates with the 95 % interval (Wilson) of the balls of all seeds together. It does not hold the spread between "
        "seeds: " + ("their range stands in brackets." if several else "with one seed nothing tells it."),
        "",
        "| | episodes | seconds | processor s | touched | returned | in reality | mean return |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, part in summary.items():
        spent, simulated = part["spent"], part["simulation"]
        cells = [f"{spent['episodes']:,.0f}", f"{spent['seconds']:.0f}", f"{spent['cpu_seconds']:.0f}"]
        cells += [f"{simulated['hit_rate']:.1%}", *(_rate(part[world], several) for world in WORLDS)]
        lines.append(f"| {' | '.join([name, *cells, _number(simulated['mean_return'])])} |")
    lines += ["", f"| | {' | '.join(RESTLESSNESS.values())} |", "|---" * (1 + len(RESTLESSNESS)) + "|"]
    for name, part in summary.items():
        lines.append(f"| {' | '.join([name, *(_number(part['restlessness'][key]) for key in RESTLESSNESS)])} |")
    pictures = {"curves": "Learning curves", "transfer": "Transfer", "restlessness": "Smoothness"}
    lines += [line for key, title in pictures.items() for line in ("", f"![{title}]({key}.png)")]
    return "\n".join(lines) + "\n"


def _rate(found: dict[str, Any], several: bool) -> str:
    rates = found["by_seed"].values()
    spread = f" [{min(rates):.1%} to {max(rates):.1%}]" if several else ""
    return f"{found['return_rate']:.1%} ({found['low']:.1%} to {found['high']:.1%}){spread}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
