"""Pictures of the human models: how M0, M1 and M2 bound the balls, here and in the paper, and how far they move."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ballmodel.distribution import AXES
from experiments.study.analysis.claims import Measurements, paper_changes
from experiments.study.analysis.statistics import t_mean
from experiments.study.analysis.study_folder import ROUNDS, Study, numbers, paper_models
from experiments.study.report.style import styled
from mjx_tt.viz.html import FAINT, INK

SHADES = {"M0": "#9ecae1", "M1": "#4292c6", "M2": "#08519c"}
UNITS = {"position": "m", "velocity": "m/s", "landing": "m"}


@styled
def evolution(study: Study, m: Measurements) -> Figure | None:
    """The bounds of each quantity in M0, M1 and M2, player by player, the paper's beside ours (sim_param_evolution)."""
    fitted = {player: [study.models_of(seed, player) for seed in study.seeds] for player in study.players}
    if not any(models for by_seed in fitted.values() for models in by_seed):
        return None
    figure = Figure(figsize=(11, 9.6))
    grid = figure.subplots(4, 2).ravel()
    quantities = [(part, axis) for part, axes in AXES.items() for axis in axes]
    for k, (axes, (part, axis)) in enumerate(zip(grid, quantities, strict=True)):
        for i, player in enumerate(study.players):
            for j, name in enumerate(ROUNDS):
                at = i + 0.26 * (j - 1)
                low, high = numbers(paper_models(player)[name])[2 * k : 2 * k + 2]
                axes.bar(at + 0.05, high - low, 0.09, low, facecolor="white", edgecolor=INK, linewidth=0.9)
                found = np.array(
                    [numbers(models[name])[2 * k : 2 * k + 2] for models in fitted[player] if name in models]
                )
                if found.size:
                    low, high = found.mean(axis=0)
                    axes.bar(at - 0.05, high - low, 0.09, low, color=SHADES[name])
                    if len(found) > 1:
                        for end, value in zip(found.T, (low, high), strict=True):
                            axes.errorbar(
                                at - 0.05, value, [[value - end.min()], [end.max() - value]], color=INK, linewidth=0.8
                            )
        axes.set_xticks(range(len(study.players)), [f"player {p[-1]}" for p in study.players])
        axes.use_sticky_edges = False
        axes.margins(y=0.06)
        axes.set_ylabel(f"{part} {axis} [{UNITS[part]}]")
        axes.grid(axis="y", alpha=0.25)
    handles = [Patch(facecolor=SHADES[name], label=f"{name}, here") for name in ROUNDS]
    handles.append(Patch(facecolor="white", edgecolor=INK, label="the paper's, beside it"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


@styled
def changes(study: Study, m: Measurements) -> Figure | None:
    """Changes of the human model from M0 to M1 and from M1 to M2, here and in the paper."""
    if not m.changes:
        return None
    figure = Figure(figsize=(10, 3.5))
    axes = figure.subplots()
    shown = [p for p in study.players if any(player == p for _, player in m.changes)]
    for i, player in enumerate(shown):
        ours = np.array([values for (_, p), values in m.changes.items() if p == player])
        for j, name in enumerate(("M1", "M2")):
            _change(axes, i + (-0.32, 0.08)[j], ours[:, j], SHADES[name])
            axes.bar(
                i + (-0.14, 0.26)[j], paper_changes(player)[j], 0.16, facecolor="white", edgecolor=INK, linewidth=0.9
            )
    axes.set_xticks(range(len(shown)), [f"player {p[-1]}" for p in shown])
    axes.set_ylabel("change [share of the width]")
    axes.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
    handles: list[Patch | Line2D] = [
        Patch(facecolor=SHADES["M1"], label="M0 to M1"),
        Patch(facecolor=SHADES["M2"], label="M1 to M2"),
        Patch(facecolor="white", edgecolor=INK, label="the paper's"),
    ]
    if len(study.seeds) > 1:
        handles.append(Line2D([], [], color=INK, label="95 % over seeds"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


@styled
def calibration(content: dict[str, Any]) -> Figure | None:
    """Virtual players against the paper's: deviations of the 16 numbers, and the rally statistics."""
    numbers_, lengths = content.get("numbers", []), content.get("rallies", [])
    if not numbers_ or not lengths:
        return None
    names = list(dict.fromkeys(row["player"] for row in numbers_))
    figure = Figure(figsize=(11, 3.8))
    left, right = figure.subplots(1, 2)
    for i, name in enumerate(names):
        for j, model in enumerate(ROUNDS):
            values = [100 * r["deviation"] for r in numbers_ if r["player"] == name and r["model"] == model]
            at = i + 0.26 * (j - 1)
            left.scatter(np.full(len(values), at), values, s=9, color=SHADES[model], linewidth=0)
            if values:
                left.plot([at - 0.1, at + 0.1], [np.median(values)] * 2, color=INK, linewidth=1.6)
        for j, statistic in enumerate(("p25", "mean", "p75")):
            for row in lengths:
                if row["player"] == name and row["statistic"] == statistic:
                    at = i + 0.22 * (j - 1)
                    right.bar(at, row["reached"], 0.2, color=FAINT)
                    right.plot(at, row["target"], "D", color=INK, markerfacecolor="white", markersize=5, zorder=5)
    left.axhline(15.0, color=INK, linestyle=":", linewidth=0.8)
    left.set_ylabel("deviation [% of the range]")
    left.set_title("The 16 numbers of M0, M1, M2; lines: medians")
    right.set_title("Rally length: quartile, mean, quartile; diamonds: paper")
    right.set_ylabel("rally length")
    for axes in (left, right):
        axes.set_xticks(range(len(names)), [f"player {p[-1]}" for p in names])
    figure.legend(handles=[Patch(facecolor=SHADES[m], label=m) for m in ROUNDS], loc="outside lower left", ncols=3)
    return figure


def _change(axes: Axes, at: float, values: np.ndarray, shade: str) -> None:
    axes.bar(at, values.mean(), 0.16, color=shade)
    if values.size > 1:
        t = t_mean(values)
        axes.errorbar(
            at, t.value, [[min(t.value - t.low, t.value)], [t.high - t.value]], color=INK, linewidth=1.1, capsize=2.5
        )
