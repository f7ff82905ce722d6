"""The paper's figures of rally lengths: by method, skill, checkpoint, player and evaluator; the ablation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ballmodel import registry
from experiments.study.analysis.claims import Measurements
from experiments.study.analysis.paper import (
    ABLATED,
    ABLATION,
    BOUND,
    BY_KEY,
    CROSS,
    FINAL,
    FRESH,
    IDENTIFIED,
    IS2R,
    LAST,
    LEVELS,
    ORACLE,
    OTHER_WORLDS,
    RANDOMISED,
    S2R,
    SHORT,
    TEN,
)
from experiments.study.analysis.study_folder import Study
from experiments.study.report.style import (
    COLOUR,
    PAPER_MARK,
    bar,
    bars,
    boxes,
    colour,
    error_bars,
    evaluated,
    has,
    interval_of,
    lengths,
    level_label,
    mean_of,
    note_empty,
    of_player,
    patches,
    played,
    player_label,
    styled,
)
from mjx_tt.viz.html import FAINT, INK

LONGEST = 60  # touches; last bin of the histogram
NAMES = {
    IS2R: "i-S2R",
    S2R: "S2R (+FT)",
    ORACLE: "S2R-Oracle (+FT)",
    FRESH: "weights not carried back",
    IDENTIFIED: "i-S2R with identification",
    RANDOMISED: "i-S2R in worlds of the prior",
    BOUND: "i-S2R in reality itself",
    ABLATION: "ablation",
}
STAGES = ("sim 1", "fine-tuned\n35 %", "sim 2", "fine-tuned\n65 %", "sim 3", "fine-tuned\n100 %")
CURVES = {
    IS2R: ("is2r-sim1", "is2r-ft35", "is2r-sim2", "is2r-ft65", "is2r-sim3", "is2r-ft100"),
    S2R: ("is2r-sim1", "is2r-ft35", None, "s2r-ft65", None, "s2r-ft100"),
    ORACLE: (None, None, None, None, "oracle-sim", "oracle-ft"),
    FRESH: ("is2r-sim1", "is2r-ft35", "fresh-sim2", "fresh-ft65", "fresh-sim3", "fresh-ft100"),
}


def _prefix(method: str) -> str:
    return {IS2R: "is", S2R: "s2", ORACLE: "or", FRESH: "fr"}[method]


@styled
def aggregated(study: Study, m: Measurements) -> Figure | None:
    """Boxes of the rally lengths, raw and normalised, and their histogram (all_player_results)."""
    if not has(m.raw, LAST):
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.25))
    keys, normalised = played(m.raw, LAST), played(m.normalised, LAST)
    boxes(left, [lengths(m.raw, key, "all") for key in keys], keys, "rally length", log=True)
    left.set_title("Rally length, all players")
    boxes(centre, [lengths(m.normalised, key, "all") for key in normalised], normalised, "normalised rally length")
    centre.set_title("Normalised by player")
    _histogram(right, m)
    if right.has_data():
        figure.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=2)
    return figure


def _histogram(axes: Axes, m: Measurements) -> None:
    edges = np.array([2, *range(5, LONGEST + 1, 5), LONGEST + 1])
    shown = played(m.raw, ("is2r-ft100", "s2r-ft100", "id-ft100"))
    width = 0.84 / max(len(shown), 1)
    for k, key in enumerate(shown):
        values = lengths(m.raw, key, "all")
        share = np.histogram(np.clip(values, edges[0], LONGEST), edges)[0] / values.size
        place = np.arange(share.size) + (k - 0.5 * (len(shown) - 1)) * width
        axes.bar(place, 100 * share, 0.95 * width, color=colour(key), label=SHORT[key])
    names = [f"{a}-{b - 1}" for a, b in pairwise(edges[:-1])] + [f"{LONGEST}+"]
    axes.set_xticks(range(len(names)), names, rotation=60, fontsize=8)
    axes.set_xlabel("rally length")
    axes.set_ylabel("rallies [%]")
    axes.set_title("Histogram")


@styled
def means(study: Study, m: Measurements, group: str = "all") -> Figure | None:
    """Mean normalised length, its boxes, mean length (app_summary; without the advanced player: its outlier figure)."""
    if not has(m.raw, LAST):
        return None
    figure = Figure(figsize=(11, 3.7))
    left, centre, right = figure.subplots(1, 3)
    keys, normalised = played(m.raw, LAST), played(m.normalised, LAST)
    bars(left, [mean_of(m.normalised, key, group) for key in normalised], normalised, "normalised rally length")
    left.set_title("Mean normalised rally length")
    boxes(centre, [lengths(m.normalised, key, group) for key in normalised], normalised, "normalised rally length")
    centre.set_title("Normalised rally length")
    bars(right, [mean_of(m.raw, key, group) for key in keys], keys, "rally length")
    right.set_title("Mean rally length")
    return figure


@styled
def by_skill(study: Study, m: Measurements) -> Figure | None:
    """Boxes above, means below, by skill level (main_summary_by_skill_level, app_summary_by_skill_level_means)."""
    keys = played(m.raw, LAST)
    if not keys:
        return None
    figure = Figure(figsize=(11, 6.8))
    for column, (upper, lower) in zip(LEVELS, figure.subplots(2, 3).T, strict=True):
        boxes(upper, [lengths(m.raw, key, column) for key in keys], keys, "rally length", log=True)
        upper.set_title(level_label(column))
        bars(lower, [mean_of(m.raw, key, column) for key in keys], keys, "mean rally length, 95 %")
    return figure


@styled
def checkpoints(study: Study, m: Measurements, normalise: bool = False) -> Figure | None:
    """Mean rally length at the key checkpoints by skill level (main_training_curves)."""
    if not has(m.raw, (*TEN, *filter(None, CURVES[FRESH]))):
        return None
    figure = Figure(figsize=(11, 4.2))
    for axes, name in zip(figure.subplots(1, 3), LEVELS, strict=True):
        shift = dict(zip(CURVES, (-0.06, 0.06, 0.0, -0.14), strict=True))
        for method, keys in CURVES.items():
            found = [
                (i, key, mean)
                for i, key in enumerate(keys)
                if key is not None and (mean := mean_of(m.raw, key, name)) is not None
            ]
            if not found or (method == FRESH and not any(key.startswith("fresh") for _, key, _ in found)):
                continue
            x = np.array([i for i, *_ in found]) + shift[method]
            y, err = error_bars([mean for *_, mean in found])
            dashed = method in (FRESH, S2R)
            axes.errorbar(
                x, y, err, color=COLOUR[method], linestyle="--" if dashed else "-", linewidth=1.6, capsize=2.5
            )
            for at, value, (_, key, _) in zip(x, y, found, strict=True):
                full = BY_KEY[key].fine_tuned
                axes.plot(
                    at,
                    value,
                    "o",
                    color=COLOUR[method],
                    markerfacecolor=COLOUR[method] if full else "white",
                    markersize=6,
                )
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=7.5)
        axes.set_ylim(bottom=0)
        axes.set_title(level_label(name))
        axes.grid(axis="y", alpha=0.25)
        note_empty(axes)
    figure.axes[0].set_ylabel("mean rally length, 95 %")
    there = [
        method
        for method in CURVES
        if any(m.raw.mean(k, study.players) for k in CURVES[method] if k and k[:2] == _prefix(method))
    ]
    handles = [
        Line2D([], [], color=COLOUR[k], linestyle="--" if k in (FRESH, S2R) else "-", label=NAMES[k]) for k in there
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles) or 1)
    return figure


@styled
def cross(study: Study, m: Measurements) -> Figure | None:
    """Own and cross-evaluations: mean length, mean normalised length, share that is kept (main_cross_eval_summary)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    figure = Figure(figsize=(11, 3.9))
    left, centre, right = figure.subplots(1, 3)
    for axes, boot, name in (
        (left, m.raw, "mean rally length"),
        (centre, m.cross_normalised, "normalised rally length"),
    ):
        for k, key in enumerate(FINAL):
            for own, offset in ((True, -0.2), (False, 0.2)):
                bar(
                    axes,
                    k + offset,
                    interval_of(boot.mean(key, study.players, own)),
                    colour(key),
                    0.38,
                    hatch=None if own else "///",
                )
        axes.set_xticks(range(3), [SHORT[key] for key in FINAL], fontsize=8.5)
        axes.set_ylabel(f"{name}, 95 %")
        axes.axhline(0.0, color=FAINT, linewidth=0.8)
    left.set_title("Mean rally length")
    centre.set_title("Normalised by the trainer's own")
    paper = {"is2r-ft100": 0.70, "s2r-ft100": 0.30}
    for k, key in enumerate(FINAL):
        bar(right, k, interval_of(m.ratio(key, key, "all", False, True)), colour(key), 0.6)
        if key in paper:
            right.plot(k + 0.38, paper[key], "D", color=INK, markerfacecolor="white", markersize=6, zorder=5)
    right.axhline(1.0, color=FAINT, linewidth=0.8)
    right.set_xticks(range(3), [SHORT[key] for key in FINAL], fontsize=8.5)
    right.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
    right.set_title("Kept with other players")
    handles = [
        Patch(facecolor="#aaaaaa", label="own trainer"),
        Patch(facecolor="#aaaaaa", hatch="///", edgecolor="white", label="other players"),
        PAPER_MARK,
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@styled
def cross_by_player(study: Study, m: Measurements) -> Figure | None:
    """Mean and normalised length of each trainer's policies with each evaluator (app:cross_eval_details)."""
    if not any(cell[1] != cell[2] for cell in m.raw.cells):
        return None
    trainers = study.players
    figure = Figure(figsize=(10, 2.2 * len(trainers)))
    grid = figure.subplots(len(trainers), 2, squeeze=False)
    for (left, right), trainer in zip(grid, trainers, strict=True):
        evaluators = (trainer, *CROSS[trainer])
        for axes, boot in ((left, m.raw), (right, m.cross_normalised)):
            for i, evaluator in enumerate(evaluators):
                for k, key in enumerate(FINAL):
                    bar(axes, i + 0.27 * (k - 1), evaluated(boot, trainer, evaluator, key), colour(key), 0.25)
            axes.set_xticks(
                range(len(evaluators)), [f"player {e[-1]}" + (" (own)" if e == trainer else "") for e in evaluators]
            )
            axes.axhline(0.0, color=FAINT, linewidth=0.8)
        left.set_ylabel("rally length")
        right.set_ylabel("normalised")
        left.set_title(f"Trained by {player_label(trainer)}: mean rally length")
        right.set_title("normalised by the trainer's own")
    figure.legend(handles=patches(FINAL), loc="outside lower center", ncols=3)
    return figure


@styled
def by_player(study: Study, m: Measurements) -> Figure | None:
    """Mean and distribution of the rally length of each model, player by player (app:trainer_details)."""
    keys = played(m.raw, (*TEN, *(model.key for model in OTHER_WORLDS)))
    if not keys:
        return None
    figure = Figure(figsize=(11, 2.35 * len(study.players)))
    grid = figure.subplots(len(study.players), 2, squeeze=False)
    for row, ((left, right), player) in enumerate(zip(grid, study.players, strict=True)):
        last = row == len(study.players) - 1
        bars(left, [evaluated(m.raw, player, player, key) for key in keys], keys, "mean, 95 %", last)
        boxes(right, [of_player(m.raw, player, key) for key in keys], keys, "rally length", log=True, labelled=last)
        left.set_title(f"{player_label(player).capitalize()}")
        left.axhline(registry.skill(player).mean, color=INK, linestyle="--", linewidth=1.0)
    line = Line2D([], [], color=INK, linestyle="--", linewidth=1.0, label="paper: mean over the ten models")
    figure.legend(handles=[line], loc="outside lower left")
    return figure


@styled
def ablation(study: Study, m: Measurements) -> Figure | None:
    """Zero-shot rally length by the distribution trained on (arbitarary_distributions)."""
    keys = [model.key for model in ABLATED]
    means = [interval_of(m.raw.mean(key, study.players)) for key in keys]
    if all(mean is None for mean in means):
        return None
    figure = Figure(figsize=(8.5, 3.6))
    left, right = figure.subplots(1, 2)
    bars(left, means, keys, "mean rally length, 95 %")
    left.set_title("Zero-shot, mean")
    boxes(right, [lengths(m.raw, key, "all") for key in keys], keys, "rally length", log=True)
    right.set_title("Zero-shot, distribution")
    oracle = means[keys.index("oracle")]
    if oracle is not None:
        left.plot(
            keys.index("large"), 0.6 * oracle.value, "D", color=INK, markerfacecolor="white", markersize=7, zorder=5
        )
        figure.legend(
            handles=[
                Line2D(
                    [],
                    [],
                    color=INK,
                    marker="D",
                    markerfacecolor="white",
                    linestyle="",
                    label="paper: Large 40 % below the Oracle's",
                )
            ],
            loc="outside lower center",
        )
    return figure
