"""Errors of the time stamps: noise along the flight that grows with the ball's speed.

A moment's error dt shifts a sample by v dt. Noise that is merely larger along the flight does not grow with speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.ball.forward_model import Grid

LEAST_Z = 4.5
OUTLIER = 30.0  # times the median square beyond which a sample counts no more: a Gaussian's never is
LEAST_SHARE = 0.7  # of the noise along the flight beyond that across it which must grow with the speed's square


@dataclass(frozen=True)
class Jitter:
    """Deviation of the time stamps."""

    seconds: float
    low: float
    high: float
    shift: float  # [m] rms along the flight


def find(left: np.ndarray, velocity: np.ndarray, g: Grid) -> Jitter | None:
    """left: (3, T, n) residuals [m] of the best model; velocity: (3, T, n). None where nothing grows with the speed.

    Neighbouring samples are subtracted from each other: what is smooth along the flight is a misfit, not a shaking clock.
    """
    near = g.mask[1:] & g.mask[:-1] & (np.diff(g.time, axis=0) < 1.5 * np.median(np.diff(g.time, axis=0)[g.mask[1:]]))
    step, mean = np.diff(left, axis=1) / np.sqrt(2.0), 0.5 * (velocity[:, 1:] + velocity[:, :-1])
    square = (mean**2).sum(axis=0)
    along = (step * mean).sum(axis=0) / np.sqrt(np.maximum(square, 1e-9))
    across = 0.5 * ((step**2).sum(axis=0) - along**2)
    cap = OUTLIER * np.median((step**2).sum(axis=0)[near])
    excess = np.where(near, np.minimum(along**2, cap) - np.minimum(across, cap), 0.0)
    count = near.sum(axis=0)
    design = np.stack([count, np.where(near, square, 0.0).sum(axis=0)])
    gram = np.array([[count.sum(), design[1].sum()], [design[1].sum(), np.where(near, square**2, 0.0).sum()]])
    right = np.array([excess.sum(), (excess * square).sum()])
    constant, slope = np.linalg.solve(gram, right)
    rest = np.where(near, excess - constant - slope * square, 0.0)
    scores = np.stack([rest.sum(axis=0), (rest * square).sum(axis=0)])
    inverse = np.linalg.inv(gram)
    error = float(np.sqrt((inverse @ scores @ scores.T @ inverse)[1, 1]))
    typical = float(np.median(square[near]))
    if slope < LEAST_Z * error or slope * typical < LEAST_SHARE * max(constant + slope * typical, 1e-12):
        return None
    low, high = (np.sqrt(max(slope + s * 1.645 * error, 0.0)) for s in (-1, 1))
    return Jitter(float(np.sqrt(slope)), float(low), float(high), float(np.sqrt(slope * typical)))
