"""Figures of the human models: how M0, M1 and M2 bound the balls, here and in the paper, and how far they move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.study.analysis.claims import Measurements, paper_changes
from experiments.study.analysis.statistics import Interval, t_mean
from experiments.study.analysis.study_folder import QUANTITIES, ROUNDS, numbers, paper_models
from experiments.study.report.plots import (
    HOLLOW,
    HUMAN_MODEL_COLOURS,
    add_legend,
    error_lengths,
    line,
    mark_paper,
    patch,
    show_percent,
)
from mjx_tt.viz.html import FAINT, INK


def draw_evolution(m: Measurements) -> Figure | None:
    """The bounds of each quantity in M0, M1 and M2, player by player, the paper's beside ours (sim_param_evolution)."""
    players = m.study.players
    fitted = {player: [m.study.models_of(seed, player) for seed in m.study.seeds] for player in players}
    if not any(models for by_seed in fitted.values() for models in by_seed):
        return None
    figure = Figure(figsize=(11, 9.6))
    for k, (axes, quantity) in enumerate(zip(figure.subplots(4, 2).ravel(), QUANTITIES, strict=True)):
        for i, player in enumerate(players):
            theirs = paper_models(player)
            for j, name in enumerate(ROUNDS):
                at = i + 0.26 * (j - 1)
                low, high = numbers(theirs[name])[2 * k : 2 * k + 2]
                axes.bar(at + 0.05, high - low, 0.09, low, **HOLLOW)
                ends = np.array(
                    [numbers(models[name])[2 * k : 2 * k + 2] for models in fitted[player] if name in models]
                )
                if not ends.size:
                    continue
                low, high = ends.mean(axis=0)
                axes.bar(at - 0.05, high - low, 0.09, low, color=HUMAN_MODEL_COLOURS[name])
                for end, value in zip(ends.T, (low, high), strict=True):
                    if len(end) > 1:
                        spread = error_lengths(Interval(value, end.min(), end.max()))
                        axes.errorbar(at - 0.05, value, spread, color=INK, linewidth=0.8)
        _label_players(axes, players)
        axes.use_sticky_edges = False
        axes.margins(y=0.06)
        axes.set_ylabel(f"{quantity} [{'m/s' if quantity.startswith('velocity') else 'm'}]")
        axes.grid(axis="y", alpha=0.25)
    handles = [patch(f"{name}, here", HUMAN_MODEL_COLOURS[name]) for name in ROUNDS]
    add_legend(figure, [*handles, patch("the paper's, beside it", "white", edgecolor=INK)])
    return figure


def draw_changes(m: Measurements) -> Figure | None:
    """Changes of the human model from M0 to M1 and from M1 to M2, here and in the paper."""
    players = [p for p in m.study.players if any(player == p for _, player in m.changes)]
    if not players:
        return None
    figure = Figure(figsize=(10, 3.5))
    axes = figure.subplots()
    for i, player in enumerate(players):
        ours = np.array([values for (_, p), values in m.changes.items() if p == player])
        for name, at, values, theirs in zip(ROUNDS[1:], (-0.32, 0.08), ours.T, paper_changes(player), strict=True):
            axes.bar(i + at, values.mean(), 0.16, color=HUMAN_MODEL_COLOURS[name])
            if values.size > 1:
                mean = t_mean(values)
                (below,), above = error_lengths(mean)
                lengths = [[min(below, mean.value)], above]  # a change is not negative
                axes.errorbar(i + at, mean.value, lengths, color=INK, linewidth=1.1, capsize=2.5)
            axes.bar(i + at + 0.18, theirs, 0.16, **HOLLOW)
    _label_players(axes, players)
    axes.set_ylabel("change [share of the width]")
    show_percent(axes.yaxis)
    handles = [patch("M0 to M1", HUMAN_MODEL_COLOURS["M1"]), patch("M1 to M2", HUMAN_MODEL_COLOURS["M2"])]
    handles.append(patch("the paper's", "white", edgecolor=INK))
    add_legend(figure, [*handles, line("95 % over seeds")] if len(m.study.seeds) > 1 else handles)
    return figure


def draw_calibration(m: Measurements) -> Figure | None:
    """Virtual players against the paper's: deviations of the 16 numbers, and the rally statistics."""
    content = m.study.calibration
    deviations, lengths = content.get("numbers"), content.get("rallies")
    if not deviations or not lengths:
        return None
    players = list(dict.fromkeys(row["player"] for row in deviations))
    figure = Figure(figsize=(11, 3.8))
    left, right = figure.subplots(1, 2)
    for i, player in enumerate(players):
        for j, model in enumerate(ROUNDS):
            at = i + 0.26 * (j - 1)
            values = [100 * r["deviation"] for r in deviations if (r["player"], r["model"]) == (player, model)]
            left.scatter(np.full(len(values), at), values, s=9, color=HUMAN_MODEL_COLOURS[model], linewidth=0)
            if values:
                left.plot([at - 0.1, at + 0.1], [np.median(values)] * 2, color=INK, linewidth=1.6)
        for j, statistic in enumerate(("p25", "mean", "p75")):
            for row in lengths:
                if (row["player"], row["statistic"]) == (player, statistic):
                    at = i + 0.22 * (j - 1)
                    right.bar(at, row["reached"], 0.2, color=FAINT)
                    mark_paper(right, at, row["target"], 5)
    left.axhline(15.0, color=INK, linestyle=":", linewidth=0.8)
    left.set_ylabel("deviation [% of the range]")
    left.set_title("The 16 numbers of M0, M1, M2; lines: medians")
    right.set_title("Rally length: quartile, mean, quartile; diamonds: paper")
    right.set_ylabel("rally length")
    for axes in (left, right):
        _label_players(axes, players)
    add_legend(figure, [patch(model, HUMAN_MODEL_COLOURS[model]) for model in ROUNDS], "left")
    return figure


def _label_players(axes: Axes, players: Sequence[str]) -> None:
    axes.set_xticks(range(len(players)), [f"player {p[-1]}" for p in players])
