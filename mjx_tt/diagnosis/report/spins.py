"""Picture of the balls' spins: about the table's axes, each with its deviation, and how fast they are."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from mjx_tt.diagnosis.ball.spins import Spins
from mjx_tt.diagnosis.report.residuals import AFTER, usual
from mjx_tt.viz.html import INK, STYLE, WIDTH


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
