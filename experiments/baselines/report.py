"""Results of a comparison of algorithms: a page with a table and learning curves, made from the finished runs alone."""

from __future__ import annotations

import json
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments.config.baselines import Comparison
from experiments.runs import run_dir
from experiments.stats import wilson
from mjx_tt.viz.html import STYLE, WIDTH, Page, table

COLOURS = ("#1b7837", "#7fbf7b", "#762a83", "#2166ac", "#b35806", "#b2182b", "#542788", "#4d4d4d")
WORLDS = ("simulation", "reality")
SPENT = ("episodes", "steps", "seconds", "cpu_seconds")

Runs = dict[str, dict[int, dict[str, Any]]]  # by algorithm and seed
Summary = dict[str, dict[str, Any]]  # by algorithm


def write(folder: Path, comparison: Comparison) -> None:
    """comparison.json, comparison.html and its figures in a comparison's folder. Raises OSError."""
    runs = {
        name: {seed: _read(folder / name / f"seed{seed}") for seed in comparison.seeds}
        for name in comparison.algorithms
    }
    summary = {name: _summarise(seeds) for name, seeds in runs.items()}
    run_dir.write_json(folder / "comparison.json", {"name": comparison.name, "algorithms": summary})
    _page(comparison, runs, summary).write(folder / "comparison.html", folder)


def _read(folder: Path) -> dict[str, Any]:
    training, evaluation = (json.loads((folder / f"{name}.json").read_text()) for name in ("training", "evaluation"))
    return {"curve": training["curve"], **{key: evaluation[key] for key in WORLDS}}


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
    return {"spent": spent, **worlds}


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
        rows.append([name, *cells])
    head = ("algorithm", "episodes", "seconds", "processor s", "touched", "returned", "in reality")
    page.add(table(head, rows, range(1, len(head))))
    with matplotlib.rc_context(STYLE):
        curves = _draw_curves(runs, budget.clock)
    page.section("curves", "Learning curves")
    caption = "The policy without exploration, on balls that no training drew."
    page.add(page.picture("curves", curves, caption, "return rates against episodes and time"))
    return page


def _rate(found: dict[str, Any]) -> str:
    rates = found["by_seed"].values()
    spread = f" [{min(rates):.1%} to {max(rates):.1%}]" if len(rates) > 1 else ""
    return f"{found['return_rate']:.1%} ({found['low']:.1%} to {found['high']:.1%}){spread}"


def _draw_curves(runs: Runs, clock: str) -> Figure:
    """Return rate against episodes and against training time."""
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    columns = {"episodes": "episodes", "seconds" if clock == "wall" else "cpu_seconds": f"{clock} time [s]"}
    left, right = grid = figure.subplots(1, 2, sharey=True)
    for axes, (x, label) in zip(grid, columns.items(), strict=True):
        for (name, seeds), colour in zip(runs.items(), cycle(COLOURS), strict=False):
            for i, run in enumerate(seeds.values()):
                # A logarithmic axis has no place for the evaluation before any episode.
                points = [p for p in run["curve"] if p[x] > 0 or x != "episodes"]
                at, value = ([p[key] for p in points] for key in (x, "return_rate"))
                axes.plot(at, value, "o-", markersize=3, color=colour, label="_" * bool(i) + name)
        axes.set_xlabel(label)
        axes.grid(axis="y", alpha=0.25)
    left.set_xscale("log")
    left.set_ylabel("returned")
    left.set_ylim(bottom=0.0)
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    figure.legend(*right.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return figure
