"""Results of a comparison of algorithms: a page with tables and figures, made from the finished runs alone."""

from __future__ import annotations

import csv
import json
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ballmodel.io.atomic_files import replacing
from experiments.config.baselines import Comparison
from experiments.runs import run_dir
from experiments.stats import wilson
from mjx_tt.viz.html import INK, STYLE, WIDTH, Page, table

COLOURS = ("#1b7837", "#7fbf7b", "#762a83", "#2166ac", "#b35806", "#b2182b", "#542788", "#4d4d4d")
WORLDS = {"simulation": "in simulation", "reality": "in a world that it has never seen"}
SPENT = ("episodes", "steps", "seconds", "cpu_seconds")
CURVE = (*SPENT, "return_rate", "low", "high", "hit_rate", "mean_return")
MEASURES = {"return_rate": "returned", "hit_rate": "touched", "mean_return": "mean return"}
RESTLESSNESS = {
    "action_change": "mean square of an action's change",
    "velocity": "velocity over its limit",
    "acceleration": "acceleration over its limit",
    "jerk": "jerk over its limit",
}

Runs = dict[str, dict[int, dict[str, Any]]]  # by algorithm and seed
Summary = dict[str, dict[str, Any]]  # by algorithm


def write(folder: Path, comparison: Comparison) -> None:
    """comparison.json, curves.csv, comparison.html and its figures in a comparison's folder. Raises OSError."""
    runs = {
        name: {seed: _read(folder / name / f"seed{seed}") for seed in comparison.seeds}
        for name in comparison.algorithms
    }
    summary = {name: _summarise(seeds) for name, seeds in runs.items()}
    run_dir.write_json(folder / "comparison.json", {"name": comparison.name, "algorithms": summary})
    with replacing(folder / "curves.csv") as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("algorithm", "seed", *CURVE))
        for name, seeds in runs.items():
            for seed, run in seeds.items():
                writer.writerows((name, seed, *(point[key] for key in CURVE)) for point in run["curve"])
    _page(comparison, runs, summary).write(folder / "comparison.html", folder)


def _read(folder: Path) -> dict[str, Any]:
    training, evaluation = (json.loads((folder / f"{name}.json").read_text()) for name in ("training", "evaluation"))
    return {"curve": training["curve"], **{key: evaluation[key] for key in (*WORLDS, "restlessness")}}


def _summarise(by_seed: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Over the seeds: what was spent, and per world the balls of all of them together and the rate of each."""
    runs, worlds = list(by_seed.values()), {}
    for world in WORLDS:
        parts = [run[world] for run in runs]
        balls, returned = sum(p["episodes"] for p in parts), sum(p["outcomes"]["returned"] for p in parts)
        low, high = wilson(returned, balls)
        worlds[world] = {
            "return_rate": returned / balls,
            "low": low,
            "high": high,
            "by_seed": {str(seed): run[world]["return_rate"] for seed, run in by_seed.items()},
            "hit_rate": _mean([p["hit_rate"] for p in parts]),
            "mean_return": _mean([p["mean_return"] for p in parts]),
            "non_finite": sum(p["non_finite"] for p in parts),
        }
    spent = {key: _mean([run["curve"][-1][key] for run in runs]) for key in SPENT}
    restless = {key: _mean([run["restlessness"][key] for run in runs]) for key in RESTLESSNESS}
    return {"spent": spent, **worlds, "restlessness": restless}


def _mean(values: list[float | None]) -> float | None:
    """Over what is known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _page(comparison: Comparison, runs: Runs, summary: Summary) -> Page:
    budget, several = comparison.budget, len(comparison.seeds) > 1
    limits = [] if budget.minutes is None else [f"{60 * budget.minutes:g} s ({budget.clock} time)"]
    limits += [] if budget.episodes is None else [f"{budget.episodes:,} episodes"]
    seeds = ", ".join(map(str, comparison.seeds))
    page = Page(comparison.name, f"Seeds {seeds}; each training at most {' or '.join(limits)}")
    page.section("results", "Results")
    page.paragraph(
        "Rates with the 95 % interval (Wilson) of the balls of all seeds together. The interval does not hold the "
        "spread between seeds" + ("; their range stands in brackets." if several else ": one seed does not show it.")
    )
    rows = []
    for name, part in summary.items():
        spent, simulated = part["spent"], part["simulation"]
        cells = [f"{spent[key]:,.0f}" for key in ("episodes", "seconds", "cpu_seconds")]
        cells += [f"{simulated['hit_rate']:.1%}", *(_rate(part[world]) for world in WORLDS)]
        rows.append([name, *cells, _number(simulated["mean_return"])])
    head = ("algorithm", "episodes", "seconds", "processor s", "touched", "returned", "in reality", "mean return")
    page.add(table(head, rows, range(1, len(head))))
    colours = dict(zip(runs, cycle(COLOURS), strict=False))
    with matplotlib.rc_context(STYLE):
        curves, transfer = _draw_curves(runs, colours, budget.clock), _draw_transfer(summary, colours)
        restlessness = _draw_restlessness(summary, colours)
    page.add(page.picture("transfer", transfer, "Returned balls, 95 % interval; dots: seeds.", "bars of return rates"))
    page.section("curves", "Learning curves")
    caption = "The policy without exploration, on balls that no training drew."
    page.add(page.picture("curves", curves, caption, "rates and returns against episodes and time"))
    page.section("smoothness", "Smoothness")
    found = [[name, *(_number(part["restlessness"][key]) for key in RESTLESSNESS)] for name, part in summary.items()]
    page.add(table(("algorithm", *RESTLESSNESS.values()), found, range(1, 1 + len(RESTLESSNESS))))
    page.add(page.picture("restlessness", restlessness, "Less is smoother.", "bars of restlessness"))
    return page


def _rate(found: dict[str, Any]) -> str:
    rates = found["by_seed"].values()
    spread = f" [{min(rates):.1%} to {max(rates):.1%}]" if len(rates) > 1 else ""
    return f"{found['return_rate']:.1%} ({found['low']:.1%} to {found['high']:.1%}){spread}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _draw_curves(runs: Runs, colours: dict[str, str], clock: str) -> Figure:
    """Rates and mean return against episodes and against training time."""
    figure = Figure(figsize=(WIDTH, 8.0), layout="constrained")
    grid = figure.subplots(3, 2, sharex="col", sharey="row")
    columns = {"episodes": "episodes", "seconds" if clock == "wall" else "cpu_seconds": f"{clock} time [s]"}
    for row, (measure, label) in zip(grid, MEASURES.items(), strict=True):
        for axes, x in zip(row, columns, strict=True):
            for name, seeds in runs.items():
                for i, run in enumerate(seeds.values()):
                    # A logarithmic axis has no place for the evaluation before any episode.
                    points = [p for p in run["curve"] if p[measure] is not None and (p[x] > 0 or x != "episodes")]
                    at, value = ([p[key] for p in points] for key in (x, measure))
                    axes.plot(at, value, "o-", markersize=3, color=colours[name], label="_" * bool(i) + name)
            axes.grid(axis="y", alpha=0.25)
        row[0].set_ylabel(label)
        if measure != "mean_return":
            row[0].set_ylim(bottom=0.0)
            row[0].yaxis.set_major_formatter(PercentFormatter(1.0))
    ends = [run["curve"][-1]["mean_return"] for seeds in runs.values() for run in seeds.values()]
    known = [value for value in ends if value is not None]
    if known:  # random policies collide all the time; they would take all the room
        grid[2, 0].set_ylim(min(known) - 2, max(known) + 1)
    grid[2, 0].set_xscale("log")
    for axes, label in zip(grid[2], columns.values(), strict=True):
        axes.set_xlabel(label)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure


def _draw_bars(axes: Axes, heights: dict[str, float], colours: dict[str, str], title: str) -> None:
    axes.bar(list(heights), list(heights.values()), width=0.62, color=[colours[name] for name in heights])
    axes.tick_params(axis="x", labelrotation=45)
    axes.grid(axis="y", alpha=0.25)
    axes.set_title(title)


def _draw_transfer(summary: Summary, colours: dict[str, str]) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    for axes, (world, title) in zip(figure.subplots(1, 2, sharey=True), WORLDS.items(), strict=True):
        found = {name: part[world] for name, part in summary.items()}
        _draw_bars(axes, {name: part["return_rate"] for name, part in found.items()}, colours, f"Returned {title}")
        for at, part in enumerate(found.values()):
            rate, rates = part["return_rate"], list(part["by_seed"].values())
            axes.errorbar(at, rate, [[rate - part["low"]], [part["high"] - rate]], color=INK, capsize=4)
            axes.plot([at + 0.2] * len(rates), rates, "o", markersize=4, color=INK, markerfacecolor="white")
            top = max(part["high"], *rates)
            axes.annotate(f"{rate:.1%}", (at, top), (0, 5), textcoords="offset points", ha="center", fontsize=9)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_ylim(0.0, max(0.05, 1.05 * axes.get_ylim()[1]))
    return figure


def _draw_restlessness(summary: Summary, colours: dict[str, str]) -> Figure:
    figure = Figure(figsize=(WIDTH, 6.0), layout="constrained")
    for axes, (key, title) in zip(figure.subplots(2, 2).flat, RESTLESSNESS.items(), strict=True):
        heights = {name: part["restlessness"][key] or 0.0 for name, part in summary.items()}
        _draw_bars(axes, heights, colours, title)
        if key == "action_change":
            axes.set_yscale("log")  # from one algorithm to another by orders of magnitude
    return figure
