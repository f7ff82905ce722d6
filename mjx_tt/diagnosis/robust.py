"""Robust statistics that ball, hits and joints share: Huber's weights and loss, and deviations from medians."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

OUTLIER = 30.0  # times the median square beyond which a sample counts no more: a Gaussian's never is
GAUSSIAN = 1.4826  # standard deviation of a Gaussian over its median absolute deviation


def huber_weights(distance: Float[np.ndarray, ...], limit: float) -> Float[np.ndarray, ...]:
    """Weights in least squares of samples at a distance >= 0, which count linearly beyond ``limit``."""
    return np.minimum(1.0, limit / np.maximum(distance, 1e-9))


def huber_loss(distance: Float[np.ndarray, ...], limit: float) -> Float[np.ndarray, ...]:
    """Squared distance up to ``limit``, linear beyond it."""
    return np.where(distance <= limit, distance * distance, limit * (2.0 * distance - limit))


def bounded_mean(square: Float[np.ndarray, " n"]) -> float:
    """Mean of squares, none of which counts more than an OUTLIER."""
    return float(np.minimum(square, OUTLIER * np.median(square)).mean())


def deviation(x: Float[np.ndarray, ...], axis: int | None = None) -> Float[np.ndarray, ...]:
    """Standard deviation of a Gaussian about zero, from the median of |x|."""
    return GAUSSIAN * np.median(np.abs(x), axis=axis)
