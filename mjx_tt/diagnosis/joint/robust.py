"""Huber's loss, for positions among which a few are far off."""

from __future__ import annotations

import numpy as np

HUBER = 2.5  # noise deviations beyond which a sample counts linearly
SMALLEST_NOISE = 5e-5  # [rad], [m]: no log is believed more exactly


def weights(r: np.ndarray, sigma: float) -> np.ndarray:
    """Weight of each residual (n,) in least squares."""
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-300))


def loss(r: np.ndarray, sigma: float) -> np.ndarray:
    """Huber's loss of each sample (n,) in squared noise deviations."""
    x = np.abs(r) / sigma
    return np.where(x <= HUBER, x * x, HUBER * (2.0 * x - HUBER))


def scale(r: np.ndarray) -> float:
    """Standard deviation of the noise, from the median."""
    return max(1.4826 * float(np.median(np.abs(r))), SMALLEST_NOISE)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x * x)))
