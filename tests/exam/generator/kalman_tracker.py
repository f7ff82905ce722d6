"""A tracker with a Kalman filter of constant acceleration, started afresh where a measurement surprises it.

The textbook's recursion with a covariance (the model under examination has one number for its memory and none for its
noise), run forward over every ball's samples, so that it filters the noise as well.
"""

from __future__ import annotations

import numpy as np

from tests.exam.generator.sessions import INTERVAL, SIGMA

FRESH = np.diag([0.05**2, 5.0**2, 20.0**2])  # covariance added when it starts afresh


def tracked(measured: np.ndarray, jerk: float, gate: float) -> np.ndarray:
    """Filtered positions (3, T, B) [m]; NaN where nothing was measured.

    jerk: density of the white jerk [m/s^3 / sqrt(Hz)]; gate: surprise in variances of the innovation, three axes.
    """
    dt = INTERVAL
    move = np.array([[1.0, dt, dt**2 / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    shape = [[dt**4 / 20, dt**3 / 8, dt**2 / 6], [dt**3 / 8, dt**2 / 3, dt / 2], [dt**2 / 6, dt / 2, 1.0]]
    growth = jerk**2 * dt * np.array(shape)
    balls = measured.shape[2]
    state = np.zeros((3, 3, balls))  # derivative, axis, ball: it has watched the ball come
    state[0] = measured[:, 0]
    state[1] = (measured[:, 3] - measured[:, 0]) / (3.0 * dt)
    state[2, 2] = -9.81
    state[1] -= 1.5 * dt * state[2]
    covariance = np.repeat(FRESH[..., None], balls, axis=2)
    out = np.full_like(measured, np.nan)
    for k in range(measured.shape[1]):
        if k:
            state = np.einsum("ij,jab->iab", move, state)
            covariance = np.einsum("ij,jkb,lk->ilb", move, covariance, move) + growth[..., None]
        seen = np.isfinite(measured[0, k])
        surprise = np.where(seen, measured[:, k] - state[0], 0.0)
        afresh = seen & ((surprise**2).sum(axis=0) > gate * (covariance[0, 0] + SIGMA**2)) & (k > 0)
        covariance = covariance + np.where(afresh, FRESH[..., None], 0.0)
        gain = np.where(seen, covariance[:, 0] / (covariance[0, 0] + SIGMA**2), 0.0)
        state = state + gain[:, None] * surprise
        covariance = covariance - gain[:, None] * covariance[0]
        out[:, k] = np.where(seen, state[0], np.nan)
    return out


def lag(clean: np.ndarray, jerk: float, gate: float) -> float:
    """Median over balls of the largest error [m] that the filter makes on a flight (3, T, B) without noise."""
    error = np.linalg.norm(tracked(clean, jerk, gate) - clean, axis=0)
    return float(np.median(np.nanmax(error, axis=0)))
