"""The paper's main figures with ours. ``FIGURES`` names them all; a figure is None where the study holds nothing of it.

One colour per method everywhere (``paper.yaml``); paler where a model is not fine-tuned. White diamonds and hollow bars
are the paper's. Boxes are the paper's: white circle the mean, line the median, box the quartiles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.study.analysis import paper
from experiments.study.analysis.claims import RATIO, Measurements
from experiments.study.analysis.statistics import Estimate, Interval
from experiments.study.analysis.study_folder import QUANTITIES, ROUNDS, numbers, paper_models
from mjx_tt.viz.html import FAINT, INK
from mjx_tt.viz.html import STYLE as PAGE_STYLE

STYLE = PAGE_STYLE | {"figure.constrained_layout.use": True, "axes.titleweight": "bold", "font.size": 9.5}
DIAMOND: dict[str, Any] = {"marker": "D", "color": INK, "markerfacecolor": "white", "linestyle": ""}
MEAN = "mean rally length, 95 %"
STAGES = ("sim 1", "fine-tuned\n35 %", "sim 2", "fine-tuned\n65 %", "sim 3", "fine-tuned\n100 %")
CURVES: dict[str, tuple[str | None, ...]] = {  # of each method at the stages
    paper.IS2R: paper.METHODS[paper.IS2R],
    paper.S2R: ("is2r-sim1", "is2r-ft35", None, "s2r-ft65", None, "s2r-ft100"),
    paper.ORACLE: (None, None, None, None, "oracle-sim", "oracle-ft"),
    paper.FRESH: ("is2r-sim1", "is2r-ft35", *paper.METHODS[paper.FRESH]),
    paper.IDENTIFIED: paper.METHODS[paper.IDENTIFIED],
}
HUMAN_MODEL_COLOURS = {"M0": "#9ecae1", "M1": "#4292c6", "M2": "#08519c"}


def draw_summary(m: Measurements) -> Figure | None:
    """The claims about ratios: ours with its interval, the paper's where it states a number."""
    shown = [(f, f.interval) for f in m.findings.values() if f.interval is not None and f.unit == RATIO]
    if not shown:
        return None
    figure = Figure(figsize=(10.5, 0.36 * len(shown) + 1.4))
    axes = figure.subplots()
    for row, (f, interval) in enumerate(shown):
        shade = colour(f.claim.of["a"]) if "a" in f.claim.of else INK
        lengths = error_lengths(interval)
        axes.errorbar(interval.value, row, xerr=lengths, fmt="o", color=shade, markersize=6, linewidth=2, capsize=3)
        if f.paper is not None:
            axes.plot(f.paper, row, **DIAMOND, markersize=7, zorder=6)
        axes.annotate(f.verdict, (1.01, row), xycoords=("axes fraction", "data"), va="center", fontsize=8.5, color=INK)
    axes.axvline(1.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_yticks(range(len(shown)), [f"{f.claim.key}: {f.claim.quantity}" for f, _ in shown], fontsize=8)
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.set_xscale("log")
    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", alpha=0.25)
    axes.set_xlabel("ratio (log scale), 95 % intervals; diamonds: the paper's numbers")
    return figure


def draw_methods(m: Measurements) -> Figure | None:
    """Rally lengths of the final policies, boxes above and means below, over all players and by skill level."""
    there = {cell[3] for cell in m.raw.cells}
    keys = [key for key in paper.LAST if key in there]
    if not keys:
        return None
    figure = Figure(figsize=(13, 6.8))
    for group, (upper, lower) in zip(("all", *paper.LEVELS), figure.subplots(2, 4).T, strict=True):
        players = paper.of_level(group)
        draw_boxes(upper, [m.raw.pooled(key, players) for key in keys], keys)
        upper.set_title(group_label(group))
        draw_bars(lower, [m.raw.mean(key, players) for key in keys], keys)
        for axes in (upper, lower):
            axes.set_xticks(range(len(keys)), [paper.SHORT[key] for key in keys], fontsize=8, rotation=20)
    figure.axes[0].set_ylabel("rally length")
    figure.axes[4].set_ylabel(MEAN)
    return figure


def draw_rounds(m: Measurements) -> Figure | None:
    """Mean rally length after each step of the loop, over all players and by skill level (main_training_curves)."""
    players = m.study.players
    # Methods of which the study has a model that is no other method's.
    shown = [k for k in CURVES if any(m.raw.mean(model, players) for model in paper.METHODS[k])]
    if not shown:
        return None
    figure = Figure(figsize=(14, 4.2))
    for axes, group in zip(figure.subplots(1, 4), ("all", *paper.LEVELS), strict=True):
        for k, method in enumerate(shown):
            means = {i: m.raw.mean(key, paper.of_level(group)) for i, key in enumerate(CURVES[method]) if key}
            found = {i + 0.08 * (k - 0.5 * len(shown)): (i, mean.interval) for i, mean in means.items() if mean}
            shade, dashes = paper.COLOURS[method], "--" if method in (paper.FRESH, paper.S2R) else "-"
            for at, (i, mean) in found.items():
                face = shade if i % 2 else "white"
                lengths = error_lengths(mean)
                axes.errorbar(at, mean.value, lengths, fmt="o", color=shade, markerfacecolor=face, capsize=2.5)
            axes.plot(list(found), [mean.value for _, mean in found.values()], dashes, color=shade, zorder=1)
        axes.set_xticks(range(len(STAGES)), STAGES, fontsize=7)
        axes.set_ylim(bottom=0)
        axes.set_title(group_label(group))
        axes.grid(axis="y", alpha=0.25)
        note_empty(axes)
    figure.axes[0].set_ylabel(MEAN)
    add_legend(figure, [Line2D([], [], color=paper.COLOURS[k], label=paper.LEGEND[k]) for k in shown])
    return figure


def draw_evolution(m: Measurements) -> Figure | None:
    """The bounds of each quantity in M0, M1 and M2, player by player, the paper's beside ours (sim_param_evolution)."""
    players = m.study.players
    fitted = {player: [m.study.models_of(seed, player) for seed in m.study.seeds] for player in players}
    if not any(models for by_seed in fitted.values() for models in by_seed):
        return None
    figure = Figure(figsize=(11, 9.6))
    for k, (axes, quantity) in enumerate(zip(figure.subplots(4, 2).ravel(), QUANTITIES, strict=True)):
        for i, player in enumerate(players):
            for j, (name, theirs) in enumerate(paper_models(player).items()):
                at = i + 0.26 * (j - 1)
                low, high = numbers(theirs)[2 * k : 2 * k + 2]
                axes.bar(at + 0.05, high - low, 0.09, low, facecolor="white", edgecolor=INK, linewidth=0.9)
                ours = [numbers(models[name])[2 * k : 2 * k + 2] for models in fitted[player] if name in models]
                if ours:
                    low, high = np.mean(ours, axis=0)
                    axes.bar(at - 0.05, high - low, 0.09, low, color=HUMAN_MODEL_COLOURS[name])
        axes.set_xticks(range(len(players)), [f"player {p[-1]}" for p in players])
        axes.use_sticky_edges = False
        axes.margins(y=0.06)
        axes.set_ylabel(f"{quantity} [{'m/s' if quantity.startswith('velocity') else 'm'}]")
        axes.grid(axis="y", alpha=0.25)
    handles = [Patch(facecolor=HUMAN_MODEL_COLOURS[name], label=f"{name}, here") for name in ROUNDS]
    add_legend(figure, [*handles, Patch(facecolor="white", edgecolor=INK, label="the paper's, beside it")])
    return figure


def colour(key: str) -> tuple[float, float, float]:
    """Colour of a model: its method's, paler where it is not fine-tuned."""
    method = paper.METHOD_OF[key]
    rgb = to_rgb(paper.COLOURS[method])
    pale = "-ft" not in key and method != paper.ABLATION
    red, green, blue = (share + 0.55 * (1.0 - share) if pale else share for share in rgb)
    return red, green, blue


def group_label(group: str) -> str:
    """A group of players, for titles."""
    if group == "all":
        return "All players"
    chosen = paper.of_level(group)
    return f"{group.capitalize()}: player{'s' if len(chosen) > 1 else ''} {', '.join(p[-1] for p in chosen)}"


def error_lengths(interval: Interval) -> list[list[float]]:
    """Lengths (2, 1) of an error bar below and above the value; zero where there is no interval."""
    below, above = interval.value - interval.low, interval.high - interval.value
    return [[max(x, 0.0) if np.isfinite(x) else 0.0] for x in (below, above)]


def draw_bars(axes: Axes, means: Sequence[Estimate | None], keys: Sequence[str]) -> None:
    """A bar with its interval for every model; a missing one leaves a gap."""
    for k, (mean, key) in enumerate(zip(means, keys, strict=True)):
        if mean is not None:
            axes.bar(k, mean.value, 0.76, color=colour(key), linewidth=0)
            lengths = error_lengths(mean.interval)
            axes.errorbar(k, mean.value, lengths, color=INK, linewidth=1.1, capsize=2.5)
    note_empty(axes)
    axes.axhline(0.0, color=FAINT, linewidth=0.8)


def draw_boxes(axes: Axes, samples: Sequence[np.ndarray], keys: Sequence[str]) -> None:
    """A box plot of rally lengths for every model, on a log scale. samples: (n,) of each key, empty without any."""
    for k, (values, key) in enumerate(zip(samples, keys, strict=True)):
        if values.size:
            axes.boxplot(
                values,
                positions=[k],
                widths=0.62,
                patch_artist=True,
                showmeans=True,
                manage_ticks=False,
                boxprops={"facecolor": colour(key)},
                medianprops={"color": INK},
                meanprops={"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK},
                flierprops={"marker": ".", "markersize": 2.5},
            )
    note_empty(axes)
    axes.set_yscale("log")
    ticks = (1, 2, 5, 10, 20, 50, 100, 200, 400)
    axes.set_yticks(ticks, [str(t) for t in ticks])
    axes.set_ylim(1.0, 1.3 * max([float(v.max()) for v in samples if v.size], default=2.0))
    axes.minorticks_off()


def note_empty(axes: Axes) -> None:
    """Says that the study has nothing to draw, where nothing was drawn."""
    if not axes.has_data():
        axes.text(0.5, 0.5, "not in this study", transform=axes.transAxes, ha="center", color=FAINT)


def add_legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """A legend below the axes."""
    figure.legend(handles=handles, ncols=len(handles), loc="outside lower center")


FIGURES: dict[str, Callable[[Measurements], Figure | None]] = {
    "summary": draw_summary,
    "methods": draw_methods,
    "rounds": draw_rounds,
    "evolution": draw_evolution,
}
