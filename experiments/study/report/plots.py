"""Parts of the report's figures: bars with intervals and box plots.

One colour per method everywhere (``paper.yaml``); paler where a model is not fine-tuned. White diamonds and hollow bars
are the paper's. Boxes are the paper's: white circle the mean, line the median, box the quartiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.study.analysis.paper import ABLATION, BY_KEY, COLOURS, of_level
from experiments.study.analysis.statistics import Estimate, Interval
from mjx_tt.viz.html import FAINT, INK
from mjx_tt.viz.html import STYLE as PAGE_STYLE

STYLE = PAGE_STYLE | {"figure.constrained_layout.use": True, "axes.titleweight": "bold", "font.size": 9.5}
DIAMOND: dict[str, Any] = {"marker": "D", "color": INK, "markerfacecolor": "white", "linestyle": ""}
MEAN = "mean rally length, 95 %"
Colour = str | tuple[float, float, float]


def colour(key: str) -> tuple[float, float, float]:
    """Colour of a model: its method's, paler where it is not fine-tuned."""
    model = BY_KEY[key]
    rgb = to_rgb(COLOURS[model.method])
    pale = not model.fine_tuned and model.method != ABLATION
    red, green, blue = (share + 0.55 * (1.0 - share) if pale else share for share in rgb)
    return red, green, blue


def group_label(group: str) -> str:
    """A group of players, for titles."""
    if group == "all":
        return "All players"
    chosen = of_level(group)
    return f"{group.capitalize()}: player{'s' if len(chosen) > 1 else ''} {', '.join(p[-1] for p in chosen)}"


def error_lengths(interval: Interval) -> list[list[float]]:
    """Lengths (2, 1) of an error bar below and above the value; zero where there is no interval."""
    below, above = interval.value - interval.low, interval.high - interval.value
    return [[max(x, 0.0) if np.isfinite(x) else 0.0] for x in (below, above)]


def draw_bars(
    axes: Axes,
    groups: Sequence[Sequence[Estimate | None]],
    keys: Sequence[Sequence[str]],
    hatches: Sequence[str | None] | None = None,
) -> None:
    """Groups of bars with their intervals, a group at each of 0, 1, 2 ... on the x axis.

    groups, keys: values and their models, by group and by bar within it; hatches: by bar within a group. A missing
    value leaves a gap.
    """
    for x, (group, models) in enumerate(zip(groups, keys, strict=True)):
        width = 0.8 / len(group)
        for k, (measured, key) in enumerate(zip(group, models, strict=True)):
            if measured is None:
                continue
            at, hatch = x + (k - 0.5 * (len(group) - 1)) * width, hatches and hatches[k]
            edge: dict[str, Any] = {"hatch": hatch, "edgecolor": "white"} if hatch else {}
            axes.bar(at, measured.value, 0.95 * width, color=colour(key), linewidth=0, **edge)
            lengths = error_lengths(measured.interval)
            axes.errorbar(at, measured.value, lengths, color=INK, linewidth=1.1, capsize=2.5)
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
