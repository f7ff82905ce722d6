"""The motion of one control tick as the arm is told it, between two ticks and where no other tick follows."""

from __future__ import annotations

import math

import numpy as np

HOLD_AFTER = 0.2  # [s] after which an arm that was told to stand is told to stay where it is measured


class Coasting:
    """The last tick's reference and velocity. Times are seconds of one monotonic clock, passed in.

    A motion that no tick renews for ``patience`` seconds slows down at the acceleration limits by itself, one step a
    period, along the very way that the gate has proven clear. It uses neither the gate nor the devices, because one
    of them may have stopped the ticks.
    """

    def __init__(self, period: float, patience: float, acceleration: np.ndarray) -> None:
        self._period, self._patience, self._step = period, patience, acceleration * period
        self.time = -math.inf  # of the tick
        self.start = np.full_like(acceleration, np.nan)  # reference (n,) at the tick
        self._velocity = np.zeros_like(acceleration)

    def ticked(self, start: np.ndarray, velocity: np.ndarray, now: float) -> None:
        """The motion from ``now`` on: from ``start`` (n,) at ``velocity`` (n,)."""
        self.start, self._velocity, self.time = start, velocity, now

    def missed(self, now: float) -> bool:
        """The next tick is so late that the motion has begun to slow down."""
        return now - self.time > self._patience

    def at(self, now: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Reference (n,) and velocity (n,); None: hold the measured place."""
        if not np.isfinite(self.start).all():
            return None
        since = max(now - self.time, 0.0)
        if since <= self._patience:
            return self.start + self._velocity * since, self._velocity
        speed, braking = np.abs(self._velocity), since - self._patience
        longest = math.ceil(float((speed / self._step).max()))  # periods until rest
        if braking > longest * self._period + HOLD_AFTER:
            return None
        periods = np.arange(1, longest + 1)
        left = np.maximum(speed[:, None] - self._step[:, None] * periods, 0.0)  # (n, periods)
        spent = np.clip(braking - (periods - 1) * self._period, 0.0, self._period)
        now_in = min(int(braking / self._period), longest)
        velocity = np.sign(self._velocity) * (left[:, now_in] if now_in < longest else 0.0)
        return self.start + self._velocity * self._patience + np.sign(self._velocity) * (left @ spent), velocity
