"""Figures of the residuals: measured minus predicted, before and after, along the flight and against what may matter.

Vermilion is "before", the nominal model; blue is "after", the extended one (Okabe and Ito's colours, which the
colour-blind tell apart).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.flights.linearization import SPIN
from mjx_tt.diagnosis.joint import JointFindings, JointResidual
from mjx_tt.viz.html import FAINT, INK, STYLE, WIDTH

BEFORE, AFTER = "#c2410c", "#0b62a4"
UNCHANGED = "#5c6670"
AXES = ("x", "y", "z")
MEANING = {"x": "across the table", "y": "along the table", "z": "upwards"}
BINS, FEWEST = 22, 25  # of a curve, and samples in a bin that is drawn
FEWEST_BALLS = 4  # in a bin of a quantity that a ball has as a whole
QUANTILES = (5, 25, 50, 75, 95)


@dataclass(frozen=True)
class Curve:
    """Quantiles of a residual in bins of a quantity; bins with few samples are omitted."""

    place: Float[np.ndarray, " b"]  # middles of the bins
    quantiles: Float[np.ndarray, "5 b"]  # at 5, 25, 50, 75 and 95 %
    count: Int[np.ndarray, " b"]  # samples

    def largest(self) -> tuple[float, float]:
        """Place and value of the median that is farthest from zero."""
        k = int(np.argmax(np.abs(self.quantiles[2])))
        return float(self.place[k]), float(self.quantiles[2, k])


def curve(
    quantity: Float[np.ndarray, "*shape"],
    residual: Float[np.ndarray, "*shape"],
    mask: Bool[np.ndarray, "*shape"],
    bins: int = BINS,
    fewest: int = FEWEST,
) -> Curve:
    """Bins of equal width between the 1st and 99th percentile of ``quantity``."""
    q, r = quantity[mask], residual[mask]
    good = np.isfinite(q) & np.isfinite(r)
    q, r = q[good], r[good]
    empty = Curve(np.zeros(0), np.zeros((5, 0)), np.zeros(0, int))
    if q.size < fewest:
        return empty
    low, high = np.percentile(q, (1, 99))
    if not high > low:
        return empty
    edges = np.linspace(low, high, bins + 1)
    at = np.clip(np.digitize(q, edges) - 1, 0, bins - 1)
    inside = (q >= low) & (q <= high)
    groups = [r[inside & (at == k)] for k in range(bins)]
    full = [k for k in range(bins) if groups[k].size >= fewest]
    if not full:
        return empty
    quantiles = np.array([np.percentile(groups[k], QUANTILES) for k in full]).T
    return Curve(0.5 * (edges[:-1] + edges[1:])[full], quantiles, np.array([groups[k].size for k in full]))


def flight_time(found: BallFindings) -> tuple[Float[np.ndarray, "T n"], str]:
    """Time [s] since the bounce where most balls bounce, since the first sample otherwise; and what it is called."""
    grid, bounce = found.problem.grid, found.search.linear.base.bounce_time[0]
    if np.isfinite(bounce).mean() > 0.5:
        return np.where(np.isfinite(bounce), grid.time - np.where(np.isfinite(bounce), bounce, 0.0), np.nan), "bounce"
    return grid.time, "start"


def residuals(found: BallFindings) -> tuple[Float[np.ndarray, "3 T n"], Float[np.ndarray, "3 T n"]]:
    """Residuals [mm], measured minus predicted under the nominal and under the extended model."""
    return 1e3 * found.residual0, 1e3 * found.residual()


def flight(found: BallFindings) -> tuple[Figure, str]:
    """Residuals along the flight, before and after, and the largest medians in words."""
    mask = found.problem.grid.mask
    time, origin = flight_time(found)
    both = residuals(found)
    curves = [[curve(time, r[a], mask, 30) for a in range(3)] for r in both]
    words = "; ".join(_largest(name, row, origin) for name, row in zip(("before", "after"), curves, strict=True))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 8.2), layout="constrained")
        axes = figure.subplots(3, 2, sharex=True, sharey="row")
        for a, name in enumerate(AXES):
            for k, colour in enumerate((BEFORE, AFTER)):
                ax = axes[a, k]
                zero_line(ax)
                if origin == "bounce":
                    ax.axvline(0.0, color=FAINT, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
                bands(ax, curves[k][a], colour)
                if k:
                    ax.plot(curves[0][a].place, curves[0][a].quantiles[2], color=BEFORE, linewidth=1.0, linestyle="--")
            axes[a, 0].set_ylabel(f"{name}, {MEANING[name]}\nmeasured $-$ predicted [mm]")
        axes[0, 0].set_title("before: nominal model", color=BEFORE, fontweight="bold")
        axes[0, 1].set_title("after: extended model", color=AFTER, fontweight="bold")
        for ax in axes[2]:
            ax.set_xlabel("time since the bounce [s]" if origin == "bounce" else "time since the first sample [s]")
    return figure, words


def _largest(name: str, row: Sequence[Curve], origin: str) -> str:
    places = [c.largest() if c.place.size else (0.0, 0.0) for c in row]
    a = int(np.argmax([abs(value) for _, value in places]))
    at, value = places[a]
    return f"largest median {name}: {value:+.1f} mm in {AXES[a]}, {moment(at, origin)}"


def moment(at: float, origin: str) -> str:
    """A time of ``flight_time`` in words."""
    if origin == "bounce":
        return f"{abs(at):.2f} s {'after' if at >= 0.0 else 'before'} the bounce"
    return f"{at:.2f} s after the first sample"


def usual(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Range of values without the fiftieth at each end, one value at least: what may set a scale."""
    low = np.percentile(values, 2, method="higher")
    return float(low), float(np.percentile(values, 98, method="lower"))


def set_limits(ax: Axes, curves: Sequence[Curve]) -> None:
    """Scale from the middle half and the usual width of the outer lines: a few wild balls do not flatten the rest."""
    every = np.concatenate([c.quantiles for c in curves], axis=1)
    if every.size:
        limit = max(1.25 * float(np.abs(every[1:4]).max()), 1.5 * float(np.median(np.abs(every[[0, 4]]))))
        ax.set_ylim(-limit, limit)


def quantities(found: BallFindings) -> Figure:
    """Residuals against speed, height, place along the table and time in the session; against spin where balls spin."""
    grid, base = found.problem.grid, found.search.linear.base
    speed = np.linalg.norm(base.velocity[:, :, 0], axis=0)
    height, along = grid.measured[2], grid.measured[1]
    whole = FEWEST_BALLS * int(np.median(grid.mask.sum(axis=0)))
    rows = [
        (speed, "speed [m/s]", FEWEST),
        (height, "height z [m]", FEWEST),
        (along, "place y [m] (human > 0, robot < 0)", FEWEST),
        (np.broadcast_to(found.sessions.age, grid.mask.shape), "time in the session (0 start, 1 end)", whole),
    ]
    if found.search.prior is not None:
        spin = found.search.at.start[SPIN]
        a = int(np.argmax(spin.std(axis=1) + np.abs(spin.mean(axis=1))))
        rows.append((np.broadcast_to(spin[a], grid.mask.shape), f"fitted spin about {AXES[a]} [rad/s]", whole))
    both = residuals(found)
    curves = [[[curve(q, r[a], grid.mask, 14, least) for r in both] for a in range(3)] for q, _, least in rows]
    # A quantity that too few balls have in a bin has nothing to show.
    shown = [
        (row, of) for (_, row, _), of in zip(rows, curves, strict=True) if any(c.place.size > 1 for p in of for c in p)
    ]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.5 + 2.1 * len(shown)), layout="constrained")
        axes = figure.subplots(len(shown), 3, sharex="row", sharey="col", squeeze=False)
        for across, (label, of) in zip(axes, shown, strict=True):
            for ax, pair in zip(across, of, strict=True):
                zero_line(ax)
                for c, colour in zip(pair, (BEFORE, AFTER), strict=True):
                    bands(ax, c, colour, light=True)
            across[1].set_xlabel(label)
        for a, name in enumerate(AXES):
            set_limits(axes[0, a], [c for _, of in shown for c in of[a]])
            axes[0, a].set_title(f"{name}, {MEANING[name]} [mm]")
        lines = [axes[0, 0].plot([], [], color=c, linewidth=2.2)[0] for c in (BEFORE, AFTER)]
        figure.legend(lines, ["before: nominal model", "after: extended model"], loc="outside upper left", ncols=2)
    return figure


def zero_line(ax: Axes) -> None:
    """Line at zero, and a faint grid."""
    ax.axhline(0.0, color=INK, linewidth=0.8, zorder=1)
    ax.grid(axis="y", color="#e6e9ed", linewidth=0.7)


def bands(ax: Axes, c: Curve, colour: str, light: bool = False) -> None:
    """Median as a line, middle 50 % as a band, middle 90 % as a fainter one (dotted lines where it is light)."""
    if not c.place.size:
        return
    q = c.quantiles
    if light:
        ax.plot(c.place, q[[0, 4]].T, color=colour, linewidth=0.7, alpha=0.6, linestyle=(0, (2, 2)))
    else:
        ax.fill_between(c.place, q[0], q[4], color=colour, alpha=0.13, linewidth=0)
    ax.fill_between(c.place, q[1], q[3], color=colour, alpha=0.16 if light else 0.27, linewidth=0)
    # The later curve is the thinner one: where both agree, the first still shows beneath it.
    ax.plot(c.place, q[2], color=colour, linewidth=3.0 if light and colour == BEFORE else 1.8, zorder=3)


def bounce_map(found: BallFindings) -> Figure:
    """Height after the bounce, measured minus predicted, at the place of the bounce, before and after."""
    grid, base = found.problem.grid, found.search.linear.base
    late = grid.mask & (grid.time > base.bounce_time[0])
    bounced = np.flatnonzero(late.sum(axis=0) >= 3)
    place = base.bounce[:2, 0, bounced]
    heights = [np.array([np.median(r[2, late[:, i], i]) for i in bounced]) for r in residuals(found)]
    limit = max(float(np.percentile(np.abs(heights[0]), 97)), 1e-3) if bounced.size else 1.0
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 6.6), layout="constrained")
        axes = figure.subplots(1, 2, sharex=True, sharey=True)
        for ax, height, title, colour in zip(
            axes, heights, ("before: nominal model", "after: extended model"), (BEFORE, AFTER), strict=True
        ):
            dots = ax.scatter(
                *place, c=height, s=16, cmap="PuOr_r", vmin=-limit, vmax=limit, edgecolor=INK, linewidth=0.2
            )
            ax.axhline(0.0, color=FAINT, linewidth=1.2)
            ax.set_title(title, color=colour, fontweight="bold")
            ax.set_xlabel("place of the bounce x [m]")
            ax.set_aspect("equal")
        axes[0].set_ylabel("y [m] (net at 0, human > 0)")
        figure.colorbar(dots, ax=axes, label="height after the bounce,\nmeasured $-$ predicted [mm]", shrink=0.8)
    return figure


def joints(robot: JointFindings) -> Figure:
    """Measured minus predicted positions of each joint over time and against its velocity, before and after."""
    rows = robot.residuals
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.8 + 1.55 * len(rows)), layout="constrained")
        axes = figure.subplots(len(rows), 2, squeeze=False, width_ratios=(2.0, 1.0), sharey="row")
        for r, (left, right) in zip(rows, axes, strict=True):
            unit = f"m{r.unit}"
            _joint(left, right, r)
            left.set_ylabel(f"{r.joint}\n[{unit}]")
            right.set_xlabel(f"velocity [{'m/s' if unit == 'mm' else 'rad/s'}]", fontsize=9, labelpad=1)
        axes[-1, 0].set_xlabel("time in the log [s]")
        lines = [axes[0, 0].plot([], [], color=c, linewidth=2.2)[0] for c in (BEFORE, AFTER, UNCHANGED)]
        labels = ["before: nominal model", "after: extended model", "nothing named: both alike"]
        figure.legend(lines, labels, loc="outside upper left", ncols=3)
    return figure


def _joint(left: Axes, right: Axes, r: JointResidual) -> None:
    before, after = 1e3 * (r.measured - r.nominal), 1e3 * (r.measured - r.extended)
    time = r.time - r.time[0]
    velocity = np.gradient(r.extended, r.time)
    # Predictions step where a window of the fit ends; what such a step makes of the velocity is none.
    usual = np.abs(velocity) <= 1.2 * np.percentile(np.abs(velocity), 99.5)
    largest = max(float(np.percentile(np.abs(before), 99.5)), float(np.percentile(np.abs(after), 99.5)), 1e-3)
    for ax in (left, right):
        zero_line(ax)
        ax.set_ylim(-1.15 * largest, 1.15 * largest)
    same = np.array_equal(before, after)
    kinds = ((before, UNCHANGED),) if same else ((before, BEFORE), (after, AFTER))
    for values, colour in kinds:
        left.plot(time, values, color=colour, linewidth=0.7)
        bands(right, curve(velocity, values, usual, 17), colour, light=True)
    left.set_xlim(0.0, time[-1])
