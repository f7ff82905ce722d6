"""Return rates by where balls come from and go to: the paper's nested grids, 3 x 3 within 3 x 3.

The large grid is the robot's half: the cell in which the human's ball bounced. Within each cell a small grid is the
human's
half: incoming, the place from which the ball was hit; outgoing, the place where the robot's return came down. A
square's colour is the return rate of its balls, its number their share of all balls of the picture, in percent; the
numbers of a small grid add up to the large cell's, which stands above it. Outgoing balls are those that the robot
touched: the others come down nowhere (that the paper's shares differ between its two pictures says the same). A place
beside the half counts to the nearest square.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ballmodel import constants as c
from experiments.study.analysis.paper import SHORT
from experiments.study.analysis.study_folder import BallLog, Study
from experiments.study.report.style import colour, player_label, styled
from mjx_tt.viz.html import FAINT, INK

CELLS = 3
METHODS = ("is2r-ft100", "s2r-ft100", "id-ft100")  # the first two that a study has
GAP = 0.35  # between the large cells, in squares
Grids = tuple[np.ndarray, np.ndarray]  # counts and returned counts, both (3, 3, 3, 3)


def grid(landing: np.ndarray, place: np.ndarray, returned: np.ndarray) -> Grids:
    """Counts and returned counts, both (3, 3, 3, 3): large cell x, y, small cell x, y; from left to right seen from the
    robot's end, from its end line to the human's.

    landing: (2, n) [m] on the robot's side; place: (2, n) [m] on the human's side; returned: (n,) bool.
    """
    good = np.isfinite(landing).all(axis=0) & np.isfinite(place).all(axis=0)
    index = (
        _cell(landing[0], -c.TABLE_WIDTH / 2, c.TABLE_WIDTH),
        _cell(landing[1], -c.TABLE_LENGTH / 2, c.TABLE_LENGTH / 2),
        _cell(place[0], -c.TABLE_WIDTH / 2, c.TABLE_WIDTH),
        _cell(place[1], 0.0, c.TABLE_LENGTH / 2),
    )
    count, back = np.zeros((CELLS,) * 4), np.zeros((CELLS,) * 4)
    np.add.at(count, tuple(i[good] for i in index), 1)
    np.add.at(back, tuple(i[good & returned] for i in index), 1)
    return count, back


def incoming(logs: list[BallLog]) -> Grids:
    """Grids by the place from which the human hit."""
    return _sum(grid(log.landing, log.position[:2], log.returned.astype(bool)) for log in logs)


def outgoing(logs: list[BallLog]) -> Grids:
    """Grids by the place where the robot's return came down, of the balls that it touched."""
    touched = ((log, log.hit.astype(bool)) for log in logs)
    return _sum(grid(log.landing[:, h], log.return_landing[:, h], log.returned.astype(bool)[h]) for log, h in touched)


@styled
def heatmaps(study: Study, which: Callable[[list[BallLog]], Grids]) -> Figure | None:
    """One row per player, one column per method. which: ``incoming`` or ``outgoing``."""
    methods = [key for key in METHODS if any(study.logs(p, key) for p in study.players)][:2]
    rows = [p for p in study.players if any(study.logs(p, key) for key in methods)]
    if not rows:
        return None
    figure = Figure(figsize=(4.6 * len(methods), 4.75 * len(rows) + 0.6))
    for axes_row, player in zip(figure.subplots(len(rows), len(methods), squeeze=False), rows, strict=True):
        for axes, key in zip(axes_row, methods, strict=True):
            logs = study.logs(player, key)
            axes.set_axis_off()
            if not logs:
                axes.text(0.5, 0.5, "not in this study", transform=axes.transAxes, ha="center", color=FAINT)
                continue
            count, back = which(logs)
            _draw(axes, count, back)
            axes.set_title(f"{player_label(player)}, {SHORT[key]}: {int(count.sum()):,} balls", color=colour(key))
    bar = figure.add_axes((0.3, 0.0, 0.4, 0.12 / figure.get_figheight()))
    bar.set_in_layout(False)
    mappable = ScalarMappable(Normalize(0.0, 1.0), matplotlib.colormaps["Blues"])
    figure.colorbar(mappable, cax=bar, label="return rate", orientation="horizontal", format=lambda v, _: f"{v:.0%}")
    figure.set_layout_engine(
        "constrained", rect=(0.0, 0.75 / figure.get_figheight(), 1.0, 1.0 - 0.75 / figure.get_figheight())
    )
    bar.set_position((0.3, 0.45 / figure.get_figheight(), 0.4, 0.12 / figure.get_figheight()))
    return figure


def _draw(axes: Axes, count: np.ndarray, back: np.ndarray) -> None:
    palette, total, step = matplotlib.colormaps["Blues"], max(count.sum(), 1), CELLS + GAP
    for i, j in np.ndindex(CELLS, CELLS):
        x0, y0 = i * step, j * (step + 0.35)
        for k, m in np.ndindex(CELLS, CELLS):
            n = count[i, j, k, m]
            rate = back[i, j, k, m] / n if n else 0.0
            face, corner = palette(rate) if n else (1, 1, 1), (x0 + k, y0 + m)
            axes.add_patch(Rectangle(corner, 1, 1, facecolor=face, edgecolor="#d0d4d9", linewidth=0.5))
            if n:
                axes.text(
                    x0 + k + 0.5,
                    y0 + m + 0.5,
                    f"{100 * n / total:.1f}",
                    ha="center",
                    va="center",
                    fontsize=7.5,
                    color="white" if rate > 0.6 else INK,
                )
        axes.add_patch(Rectangle((x0, y0), CELLS, CELLS, facecolor="none", edgecolor=INK, linewidth=1.2))
        share = f"{100 * count[i, j].sum() / total:.1f} %"
        axes.text(x0, y0 + CELLS + 0.06, share, fontsize=8.5, fontweight="bold", va="bottom")
    axes.set_xlim(-0.1, CELLS * step - GAP + 0.1)
    axes.set_ylim(-0.1, CELLS * (step + 0.35) + 0.1)
    axes.set_aspect("equal")


def _cell(value: np.ndarray, start: float, width: float) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.clip(np.nan_to_num((value - start) / width * CELLS), 0, CELLS - 1).astype(int)


def _sum(parts: Iterable[Grids]) -> Grids:
    counts, backs = zip(*parts, strict=True)
    return np.sum(counts, axis=0), np.sum(backs, axis=0)
