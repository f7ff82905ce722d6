"""Simple predictors to compare with, in NumPy alone: a parabola, and an extended Kalman filter.

They share no code with the simulation. Component axis first, balls last; SI units, table frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ballmodel.constants import BALL_RADIUS, GRAVITY
from ballmodel.trajectory import Trajectory

STEP = 0.004  # [s] of an integration
DRAG, LIFT = 0.125, 0.0033  # [1/m], []: C_d 0.42 and k 0.55 at 1.2 kg/m^3
RESTITUTION, FRICTION = 0.92, 0.22
NOISE = 0.003  # [m] of a sample that the filter expects
SPEED, SPIN = 8.0, 100.0  # [m/s], [rad/s] deviations before the first sample
WANDER = 2.0  # [m/s^2 sqrt(s)] of the acceleration that the filter does not know
DIFFERENCE = np.array([1e-4] * 3 + [1e-3] * 3 + [0.1] * 3)
HALF_TABLE = (0.7625, 1.37)  # [m]


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
        out[:, :, i] = _places(state, times[:, i : i + 1], 0.0, 0.0)[:, :, 0]
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
        for k in range(1, stop):
            dt = float(since[k] - since[k - 1])
            around = mean[:, None] + np.concatenate([np.zeros((9, 1)), np.diag(DIFFERENCE)], axis=1)
            moved = _moved(around, dt, DRAG, LIFT)
            slope = (moved[:, 1:] - moved[:, :1]) / DIFFERENCE
            drift = np.diag([WANDER**2 * dt**3 / 3] * 3 + [WANDER**2 * dt] * 3 + [0.0] * 3)
            mean, covariance = moved[:, 0], slope @ covariance @ slope.T + drift
            total = covariance[:3, :3] + np.eye(3) * NOISE**2
            gain = covariance[:, :3] @ np.linalg.inv(total)
            mean = mean + gain @ (t.position[:, k] - mean[:3])
            covariance = covariance - gain @ covariance[:3]
        ahead = times[:, i : i + 1] - since[stop - 1]
        out[:, :, i] = _places(mean[:, None], ahead, DRAG, LIFT)[:, :, 0]
    return out


def _places(
    state: Float[np.ndarray, "9 n"], times: Float[np.ndarray, "h n"], drag: float, lift: float
) -> Float[np.ndarray, "3 h n"]:
    """Places at increasing times [s] from the states on."""
    out, before = [], np.zeros(times.shape[1])
    for time in times:
        state, before = _moved(state, time - before, drag, lift), time
        out.append(state[:3])
    return np.stack(out, axis=1)


def _moved(
    state: Float[np.ndarray, "9 n"], seconds: float | Float[np.ndarray, " n"], drag: float, lift: float
) -> Float[np.ndarray, "9 n"]:
    """States after some seconds: midpoint steps, with bounces on the table where a step ends below it."""
    count = max(int(np.ceil(np.max(seconds) / STEP)), 1)
    dt = np.asarray(seconds) / count
    for _ in range(count):
        state = _bounced(state, _stepped(state, dt, drag, lift), dt, drag, lift)
    return state


def _stepped(state: Float[np.ndarray, "9 n"], dt: np.ndarray, drag: float, lift: float) -> Float[np.ndarray, "9 n"]:
    middle = state[3:6] + 0.5 * dt * _acceleration(state[3:6], state[6:], drag, lift)
    velocity = state[3:6] + dt * _acceleration(middle, state[6:], drag, lift)
    return np.concatenate([state[:3] + dt * middle, velocity, state[6:]])


def _acceleration(velocity: np.ndarray, spin: np.ndarray, drag: float, lift: float) -> np.ndarray:
    out = lift * np.cross(spin, velocity, axis=0) - drag * np.linalg.norm(velocity, axis=0) * velocity
    out[2] -= GRAVITY
    return out


def _bounced(before: np.ndarray, after: np.ndarray, dt: np.ndarray, drag: float, lift: float) -> np.ndarray:
    """The states after a step, with the bounce of those that met the table in it."""
    over = (np.abs(after[0]) < HALF_TABLE[0]) & (np.abs(after[1]) < HALF_TABLE[1])
    meets = over & (before[2] > BALL_RADIUS) & (after[2] <= BALL_RADIUS)
    if not meets.any():
        return after
    share = np.clip((before[2] - BALL_RADIUS) / np.maximum(before[2] - after[2], 1e-9), 0.0, 1.0)
    at = _stepped(before, share * dt, drag, lift)
    at[2] = BALL_RADIUS
    slip = np.stack([at[3] - BALL_RADIUS * at[7], at[4] + BALL_RADIUS * at[6]])
    speed = np.linalg.norm(slip, axis=0) + 1e-12
    change = -np.minimum(FRICTION * (1.0 + RESTITUTION) * np.abs(at[5]) / speed, 0.4) * slip
    at[3:5] += change
    at[5] *= -RESTITUTION
    # The impulse acts a radius below the centre of a thin shell, I = 2/3 m r^2.
    at[6] += 1.5 / BALL_RADIUS * change[1]
    at[7] -= 1.5 / BALL_RADIUS * change[0]
    rest = _stepped(at, (1.0 - share) * dt, drag, lift)
    return np.where(meets, rest, after)
