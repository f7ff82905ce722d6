"""Figures of a verdict: how large the causes are, what they gain, how balls spin, what was taken out of the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import bdtr

from mjx_tt.diagnosis.ball.cross_validation import Prediction
from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.spins import Spins
from mjx_tt.diagnosis.hits.diagnose import HitFindings
from mjx_tt.diagnosis.joint import JointFindings
from mjx_tt.diagnosis.report.residuals import AFTER, AXES, BEFORE, MEANING, UNCHANGED, usual
from mjx_tt.diagnosis.tracks import Record
from mjx_tt.diagnosis.tracks.clean import KINDS, MEANINGS
from mjx_tt.diagnosis.verdict import Cause
from mjx_tt.viz.html import FAINT, INK, STYLE, WIDTH

MOST_TRACKS = 150  # drawn behind what was taken out, spread over the log
COLOURS = matplotlib.colormaps["tab10"]
FAR = 12.0  # times the smallest, beyond which the largest of several sizes makes the scale logarithmic


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Median of (n,) values with the 90 % interval that their order gives, whatever their distribution (n >= 5)."""
    ordered = np.sort(values)
    k = int(np.searchsorted(bdtr(np.arange(ordered.size), ordered.size, 0.5), 0.05))
    return float(np.median(ordered)), float(ordered[k - 1]), float(ordered[ordered.size - k])


def hits(found: HitFindings) -> Figure:
    """Place and velocity behind the paddle, measured minus predicted, hit by hit, before and after."""
    same = not found.causes
    kinds = ((found.before, UNCHANGED),) if same else ((found.before, BEFORE), (found.after, AFTER))
    jitter = 0.5 * np.random.default_rng(0).uniform(-1.0, 1.0, found.hits)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.6 if same else 4.6), layout="constrained")
        for ax, first, factor, what in zip(
            figure.subplots(1, 2),
            (0, 3),
            (1e3, 1.0),
            ("place at the hit [mm]", "velocity behind the paddle [m/s]"),
            strict=True,
        ):
            ends = np.array([usual(factor * row) for values, _ in kinds for row in values[first : first + 3]])
            # A few wild hits stay on the edge and do not flatten the rest.
            low, high = min(float(ends[:, 0].min()), 0.0), max(float(ends[:, 1].max()), 0.0)
            margin = max(0.08 * (high - low), 1e-3)
            low, high = low - margin, high + margin
            for a in range(3):
                for k, (values, colour) in enumerate(kinds):
                    mine, row = factor * values[first + a], a if same else a + 0.4 * k - 0.2
                    width = 0.5 if same else 0.3
                    at = row + width * jitter
                    wild = (mine < low) | (mine > high)
                    ax.scatter(mine[~wild], at[~wild], s=13, color=colour, alpha=0.5, linewidth=0)
                    for edge, out, marker in ((low, mine < low, "<"), (high, mine > high, ">")):
                        ax.scatter(np.full(out.sum(), edge), at[out], s=18, marker=marker, color=colour, linewidth=0)
                    middle, *interval = median_interval(mine)
                    ax.plot(interval, [row, row], color=INK, linewidth=1.6, marker="|", markersize=11, zorder=4)
                    ax.plot([middle], [row], "D", color=colour, markersize=6, markeredgecolor="white", zorder=5)
            ax.axvline(0.0, color=INK, linewidth=0.9, zorder=1)
            for border in (0.5, 1.5):
                ax.axhline(border, color="#e6e9ed", linewidth=1.0, zorder=0)
            ax.grid(axis="x", color="#e6e9ed", linewidth=0.7)
            ax.set_xlim(low - 0.3 * margin, high + 0.3 * margin)
            ax.set_ylim(2.5, -0.5)
            ax.set_yticks(range(3), [f"{name}\n{MEANING[name]}" for name in AXES] if first == 0 else AXES)
            ax.tick_params(axis="y", length=0)
            ax.set_xlabel(f"measured $-$ predicted {what}")
        if same:
            labels = ["nothing named at the paddle: before and after alike"]
        else:
            labels = ["before: nominal paddle", "after: with what the hits name"]
        dots = [ax.plot([], [], "D", color=colour, markersize=6)[0] for _, colour in kinds]
        figure.legend(dots, labels, loc="outside upper left", ncols=2)
    return figure


@dataclass(frozen=True)
class Row:
    """A line of the forest plot; all in ``unit``."""

    label: str
    estimate: float
    low: float
    high: float
    unit: str  # "mm" or "mrad"


def forest_rows(causes: Sequence[Cause], found: BallFindings | None) -> list[Row]:
    """Each cause's deviation from the nominal value as the shift that it makes."""
    rows = []
    for cause in causes:
        spins = [p for p in cause.parameters if p.startswith("ball_spin.mean_")]
        if spins and found is not None:
            per = 1e3 * found.search.spin_shift
            rows += [
                Row(f"spin about {p[-1]}, mean", per * e.estimate, per * e.low, per * e.high, "mm")
                for p in spins
                for e in [cause.parameters[p]]
            ]
            continue
        e = next(iter(cause.parameters.values()))
        change = e.estimate - e.nominal
        if not np.isfinite(change) or change == 0.0:
            continue
        per = cause.effect_mm / abs(change)
        unit = "mrad" if cause.name.startswith("joint_") else "mm"
        rows.append(Row(cause.name, per * change, per * (e.low - e.nominal), per * (e.high - e.nominal), unit))
    return rows


def forest(rows: Sequence[Row]) -> Figure:
    """Estimates with 90 % intervals as shifts."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.0 + 0.42 * len(rows)), layout="constrained")
        ax = figure.subplots()
        at = np.arange(len(rows))
        ax.axvline(0.0, color=INK, linewidth=0.9)
        ax.grid(axis="x", color="#e6e9ed", linewidth=0.7)
        for k, r in zip(at, rows, strict=True):
            ax.plot([r.low, r.high], [k, k], color=AFTER, linewidth=5.0, alpha=0.35, solid_capstyle="butt")
            ax.plot([r.estimate], [k], "o", color=AFTER, markersize=7)
        sizes = sorted(max(abs(r.low), abs(r.high)) for r in rows)
        if len(sizes) > 1 and sizes[-1] > FAR * sizes[0]:
            # The largest would press all others onto zero.
            ax.set_xscale("symlog", linthresh=max(sizes[0], 1e-3), linscale=0.6)
            ax.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        ax.set_yticks(at, [r.label for r in rows])
        ax.set_ylim(len(rows) - 0.4, -0.6)
        ax.margins(x=0.12)
        ax.tick_params(axis="y", length=0)
        joints = any("." in r.label for r in rows)
        units = sorted({r.unit for r in rows}, reverse=True)
        what = "rms movement that it makes" if joints else "shift of a flight's last sample"
        scale = "" if ax.get_xscale() == "linear" else "; logarithmic"
        ax.set_xlabel(f"deviation from nominal, as the {what} [{' or '.join(units)}]{scale}")
    return figure


def held_out(prediction: Prediction) -> Figure:
    """Errors of predicted flights ball by ball: before against after, and the distribution of the gain."""
    good = np.isfinite(prediction.before) & np.isfinite(prediction.after)
    before, after = 1e3 * prediction.before[good], 1e3 * prediction.after[good]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        lows, highs = zip(usual(before), usual(after), strict=True)
        low, high = max(0.85 * min(lows), 1e-2), 1.15 * max(highs)
        left.plot([low, high], [low, high], color=INK, linewidth=0.9)
        left.scatter(np.clip(before, low, high), np.clip(after, low, high), s=13, color=AFTER, alpha=0.5, linewidth=0)
        left.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), aspect="equal")
        for axis in (left.xaxis, left.yaxis):
            axis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
            axis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        left.set_xlabel("error before [mm]", color=BEFORE)
        left.set_ylabel("error after [mm]", color=AFTER)
        left.set_title("one dot a ball; below the line:\nbetter after")
        _gains(right, before - after)
    return figure


def _gains(ax: Axes, gain: np.ndarray) -> None:
    """Histogram of gains (n,) [mm] from the smallest to the largest that are usual, with zero; the rest at its ends."""
    low, high = usual(gain)
    low, high = min(low, -0.05 * high, -0.05), max(high, -0.05 * low, 0.05)
    ax.hist(np.clip(gain, low, high), np.linspace(low, high, 33).tolist(), color=FAINT)
    middle = float(np.median(gain))
    ax.axvline(0.0, color=INK, linewidth=0.9)
    ax.axvline(middle, color=AFTER, linewidth=2.0)
    ax.set_title(f"median {middle:+.2f} mm;\n{100 * np.mean(gain > 0.0):.0f} % of the balls gain")
    ax.set_xlabel("error before $-$ error after [mm]")
    ax.set_ylabel("balls")


def joint_gains(robot: JointFindings) -> Figure:
    """Prediction errors of joint positions on windows that were not used."""
    rows = robot.held_out
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.2 + 0.46 * len(rows)), layout="constrained")
        ax = figure.subplots()
        at = np.arange(len(rows))
        for shift, values, colour, name in (
            (-0.19, [1e3 * g.before for g in rows], BEFORE, "before"),
            (0.19, [1e3 * g.after for g in rows], AFTER, "after"),
        ):
            ax.barh(at + shift, values, height=0.36, color=colour, label=name)
        sizes = np.array([1e3 * e for g in rows for e in (g.before, g.after)])
        wide = sizes.max() > FAR * max(sizes.min(), 1e-9)
        if wide:
            ax.set_xscale("log")
        ax.set_yticks(at, [f"{g.joint} [m{g.unit}]" for g in rows])
        ax.invert_yaxis()
        ax.tick_params(axis="y", length=0)
        ax.grid(axis="x", color="#e6e9ed", linewidth=0.7)
        if wide:
            ax.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
            ax.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        ax.set_xlabel(f"rms error of the predicted position [mm], [mrad]{'; logarithmic' if wide else ''}")
        figure.legend(loc="outside upper left", ncols=2)
    return figure


def play(rates: Sequence[tuple[str, float, float, float]]) -> Figure:
    """Return rates in play: label, rate, low and high (0 to 1)."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.9 + 0.5 * len(rates)), layout="constrained")
        ax = figure.subplots()
        at = np.arange(len(rates))
        for k, (_, rate, low, high) in zip(at, rates, strict=True):
            colour = BEFORE if k == 0 else AFTER
            ax.plot([100 * low, 100 * high], [k, k], color=colour, linewidth=5.0, alpha=0.35, solid_capstyle="butt")
            ax.plot([100 * rate], [k], "o", color=colour, markersize=7)
        ax.grid(axis="x", color="#e6e9ed", linewidth=0.7)
        ax.set_yticks(at, [label for label, *_ in rates])
        ax.set_ylim(len(rates) - 0.4, -0.6)
        every = 100.0 * np.array([ends for _, *ends in rates])
        ax.set_xlim(max(0.0, every.min() - 5.0), min(100.5, every.max() + 5.0))
        ax.tick_params(axis="y", length=0)
        ax.set_xlabel("balls returned [%]")
    return figure


def taken_out(record: Record) -> Figure:
    """Samples that were taken out, over the tracks they came from."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
        views = figure.subplots(1, 2)
    for ax, (i, j), labels in zip(views, ((1, 2), (1, 0)), (("y [m]", "z [m]"), ("y [m]", "x [m]")), strict=True):
        for t in record.tracks[:: max(len(record.tracks) // MOST_TRACKS, 1)]:
            ax.plot(t.position[i], t.position[j], color=FAINT, lw=0.5, alpha=0.5)
        for kind in KINDS:
            found = [e for e in record.of(kind) if e.samples]
            for k, entry in enumerate(found):
                label = MEANINGS[kind].partition(";")[0] if k == 0 else None
                colour = COLOURS(KINDS.index(kind) % COLOURS.N)
                ax.plot(entry.position[i], entry.position[j], ".", ms=3.5, color=colour, label=label)
        ax.set(xlabel=labels[0], ylabel=labels[1])
    if any(e.samples for e in record.entries):
        figure.legend(*views[0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    return figure


def spins(found: Spins) -> Figure:
    """Spins about x against z and against y with one standard deviation, and the distribution of their size."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
        plots = figure.subplots(1, 3)
    for ax, axis in zip(plots[:2], (2, 1), strict=True):
        # A few wild balls, beyond the usual by far, do not press the rest together.
        for k, limits in ((0, ax.set_xlim), (axis, ax.set_ylim)):
            low, high = usual(found.mean[k])
            margin = 0.3 * (high - low) + 2.0 * np.median(found.std[k])
            limits(min(low - margin, 0.0), max(high + margin, 0.0))
        ax.errorbar(
            found.mean[0],
            found.mean[axis],
            xerr=found.std[0],
            yerr=found.std[axis],
            fmt=".",
            ms=4,
            lw=0.5,
            color=AFTER,
            alpha=0.6,
        )
        ax.axhline(0.0, color=INK, lw=0.6)
        ax.axvline(0.0, color=INK, lw=0.6)
        ax.set(xlabel="spin about x [rad/s]", ylabel=f"spin about {'xyz'[axis]} [rad/s]")
    size = np.linalg.norm(found.mean, axis=0)
    most = 1.3 * usual(size)[1]
    plots[2].hist(np.minimum(size, most), bins=min(30, max(len(size) // 6, 5)), color=AFTER, alpha=0.7)
    plots[2].set(xlabel="size of the spin [rad/s]", ylabel="balls")
    return figure
