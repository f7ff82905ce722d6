"""Simple predictors to compare with, in NumPy alone: a parabola, and an extended Kalman filter.

They share no code with the simulation. Component axis first, balls last; SI units, table frame.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    out = np.zeros((3, *times.shape))
    for i, t in enumerate(tracks):
        since = t.time - t.time[0]
        stop = max(int(np.searchsorted(since, seconds + 1e-9, side="right")), 4)
        since, position = since[:stop], t.position[:, :stop].copy()
        position[2] += 0.5 * GRAVITY * since**2
        start, velocity = np.linalg.lstsq(np.stack([np.ones(stop), since], axis=1), position.T, rcond=None)[0]
        state = np.concatenate([start, velocity, np.zeros(3)])[:, None]
        out[:, :, i] = _places(state, times[:, i : i + 1], FALL)[:, :, 0]
    return out


def kalman(tracks: Sequence[Trajectory], seconds: float, times: Float[np.ndarray, "h n"]) -> Float[np.ndarray, "3 h n"]:
    """Places after an extended Kalman filter of position, velocity and spin over the first ``seconds``."""
    out = np.zeros((3, *times.shape))
    for i, t in enumerate(tracks):
        since = t.time - t.time[0]
        stop = max(int(np.searchsorted(since, seconds + 1e-9, side="right")), 4)
        velocity = (t.position[:, 3] - t.position[:, 0]) / since[3]
        mean = np.concatenate([t.position[:, 0], velocity, np.zeros(3)])
        covariance = np.diag([NOISE**2] * 3 + [(2 * NOISE / since[3] + 1.0) ** 2] * 3 + [SPIN**2] * 3)
        ball = Kalman(mean, covariance, PHYSICS)
        for k in range(1, stop):
            ball.predict(float(since[k] - since[k - 1]))
            ball.correct(t.position[:, k] - ball.mean[:3], POSITION, np.eye(3) * NOISE**2)
        out[:, :, i] = _places(ball.mean[:, None], times[:, i : i + 1] - since[stop - 1], PHYSICS)[:, :, 0]
    return out


def _places(
    state: Float[np.ndarray, "9 n"], times: Float[np.ndarray, "h n"], physics: Physics
) -> Float[np.ndarray, "3 h n"]:
    """Places at increasing times [s] from the states on."""
    out, before = [], np.zeros(times.shape[1])
    for time in times:
        state, before = move(state, time - before, physics), time
        out.append(state[:3])
    return np.stack(out, axis=1)
