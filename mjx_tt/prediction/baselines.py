"""Simple predictors to compare with, in NumPy alone: a parabola, and an extended Kalman filter.

They share no code with the simulation. Component axis first, balls last; SI units, table frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ballmodel.constants import GRAVITY
from ballmodel.kalman import Kalman, Physics, move
from ballmodel.trajectory import Trajectory

NOISE = 0.003  # [m] of a sample that the filter expects
SPEED, SPIN = 8.0, 100.0  # [m/s], [rad/s] deviations before the first sample
PHYSICS, FALL = Physics(), Physics(drag=0.0, lift=0.0)
POSITION = np.eye(3, 9)


def parabola(
    tracks: Sequence[Trajectory], seconds: float, times: Float[np.ndarray, "h n"]
) -> Float[np.ndarray, "3 h n"]:
    """Places on a parabola of free fall through the first ``seconds``, reflected at the table."""

    def fit(since: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        fallen = np.stack([position[0], position[1], position[2] + 0.5 * GRAVITY * since**2])
        start, velocity = np.linalg.lstsq(np.stack([np.ones(since.size), since], axis=1), fallen.T, rcond=None)[0]
        return np.concatenate([start, velocity, np.zeros(3)]), 0.0

    return _predict(fit, FALL, tracks, seconds, times)


def kalman(tracks: Sequence[Trajectory], seconds: float, times: Float[np.ndarray, "h n"]) -> Float[np.ndarray, "3 h n"]:
    """Places after an extended Kalman filter of position, velocity and spin over the first ``seconds``."""

    def fit(since: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, float]:
        mean = np.concatenate([position[:, 0], (position[:, 3] - position[:, 0]) / since[3], np.zeros(3)])
        covariance = np.diag([NOISE**2] * 3 + [(2 * NOISE / since[3] + 1.0) ** 2] * 3 + [SPIN**2] * 3)
        ball = Kalman(mean, covariance, PHYSICS)
        for k in range(1, since.size):
            ball.predict(float(since[k] - since[k - 1]))
            ball.correct(position[:, k] - ball.mean[:3], POSITION, np.eye(3) * NOISE**2)
        return ball.mean, since[-1]

    return _predict(fit, PHYSICS, tracks, seconds, times)


def _predict(
    fit: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, float]],
    physics: Physics,
    tracks: Sequence[Trajectory],
    seconds: float,
    times: Float[np.ndarray, "h n"],
) -> Float[np.ndarray, "3 h n"]:
    """Places at increasing times [s] after the first samples. fit: gives a track's state (9,), and its moment [s]."""
    out = np.zeros((3, *times.shape))
    for i, t in enumerate(tracks):
        since = t.time - t.time[0]
        stop = max(int(np.searchsorted(since, seconds + 1e-9, side="right")), 4)
        mean, moment = fit(since[:stop], t.position[:, :stop])
        state, before = mean[:, None], 0.0
        for h, time in enumerate(times[:, i] - moment):
            state, before = move(state, np.array([time - before]), physics), time
            out[:, h, i] = state[:3, 0]
    return out
