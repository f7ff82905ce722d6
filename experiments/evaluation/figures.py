"""Pictures of an evaluation and of a training run, as PNG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import RcParams
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from ballmodel import constants as c
from ballmodel.io.atomic_files import replacing
from experiments.errors import RunError
from experiments.evaluation.evaluate import Played
from experiments.runs import metrics
from experiments.runs.run_dir import Run
from mjx_tt.env.task import HIT, MISSED, RETURNED
from robot_io.contract import PAPER, Contract

RETURNED_COLOUR, HIT_COLOUR, MISSED_COLOUR = "#1b7837", "#e08214", "#b2182b"
TABLE_COLOUR, INK = "#e9eff7", "#303030"
LANDING_FRAME = (-1.5, 1.5), (-1.45, 2.3)  # [m] x and y shown
FEWEST_BALLS = 5  # in a cell whose rate is shown
SMOOTHING = 25  # updates

STYLE = RcParams(
    {
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
        "axes.titlesize": 11,
        "axes.titleweight": "bold",
        "axes.titlelocation": "left",
        "figure.constrained_layout.use": True,
        "legend.frameon": False,
        "savefig.dpi": 150,
    }
)


def draw_evaluation(folder: Path, played: Played, weights: tuple[float, ...], contract: Contract = PAPER) -> list[Path]:
    """Writes landing map, return rate by incoming ball, rewards and joint speeds; ``weights`` of the eleven terms."""
    folder.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        return [
            _save(folder / "landing_map.png", _landing_map(played)),
            _save(folder / "return_rate_map.png", _return_rate_map(played)),
            _save(folder / "rewards.png", _rewards(played.report["terms"], weights)),
            _save(folder / "joint_speeds.png", _joint_speeds(played, contract)),
        ]


def draw_training(path: Path, rows: list[dict[str, Any]], title: str) -> Path:
    """Writes the training curve from the rows of metrics.jsonl."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        return _save(path, _training(rows, title))


@dataclass(frozen=True)
class Curve:
    """A training for ``draw_curves``: rows of its metrics.jsonl, and how many balls an update plays."""

    name: str
    rows: list[dict[str, Any]]
    balls: int


def read_curve(folder: str | Path) -> Curve:
    """The curve of a training in simulation. Raises RunError for a folder that holds none."""
    run = Run(folder)
    optimiser, rows = run.config().optimiser, metrics.read(run.metrics)
    if not rows:
        raise RunError(f"{run.metrics}: holds no update yet")
    if "fault_rate" in rows[0]:
        raise RunError(
            f"{folder}: is a fine-tuning, with another count of balls and time; wanted is a training in simulation"
        )
    return Curve(str(folder), rows, 2 * optimiser.num_directions * optimiser.repeats)


def draw_curves(path: Path, curves: list[Curve]) -> Path:
    """Writes the shares of balls that several trainings' policies return, over time and over balls."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        return _save(path, _curves(curves))


def _landing_map(played: Played) -> Figure:
    result, report = played.result, played.report
    figure, axes = plt.subplots(figsize=(5.8, 6.6))
    _table(axes)
    for outcome, colour, label in ((HIT, HIT_COLOUR, "touched, not returned"), (RETURNED, RETURNED_COLOUR, "returned")):
        chosen = (result.outcome == outcome) & result.finite
        x, y = (np.clip(v, *frame) for v, frame in zip(result.landing[:, chosen], LANDING_FRAME, strict=True))
        axes.scatter(x, y, s=9, color=colour, alpha=0.55, linewidth=0, label=f"{label} ({chosen.sum():,})")
    missed = int(np.sum(result.outcome == MISSED))
    axes.set_xlim(*LANDING_FRAME[0])
    axes.set_ylim(*LANDING_FRAME[1])
    axes.set_title(f"Where {report['episodes']:,} balls come down\n{_rate(report)}")
    axes.legend(loc="upper left", markerscale=2, title=f"not touched ({missed:,})", title_fontsize=10, alignment="left")
    axes.text(
        0.99,
        0.98,
        "dots on the frame: beyond it",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=8,
        color=INK,
    )
    return figure


def _return_rate_map(played: Played) -> Figure:
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
    return figure


def _rewards(terms: dict[str, float | None], weights: tuple[float, ...]) -> Figure:
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
    return figure


def _joint_speeds(played: Played, contract: Contract) -> Figure:
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
    return figure


def _training(rows: list[dict[str, Any]], title: str) -> Figure:
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(7.2, 5.6), sharex=True, height_ratios=(2, 1))
    minutes = np.array([row["seconds"] for row in rows]) / 60
    upper.plot(minutes, _smooth(rows, "hit_rate"), color=HIT_COLOUR, label="perturbed policies: touched")
    upper.plot(minutes, _smooth(rows, "return_rate"), color=RETURNED_COLOUR, label="perturbed policies: returned")
    evaluated = [row for row in rows if "evaluation/return_rate" in row]
    if evaluated:
        at = [row["seconds"] / 60 for row in evaluated]
        rate, low, high = (
            np.array([row[f"evaluation/{k}"] for row in evaluated]) for k in ("return_rate", "low", "high")
        )
        upper.errorbar(
            at,
            rate,
            (rate - low, high - rate),
            color=INK,
            fmt="o-",
            markersize=4,
            linewidth=1,
            capsize=2,
            label="evaluated policy: returned, 95 %",
        )
    upper.set_ylim(0, 1.02)
    upper.yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
    upper.grid(axis="y", alpha=0.25)
    upper.legend(loc="lower right")
    upper.set_title(title)
    mean_return = _smooth(rows, "mean_return")
    lower.plot(minutes, mean_return, color="#4575b4")
    if np.isfinite(mean_return).any():  # the first, random policies would take all the room
        bottom, top = np.nanpercentile(mean_return, (5, 100))
        lower.set_ylim(bottom - 0.1, top + 0.1)
    lower.grid(axis="y", alpha=0.25)
    lower.set_ylabel("mean return")
    lower.set_xlabel("training time [min]")
    return figure


def _curves(curves: list[Curve]) -> Figure:
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 4.2), sharey=True)
    for i, curve in enumerate(curves):
        colour = f"C{i % 10}"
        minutes = np.array([row["seconds"] for row in curve.rows]) / 60
        played = curve.balls * np.array([row["update"] for row in curve.rows])
        rate = _smooth(curve.rows, "return_rate")
        evaluated = np.array(["evaluation/return_rate" in row for row in curve.rows])
        at = [row["evaluation/return_rate"] for row, there in zip(curve.rows, evaluated, strict=True) if there]
        for axes, x in zip(panels, (minutes, played), strict=True):
            axes.plot(x, rate, color=colour, label=f"{curve.name}, perturbed")
            if at:
                axes.plot(
                    x[evaluated], at, "o--", color=colour, markersize=4, linewidth=1, label=f"{curve.name}, evaluated"
                )
    for axes, label in zip(panels, ("training time [min]", "balls"), strict=True):
        axes.set_xscale("log")
        axes.set_xlim(left=max(line.get_xdata()[-1] for line in axes.lines) / 1000)  # the first updates say nothing
        axes.xaxis.set_major_formatter(lambda v, _: f"{v:,g}" if v < 1e6 else f"{v / 1e6:g} million")
        axes.set_xlabel(label)
        axes.grid(alpha=0.25)
    panels[0].set_ylim(-0.02, 1.02)
    panels[0].yaxis.set_major_formatter(lambda v, _: f"{v:.0%}")
    panels[0].set_title("returned balls")
    panels[0].legend(loc="upper left")
    return figure


def _smooth(rows: list[dict[str, Any]], name: str) -> np.ndarray:
    """Trailing mean over up to SMOOTHING updates; what was not finite is left out."""
    values = np.array([np.nan if row[name] is None else row[name] for row in rows], float)
    known = np.isfinite(values)
    sums, counts = np.cumsum(np.where(known, values, 0.0)), np.cumsum(known)
    sums[SMOOTHING:] -= sums[:-SMOOTHING].copy()
    counts[SMOOTHING:] -= counts[:-SMOOTHING].copy()
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


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


def _save(path: Path, figure: Figure) -> Path:
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
    plt.close(figure)
    return path
