"""The one picture that shows the verdict, and a line below it."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.diagnose import Diagnosis
from mjx_tt.diagnosis.joint import JointFindings, JointResidual
from mjx_tt.diagnosis.report import figures, residuals
from mjx_tt.diagnosis.report.residuals import AFTER, AXES, BEFORE, MEANING, UNCHANGED, Curve
from mjx_tt.viz.html import STYLE, WIDTH

HEIGHT = 3.4  # [inch]
EXCERPT = 8.0  # [s] of a joint's log
PADDLE = "paddle_"  # effects that hits show


def picture(d: Diagnosis) -> tuple[Figure, str] | None:
    """Figure and caption, in plain text; None without anything measured.

    Of what stays unexplained, else of the cause with the largest effect, else of what the logs are about.
    """
    odd = d.verdict.unexplained
    about = odd.block if odd is not None else d.verdict.causes[0].name if d.verdict.causes else ""
    if d.robot is not None and d.robot.residuals:
        joint = next((r for r in d.robot.residuals if about.startswith((f"{r.joint}.", f"{r.joint}:"))), None)
        if joint is not None or d.balls is None:
            return _joint(_worst(d.robot) if joint is None else joint)
    if d.hits is not None and about.startswith(PADDLE):
        return figures.hits(d.hits), f"Each dot is one of {d.hits.hits} hits; diamonds are medians."
    return None if d.balls is None else _balls(d.balls, odd is not None)


def _balls(found: BallFindings, unexplained: bool) -> tuple[Figure, str]:
    """Axis and residual that say most, along the flight, before and after."""
    mask = found.problem.grid.mask
    time, origin = residuals.flight_time(found)
    both = residuals.residuals(found)
    curves = [[residuals.curve(time, r[a], mask, 30) for a in range(3)] for r in both]
    a = int(np.argmax([abs(_largest(c)[1]) for c in curves[1 if unexplained else 0]]))
    before, after = curves[0][a], curves[1][a]
    same = np.array_equal(before.quantiles, after.quantiles)
    kinds = ((before, UNCHANGED),) if same else ((before, BEFORE), (after, AFTER))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
        ax = figure.subplots()
        residuals.zero_line(ax)
        for c, colour in kinds:
            residuals.bands(ax, c, colour, light=True)
        residuals.set_limits(ax, [c for c, _ in kinds])
        ax.set_xlabel(f"time since the {'bounce' if origin == 'bounce' else 'first sample'} [s]")
        ax.set_ylabel(f"measured $-$ predicted\nin {AXES[a]}, {MEANING[AXES[a]]} [mm]")
        lines = [ax.plot([], [], color=colour, linewidth=2.2)[0] for _, colour in kinds]
        labels = ["nominal model: nothing changed"] if same else ["nominal model", "extended model"]
        figure.legend(lines, labels, loc="outside upper left", ncols=2)
    at, value = _largest(before)
    where = residuals.moment(at, origin)
    words = f"Median of {found.problem.grid.n} balls, with the middle half (band) and the middle 90 % (dotted). "
    words += f"The nominal model misses by {value:+.1f} mm at most, {where}"
    return figure, words + ("." if same else f"; the extended one by {_largest(after)[1]:+.1f} mm.")


def _largest(c: Curve) -> tuple[float, float]:
    return c.largest() if c.place.size else (0.0, 0.0)


def _worst(robot: JointFindings) -> JointResidual:
    """Joint whose positions the nominal model misses most, relative to how far it moves."""
    return max(robot.residuals, key=lambda r: float(np.std(r.measured - r.nominal) / max(np.ptp(r.measured), 1e-9)))


def _joint(r: JointResidual) -> tuple[Figure, str]:
    """The seconds in which the nominal model misses most, before and after."""
    time = r.time - r.time[0]
    before, after = 1e3 * (r.measured - r.nominal), 1e3 * (r.measured - r.extended)
    starts = np.arange(0.0, max(time[-1] - EXCERPT, 0.0) + 1e-9, 0.5 * EXCERPT)
    parts = [(time >= t) & (time <= t + EXCERPT) for t in starts]
    part = max(parts, key=lambda p: float(np.mean(before[p] ** 2)))
    same = np.array_equal(before, after)
    unit = f"m{r.unit}"
    kinds = ((before, UNCHANGED),) if same else ((before, BEFORE), (after, AFTER))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
        ax = figure.subplots()
        residuals.zero_line(ax)
        for values, colour in kinds:
            ax.plot(time[part], values[part], color=colour, linewidth=1.2)
        limit = 1.2 * max(max(float(np.percentile(np.abs(v[part]), 99.0)) for v, _ in kinds), 1e-3)
        ax.set_ylim(-limit, limit)
        ax.set_xlim(time[part][0], time[part][-1])
        ax.set_xlabel("time in the log [s]")
        ax.set_ylabel(f"{r.joint}, measured $-$ predicted [{unit}]")
        lines = [ax.plot([], [], color=colour, linewidth=2.2)[0] for _, colour in kinds]
        labels = ["nominal model: nothing changed"] if same else ["nominal model", "extended model"]
        figure.legend(lines, labels, loc="outside upper left", ncols=2)
    rms = [float(np.sqrt(np.mean(v[part] ** 2))) for v, _ in kinds]
    words = f"{part.sum()} samples of {r.joint}. The nominal model misses by {rms[0]:.2g} {unit} rms"
    return figure, words + ("." if same else f", the extended one by {rms[1]:.2g} {unit}.")
