"""The figure toolkit of a study's report: bars and curves with intervals, box plots, ratios and grids of numbers.

One colour per method everywhere (``paper.yaml``); paler where a model is not fine-tuned. White diamonds and hollow bars
are the paper's. Boxes are the paper's: white circle the mean, line the median, box the quartiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from experiments.study.analysis.paper import ABLATION, BY_KEY, COLOURS, SHORT, level, of_level
from experiments.study.analysis.statistics import Bootstrap, Estimate, Interval
from mjx_tt.viz.html import FAINT, INK
from mjx_tt.viz.html import STYLE as PAGE_STYLE

STYLE = PAGE_STYLE | {"figure.constrained_layout.use": True, "axes.titleweight": "bold", "font.size": 9.5}
HUMAN_MODEL_COLOURS = {"M0": "#9ecae1", "M1": "#4292c6", "M2": "#08519c"}
HOLLOW: dict[str, Any] = {"facecolor": "white", "edgecolor": INK, "linewidth": 0.9}
DIAMOND: dict[str, Any] = {"marker": "D", "color": INK, "markerfacecolor": "white", "linestyle": ""}
LENGTH, MEAN, NORMALISED = "rally length", "mean rally length, 95 %", "normalised rally length"
STAGES = ("sim1", "ft35", "sim2", "ft65", "sim3", "ft100")
STAGE_LABELS = ("sim 1", "fine-tuned\n35 %", "sim 2", "fine-tuned\n65 %", "sim 3", "fine-tuned\n100 %")
Colour = str | tuple[float, float, float]
Measured = Estimate | Interval | None  # with a value and an interval, or missing


def colour(key: str) -> tuple[float, float, float]:
    """Colour of a model: its method's, paler where it is not fine-tuned."""
    model = BY_KEY[key]
    rgb = to_rgb(COLOURS[model.method])
    pale = not model.fine_tuned and model.method != ABLATION
    red, green, blue = (share + 0.55 * (1.0 - share) if pale else share for share in rgb)
    return red, green, blue


def held(boot: Bootstrap, keys: Sequence[str]) -> list[str]:
    """Those of the models that a bootstrap holds."""
    there = {cell[3] for cell in boot.cells}
    return [key for key in keys if key in there]


def level_label(group: str) -> str:
    """A group of players, for titles."""
    chosen = of_level(group)
    return f"{group.capitalize()}: player{'s' if len(chosen) > 1 else ''} {', '.join(p[-1] for p in chosen)}"


def player_label(name: str) -> str:
    """A player with the skill level, for titles."""
    return f"player {name[-1]} ({level(name)})"


def interval_of(measured: Measured) -> Interval | None:
    return measured.interval if isinstance(measured, Estimate) else measured


def error_lengths(interval: Interval) -> list[list[float]]:
    """Lengths (2, 1) of an error bar below and above the value; zero where there is no interval."""
    below, above = interval.value - interval.low, interval.high - interval.value
    return [[max(x, 0.0) if np.isfinite(x) else 0.0] for x in (below, above)]


def draw_bars(
    axes: Axes,
    groups: Sequence[Sequence[Measured]],
    keys: Sequence[Sequence[str]],
    labels: Sequence[str],
    ylabel: str = "",
    hatches: Sequence[str | None] | None = None,
    **label_style: Any,
) -> None:
    """Groups of bars with their intervals, a group at each of 0, 1, 2 ... on the x axis.

    groups, keys: values and their models, by group and by bar within it; hatches: by bar within a group. A missing
    value leaves a gap.
    """
    for x, (group, models) in enumerate(zip(groups, keys, strict=True)):
        width = 0.8 / len(group)
        for k, (measured, key) in enumerate(zip(group, models, strict=True)):
            interval = interval_of(measured)
            if interval is None:
                continue
            at, hatch = x + (k - 0.5 * (len(group) - 1)) * width, hatches and hatches[k]
            edge: dict[str, Any] = {"hatch": hatch, "edgecolor": "white"} if hatch else {}
            axes.bar(at, interval.value, 0.95 * width, color=colour(key), linewidth=0, **edge)
            axes.errorbar(at, interval.value, error_lengths(interval), color=INK, linewidth=1.1, capsize=2.5)
    axes.set_xticks(range(len(labels)), labels, **label_style)
    axes.set_ylabel(ylabel)
    note_empty(axes)
    axes.axhline(0.0, color=FAINT, linewidth=0.8)


def draw_model_bars(
    axes: Axes, means: Sequence[Measured], keys: Sequence[str], ylabel: str, labelled: bool = True
) -> None:
    """One bar with its interval for every model."""
    draw_bars(axes, [[mean] for mean in means], [[key] for key in keys], [""] * len(keys), ylabel)
    _label_models(axes, keys, labelled)


def draw_grouped_means(
    axes: Axes,
    boot: Bootstrap,
    groups: Sequence[Sequence[str]],
    players: Sequence[str],
    labels: Sequence[str],
    **label_style: Any,
) -> None:
    """Bars of the mean length of groups of models."""
    draw_bars(axes, [[boot.mean(key, players) for key in group] for group in groups], groups, labels, **label_style)


def draw_boxes(
    axes: Axes,
    samples: Sequence[np.ndarray],
    keys: Sequence[str],
    ylabel: str,
    log: bool = False,
    labelled: bool = True,
) -> None:
    """A box plot for every model. samples: (n,) rally lengths of each key, empty where there are none."""
    thin: dict[str, Any] = {"color": INK, "linewidth": 0.8}
    for k, (values, key) in enumerate(zip(samples, keys, strict=True)):
        if not values.size:
            continue
        parts = axes.boxplot(
            values,
            positions=[k],
            widths=0.62,
            patch_artist=True,
            showmeans=True,
            manage_ticks=False,
            boxprops={"facecolor": colour(key), "edgecolor": INK, "linewidth": 0.8},
            medianprops={"color": INK, "linewidth": 1.6},
            whiskerprops=thin,
            capprops=thin,
            meanprops={"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK, "markersize": 6},
            flierprops={"marker": ".", "markersize": 2.5, "markerfacecolor": FAINT, "markeredgecolor": FAINT},
        )
        parts["means"][0].set_zorder(5)
    note_empty(axes)
    if log:
        axes.set_yscale("log")
        top = 1.3 * max([v.max() for v in samples if v.size], default=1)
        ticks = [t for t in (1, 2, 5, 10, 20, 50, 100, 200, 400) if t <= top]
        axes.set_yticks(ticks, [str(t) for t in ticks])
        axes.minorticks_off()
    axes.set_ylabel(ylabel)
    _label_models(axes, keys, labelled)


def draw_ratios(
    axes: Axes, ratios: Sequence[Measured], labels: Sequence[str], colours: Sequence[Colour], xlabel: str = ""
) -> None:
    """Ratios with their intervals on a log scale around 1, from top to bottom."""
    for row, (measured, shade) in enumerate(zip(ratios, colours, strict=True)):
        interval = interval_of(measured)
        if interval is None:
            axes.text(1.0, row, "not in this study", ha="center", va="center", fontsize=8, color=FAINT)
            continue
        style: dict[str, Any] = {"fmt": "o", "color": shade, "markersize": 6, "linewidth": 2, "capsize": 3}
        axes.errorbar(interval.value, row, xerr=error_lengths(interval), **style)
    axes.axvline(1.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 10) if low <= t <= high]
    if len(ticks) < 2:  # ratios close to 1
        ticks = [float(t) for t in MaxNLocator(4).tick_values(low, high) if low <= t <= high]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", alpha=0.25)
    axes.set_xlabel(xlabel)


def mark_paper(axes: Axes, x: float, y: float, size: float = 6) -> None:
    """A white diamond: the paper's number."""
    axes.plot(x, y, **DIAMOND, markersize=size, zorder=6)


def note_empty(axes: Axes) -> None:
    """Says that the study has nothing to draw, where nothing was drawn."""
    if not axes.has_data():
        axes.text(0.5, 0.5, "not in this study", transform=axes.transAxes, ha="center", color=FAINT)


def show_percent(axis: Axis) -> None:
    """Labels of an axis of shares in percent."""
    axis.set_major_formatter(lambda value, _: f"{value:.0%}")


def add_legend(figure: Figure, handles: Iterable[Artist], place: str = "center", **options: Any) -> None:
    """A legend below the axes."""
    handles = list(handles)
    settings: dict[str, Any] = {"ncols": len(handles) or 1, "loc": f"outside lower {place}"} | options
    figure.legend(handles=handles, **settings)


def patch(label: str, shade: Colour, **options: Any) -> Patch:
    """An entry of a legend for an area."""
    return Patch(facecolor=shade, label=label, **options)


def line(label: str, shade: Colour = INK, **options: Any) -> Line2D:
    """An entry of a legend for a line or, with a marker, for points."""
    options = {"color": shade, "label": label} | options
    return Line2D([], [], **options)


def _label_models(axes: Axes, keys: Sequence[str], labelled: bool) -> None:
    """A tick for every model at 0, 1, 2 ...; slanted where there are many."""
    many = len(keys) > 4
    names = [key if many else SHORT.get(key, key) for key in keys] if labelled else [""] * len(keys)
    style: dict[str, Any] = {"rotation": 45, "ha": "right", "fontsize": 8} if many else {"fontsize": 8.5}
    axes.set_xticks(range(len(keys)), names, **style)
    axes.set_xlim(-0.6, len(keys) - 0.4)
