"""Pictures of an evaluation, as PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import RcParams
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ballmodel import constants as c
from ballmodel.io.atomic_files import replacing
from experiments.evaluation.evaluate import Played
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.viz import html
from mjx_tt.viz.html import INK
from robot_io.contract import PAPER, Contract

RETURNED_COLOUR, HIT_COLOUR, MISSED_COLOUR = "#1b7837", "#e08214", "#b2182b"
TABLE_COLOUR = "#e9eff7"
LANDING_FRAME = (-1.2, 1.2), (-1.45, 1.9)  # [m] x and y shown
FEWEST_BALLS = 5  # in a cell whose rate is shown

STYLE = RcParams(
    html.STYLE
    | {"axes.titlesize": 11, "axes.titleweight": "bold", "figure.constrained_layout.use": True, "savefig.dpi": 150}
)


def draw_evaluation(folder: Path, played: Played, weights: tuple[float, ...], contract: Contract = PAPER) -> list[Path]:
    """Writes landing map, return rate by incoming ball, rewards and joint speeds; ``weights`` of the eleven terms."""
    parts: dict[str, Callable[[], None]] = {
        "landing_map": lambda: _landing_map(played),
        "return_rate_map": lambda: _return_rate_map(played),
        "rewards": lambda: _rewards(played.report["terms"], weights),
        "joint_speeds": lambda: _joint_speeds(played, contract),
    }
    paths = [folder / f"{name}.png" for name in parts]
    for path, draw in zip(paths, parts.values(), strict=True):
        with drawing(path):
            draw()
    return paths


def _landing_map(played: Played) -> None:
    result, report = played.result, played.report
    figure, axes = plt.subplots(figsize=(5.4, 7.0))
    _table(axes)
    for outcome, colour, label in ((HIT, HIT_COLOUR, "touched, not returned"), (RETURNED, RETURNED_COLOUR, "returned")):
        chosen = (result.outcome == outcome) & result.finite
        x, y = (np.clip(v, *frame) for v, frame in zip(result.landing[:, chosen], LANDING_FRAME, strict=True))
        axes.scatter(x, y, s=9, color=colour, alpha=0.55, linewidth=0, label=f"{label} ({chosen.sum():,})")
    missed = int(np.sum(result.outcome == MISSED))
    axes.plot([], [], "x", color=MISSED_COLOUR, label=f"not touched, without a place ({missed:,})")
    axes.set_xlim(*LANDING_FRAME[0])
    axes.set_ylim(*LANDING_FRAME[1])
    axes.set_title(f"Where {report['episodes']:,} balls come down\n{_rate(report)}")
    figure.legend(loc="outside lower left", markerscale=2, title="dots on the frame lie beyond it", alignment="left")


def _return_rate_map(played: Played) -> None:
    result, (x, y) = played.result, played.incoming.reshape(2, -1)
    returned = ((result.outcome == RETURNED) & result.finite).ravel()
    edges = np.linspace(-c.TABLE_WIDTH / 2, c.TABLE_WIDTH / 2, 13), np.linspace(-c.TABLE_LENGTH / 2, 0, 12)
    count = np.histogram2d(x, y, edges)[0]
    rate = np.histogram2d(x[returned], y[returned], edges)[0] / np.maximum(count, 1)
    figure, axes = plt.subplots(figsize=(6.2, 5.2))
    _table(axes)
    shown = np.ma.masked_where(count < FEWEST_BALLS, rate)
    mesh = axes.pcolormesh(*edges, shown.T, cmap="RdYlGn", vmin=0, vmax=1, edgecolor="white", linewidth=0.6, zorder=2)
    for i, j in zip(*np.nonzero(count >= FEWEST_BALLS), strict=True):
        centre = (edges[0][i] + edges[0][i + 1]) / 2, (edges[1][j] + edges[1][j + 1]) / 2
        colour = INK if 0.15 < rate[i, j] < 0.88 else "white"
        axes.text(*centre, f"{100 * rate[i, j]:.0f}", ha="center", va="center", fontsize=7, color=colour, zorder=3)
    figure.colorbar(mesh, ax=axes, label="return rate", shrink=0.8, format=lambda v, _: f"{v:.0%}")
    axes.set_xlim(-0.95, 0.95)
    axes.set_ylim(-1.5, 0.15)
    axes.set_title(f"Return rate [%] by where the incoming ball bounces\ncells with at least {FEWEST_BALLS} balls")


def _rewards(terms: dict[str, float | None], weights: tuple[float, ...]) -> None:
    names = list(terms)
    values = np.array([np.nan if terms[name] is None else terms[name] for name in names])
    weighted = values * np.array(weights)
    figure, axes = plt.subplots(figsize=(7.2, 4.2))
    place = np.arange(len(names))
    axes.barh(place, np.nan_to_num(weighted), color=[RETURNED_COLOUR if v >= 0 else MISSED_COLOUR for v in weighted])
    axes.axvline(0, color=INK, linewidth=0.8)
    for i, (value, weight) in enumerate(zip(values, weights, strict=True)):
        end = max(np.nan_to_num(weighted[i]), 0)
        axes.text(end, i, f"  {value:.3g} x {weight:g}", va="center", fontsize=8, color=INK)
    axes.set_yticks(place, [name.replace("_", " ") for name in names])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set_xlabel("mean reward per episode, times its weight")
    axes.set_title(f"Rewards by term, together {np.nansum(weighted):.2f}")


def _joint_speeds(played: Played, contract: Contract) -> None:
    peaks = played.result.peak_velocity[:, played.result.finite]
    columns = -(-contract.n_joints // 2)
    figure, grid = plt.subplots(2, columns, figsize=(2.625 * columns, 4.6), sharey=True, squeeze=False)
    for axes in grid.flat[contract.n_joints :]:
        axes.set_axis_off()
    for i, axes in enumerate(grid.flat[: contract.n_joints]):
        limit = contract.limits.velocity[i]
        axes.hist(
            peaks[i],
            bins=np.linspace(0, limit, 31),
            color="#4575b4",
            weights=np.full(peaks.shape[1], 1 / peaks.shape[1]),
        )
        axes.axvline(limit, color=MISSED_COLOUR, linewidth=1.5)
        axes.set_xlim(0, 1.06 * limit)
        axes.set_title(contract.joints[i])
        axes.set_xlabel(f"{contract.units[i]}/s")
        axes.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
    for axes in grid[:, 0]:
        axes.set_ylabel("episodes")
    figure.suptitle(
        "Highest commanded speed of each episode (red: the joint's limit)", x=0.01, ha="left", fontweight="bold"
    )


def _table(axes: Axes) -> None:
    """The table from above, the robot at the bottom."""
    width, length = c.TABLE_WIDTH, c.TABLE_LENGTH
    axes.add_patch(Rectangle((-width / 2, -length / 2), width, length, facecolor=TABLE_COLOUR, edgecolor=INK, zorder=0))
    axes.plot([0, 0], [-length / 2, length / 2], color="white", linewidth=1.5, zorder=1)
    reach = width / 2 + c.NET_OVERHANG
    axes.plot([-reach, reach], [0, 0], color=INK, linewidth=2.5, zorder=3)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m], robot below, human above")


def _rate(report: dict[str, Any]) -> str:
    return f"{report['return_rate']:.1%} returned (95 % interval {report['low']:.1%} to {report['high']:.1%})"


@contextmanager
def drawing(path: Path) -> Iterator[None]:
    """Writes the figure that is drawn inside, by ``plt``, as PNG, and closes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        yield
        with replacing(path) as temporary:
            plt.savefig(temporary, format="png")
        plt.close()
