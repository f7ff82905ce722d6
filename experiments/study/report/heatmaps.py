"""Return rates by where balls come from and go to: the paper's nested grids, 3 x 3 within 3 x 3.

The large grid is the robot's half: the cell in which the human's ball bounced. Within each cell a small grid is the
human's half: incoming, the place from which the ball was hit; outgoing, the place where the robot's return came down. A
square's colour is the return rate of its balls, its number their share of all balls of the picture, in percent; the
numbers of a small grid add up to the large cell's, which stands above it. Outgoing balls are those that the robot
touched: the others come down nowhere (that the paper's shares differ between its two pictures says the same). A place
beside the half counts to the nearest square.
"""

from __future__ import annotations

from collections.abc import Callable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ballmodel import constants as c
from experiments.study.analysis.paper import SHORT
from experiments.study.analysis.study_folder import BallLog, StudyFolder
from experiments.study.report.plots import colour, note_empty, player_label
from mjx_tt.viz.html import INK

CELLS = 3
METHODS = ("is2r-ft100", "s2r-ft100", "id-ft100")  # the first two that a study has
GAP = 0.35  # between the large cells, in squares
PALETTE = matplotlib.colormaps["Blues"]
SIDE, HALF = c.TABLE_WIDTH / 2, c.TABLE_LENGTH / 2
EDGES = tuple(np.linspace(a, b, CELLS + 1) for a, b in ((-SIDE, SIDE), (-HALF, 0.0), (-SIDE, SIDE), (0.0, HALF)))
Balls = tuple[np.ndarray, np.ndarray, np.ndarray]  # landing (2, n), place (2, n) [m], returned (n,) bool


def count_balls(landing: np.ndarray, place: np.ndarray, returned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts and returned counts, both (3, 3, 3, 3): large cell x, y, small cell x, y.

    From left to right seen from the robot's end, from its end line to the human's.

    Args:
        landing: (2, n) [m] on the robot's side.
        place: (2, n) [m] on the human's side.
        returned: (n,) bool.
    """
    points = np.concatenate([landing, place]).T
    good = np.isfinite(points).all(axis=1)
    points = np.clip(points, [edges[0] for edges in EDGES], [edges[-1] for edges in EDGES])
    count, back = (np.histogramdd(points[chosen], EDGES)[0] for chosen in (good, good & returned))
    return count, back


def incoming(log: BallLog) -> Balls:
    """Balls by the place from which the human hit."""
    return log.landing, log.position[:2], log.returned.astype(bool)


def outgoing(log: BallLog) -> Balls:
    """Balls that the robot touched by the place where its return came down."""
    hit = log.hit.astype(bool)
    return log.landing[:, hit], log.return_landing[:, hit], log.returned.astype(bool)[hit]


def draw_heatmaps(study: StudyFolder, choose: Callable[[BallLog], Balls]) -> Figure | None:
    """One row per player, one column per method. choose: ``incoming`` or ``outgoing``."""
    methods = [key for key in METHODS if any(study.logs(p, key) for p in study.players)][:2]
    rows = [p for p in study.players if any(study.logs(p, key) for key in methods)]
    if not rows:
        return None
    height = 4.75 * len(rows) + 0.6
    figure = Figure(figsize=(4.6 * len(methods), height))
    for axes_row, player in zip(figure.subplots(len(rows), len(methods), squeeze=False), rows, strict=True):
        for axes, key in zip(axes_row, methods, strict=True):
            axes.set_axis_off()
            logs = study.logs(player, key)
            if not logs:
                note_empty(axes)
                continue
            parts = zip(*map(choose, logs), strict=True)
            count, back = count_balls(*(np.concatenate(part, axis=-1) for part in parts))
            _draw_grids(axes, count, back)
            axes.set_title(f"{player_label(player)}, {SHORT[key]}: {int(count.sum()):,} balls", color=colour(key))
    figure.set_layout_engine("constrained", rect=(0.0, 0.75 / height, 1.0, 1.0 - 0.75 / height))
    bar = figure.add_axes((0.3, 0.45 / height, 0.4, 0.12 / height))
    bar.set_in_layout(False)
    mappable = ScalarMappable(cmap=PALETTE)
    mappable.set_clim(0.0, 1.0)
    figure.colorbar(mappable, cax=bar, label="return rate", orientation="horizontal", format=lambda v, _: f"{v:.0%}")
    return figure


def _draw_grids(axes: Axes, count: np.ndarray, back: np.ndarray) -> None:
    total, step = max(count.sum(), 1), CELLS + GAP
    for i, j in np.ndindex(CELLS, CELLS):
        x0, y0 = i * step, j * (step + 0.35)
        for k, m in np.ndindex(CELLS, CELLS):
            n = count[i, j, k, m]
            rate = back[i, j, k, m] / n if n else 0.0
            face = PALETTE(rate) if n else "white"
            axes.add_patch(Rectangle((x0 + k, y0 + m), 1, 1, facecolor=face, edgecolor="#d0d4d9", linewidth=0.5))
            if n:
                ink = "white" if rate > 0.6 else INK
                axes.text(
                    x0 + k + 0.5,
                    y0 + m + 0.5,
                    f"{100 * n / total:.1f}",
                    ha="center",
                    va="center",
                    fontsize=7.5,
                    color=ink,
                )
        axes.add_patch(Rectangle((x0, y0), CELLS, CELLS, facecolor="none", edgecolor=INK, linewidth=1.2))
        share = f"{100 * count[i, j].sum() / total:.1f} %"
        axes.text(x0, y0 + CELLS + 0.06, share, fontsize=8.5, fontweight="bold", va="bottom")
    axes.set_xlim(-0.1, CELLS * step - GAP + 0.1)
    axes.set_ylim(-0.1, CELLS * (step + 0.35) + 0.1)
    axes.set_aspect("equal")
