"""Style of a study's pictures: colours, boxes, bars and intervals.

One colour per method everywhere (Okabe and Ito's, which the colour-blind tell apart): blue i-S2R, vermilion S2R, green
S2R-Oracle, purple i-S2R without carrying the weights back, orange the ablation; i-S2R in other worlds light blue
(identified), yellow (prior) and grey (reality itself). Paler: not fine-tuned. Hollow: the paper.
Boxes as in the paper: white circle the mean, line the median, box the quartiles. Figures are made without pyplot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from experiments.study.analysis.paper import (
    ABLATION,
    BOUND,
    BY_KEY,
    FRESH,
    IDENTIFIED,
    IS2R,
    ORACLE,
    RANDOMISED,
    S2R,
    SHORT,
    level,
    of_level,
)
from experiments.study.analysis.statistics import Bootstrap, Estimate, Interval
from mjx_tt.viz.html import FAINT, INK
from mjx_tt.viz.html import STYLE as PAGE_STYLE

P = ParamSpec("P")
T = TypeVar("T")
Shade = str | tuple[float, float, float]  # a colour

COLOUR = {
    IS2R: "#0072b2",
    S2R: "#d55e00",
    ORACLE: "#009e73",
    FRESH: "#cc79a7",
    ABLATION: "#e69f00",
    IDENTIFIED: "#56b4e9",
    RANDOMISED: "#d0c000",
    BOUND: "#5a5a5a",
}
STYLE = PAGE_STYLE | {"figure.constrained_layout.use": True, "axes.titleweight": "bold", "font.size": 9.5}
PAPER_MARK = Line2D([], [], color=INK, marker="D", markerfacecolor="white", linestyle="", label="paper")


def styled(draw: Callable[P, T]) -> Callable[P, T]:
    """Draws within STYLE."""

    @wraps(draw)
    def inner(*arguments: P.args, **named: P.kwargs) -> T:
        with matplotlib.rc_context(STYLE):
            return draw(*arguments, **named)

    return inner


def colour(key: str) -> tuple[float, float, float]:
    """Of a model: its method's, paler where it is not fine-tuned."""
    model = BY_KEY[key]
    red, green, blue = to_rgb(COLOUR[model.method])
    if model.fine_tuned or model.method == ABLATION:
        return red, green, blue
    return _paler(red), _paler(green), _paler(blue)


def _paler(share: float) -> float:
    return share + 0.55 * (1.0 - share)


def level_label(name: str) -> str:
    """A skill level, or all, with its players, for titles."""
    chosen = of_level(name)
    return f"{name.capitalize()}: player{'s' if len(chosen) > 1 else ''} {', '.join(p[-1] for p in chosen)}"


def player_label(name: str) -> str:
    """A player with the skill level, for titles."""
    return f"player {name[-1]} ({level(name)})"


def boxes(
    axes: Axes,
    samples: Sequence[np.ndarray],
    keys: Sequence[str],
    ylabel: str,
    log: bool = False,
    labelled: bool = True,
) -> None:
    """Box plots of models in the paper's form. samples: (n,) rally lengths of each key, empty where there are none."""
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
            whiskerprops={"color": INK, "linewidth": 0.8},
            capprops={"color": INK, "linewidth": 0.8},
            meanprops={"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK, "markersize": 6},
            flierprops={"marker": ".", "markersize": 2.5, "markerfacecolor": FAINT, "markeredgecolor": FAINT},
        )
        for mean in parts["means"]:
            mean.set_zorder(5)
    if log:
        axes.set_yscale("log")
        ticks = [
            t
            for t in (1, 2, 5, 10, 20, 50, 100, 200, 400)
            if t <= 1.3 * max([v.max() for v in samples if v.size], default=1)
        ]
        axes.set_yticks(ticks, [str(t) for t in ticks])
        axes.minorticks_off()
    model_ticks(axes, keys, labelled)
    axes.set_ylabel(ylabel)
    note_empty(axes, any(v.size for v in samples))


def bars(
    axes: Axes, intervals: Sequence[Interval | None], keys: Sequence[str], ylabel: str, labelled: bool = True
) -> None:
    """Bars of models with their intervals; None for a model that the study lacks."""
    for k, (interval, key) in enumerate(zip(intervals, keys, strict=True)):
        bar(axes, k, interval, colour(key), 0.7)
    model_ticks(axes, keys, labelled)
    axes.set_ylabel(ylabel)
    axes.axhline(0.0, color=FAINT, linewidth=0.8)
    note_empty(axes, any(i is not None for i in intervals))


def bar(axes: Axes, at: float, interval: Interval | None, shade: Shade, width: float, hatch: str | None = None) -> None:
    """One bar with its interval at ``at`` on the x axis, ``width`` in its units; nothing for None."""
    if interval is None:
        return
    axes.bar(at, interval.value, width, color=shade, hatch=hatch, edgecolor="white" if hatch else None, linewidth=0)
    _, err = error_bars([interval])
    axes.errorbar(at, interval.value, err, color=INK, linewidth=1.1, capsize=2.5)


def error_bars(intervals: Sequence[Interval]) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) and lengths (2, n) of error bars."""
    table = np.array([(i.value, max(i.value - i.low, 0.0), max(i.high - i.value, 0.0)) for i in intervals]).T
    return table[0], np.where(np.isfinite(table[1:]), table[1:], 0.0)


def forest(axes: Axes, intervals: Sequence[Interval | None], labels: Sequence[str], colours: Sequence[Shade]) -> None:
    """Ratios with their intervals on a log scale around 1, from top to bottom."""
    for row, (interval, shade) in enumerate(zip(intervals, colours, strict=True)):
        if interval is None:
            axes.text(1.0, row, "not in this study", ha="center", va="center", fontsize=8, color=FAINT)
            continue
        value, err = error_bars([interval])
        axes.errorbar(value, [row], xerr=err, fmt="o", color=shade, markersize=6, linewidth=2, capsize=3)
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


def model_ticks(axes: Axes, keys: Sequence[str], labelled: bool) -> None:
    """A tick for every model at 0, 1, 2 ...; slanted where there are many."""
    names = [SHORT.get(k, k) if len(keys) <= 4 else k for k in keys] if labelled else [""] * len(keys)
    if len(keys) > 4:
        axes.set_xticks(range(len(keys)), names, rotation=45, ha="right", fontsize=8)
    else:
        axes.set_xticks(range(len(keys)), names, fontsize=8.5)
    axes.set_xlim(-0.6, len(keys) - 0.4)


def note_empty(axes: Axes, filled: bool | None = None) -> None:
    """Says that the study has nothing to draw; None: where nothing was drawn."""
    if not (axes.has_data() if filled is None else filled):
        axes.text(0.5, 0.5, "not in this study", transform=axes.transAxes, ha="center", color=FAINT)


def patches(keys: Sequence[str]) -> list[Patch]:
    """Entries of a legend, a model each."""
    return [Patch(facecolor=colour(key), label=SHORT.get(key, BY_KEY[key].label)) for key in keys]


def lengths(boot: Bootstrap, key: str, group: str) -> np.ndarray:
    """(n,) rally lengths of a model with its own trainers of a group: touches, or what the bootstrap made of them."""
    chosen = of_level(group)
    found = [v for cell, v in boot.cells.items() if cell[3] == key and cell[1] in chosen and cell[1] == cell[2]]
    return np.concatenate(found) if found else np.zeros(0)


def of_player(boot: Bootstrap, player: str, key: str) -> np.ndarray:
    """(n,) rally lengths of a model with one trainer, who also evaluates it."""
    found = [v for cell, v in boot.cells.items() if cell[1:] == (player, player, key)]
    return np.concatenate(found) if found else np.zeros(0)


def mean_of(boot: Bootstrap, key: str, group: str) -> Interval | None:
    """Mean rally length of a model over the trainers of a group; None without rallies."""
    return interval_of(boot.mean(key, of_level(group)))


def evaluated(boot: Bootstrap, trainer: str, evaluator: str, key: str) -> Interval | None:
    """Mean rally length of a trainer's model with an evaluator; None without rallies."""
    return interval_of(boot.evaluated(key, trainer, evaluator))


def has(boot: Bootstrap, keys: Sequence[str]) -> bool:
    """True for a bootstrap that holds any of the models."""
    return bool(played(boot, keys))


def played(boot: Bootstrap, keys: Sequence[str]) -> list[str]:
    """Those of the models that a bootstrap holds."""
    return [key for key in keys if any(cell[3] == key for cell in boot.cells)]


def interval_of(estimate: Estimate | None) -> Interval | None:
    """The interval of an estimate, if there is one."""
    return None if estimate is None else estimate.interval
