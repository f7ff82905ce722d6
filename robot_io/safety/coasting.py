"""The motion of one control tick as the arm is told it, between two ticks and where no other tick follows."""

from __future__ import annotations

import math

import numpy as np

PATIENCE = 2.0  # control periods that a tick may take before it counts as missing
HOLD_AFTER = 0.2  # [s] after which an arm that was told to stand is told to stay where it is measured


class Coasting:
    """The last tick's reference and velocity. Times are seconds of one monotonic clock, passed in.

    A motion that no tick renews slows down at the acceleration limits by itself: whatever has broken the ticks is not
    asked, neither gate nor devices.
    """

    def __init__(self, period: float, acceleration: np.ndarray) -> None:
        self._period, self._a = period, acceleration
        self.time = -math.inf  # of the tick
        self.start = np.full_like(acceleration, np.nan)  # reference (n,) at the tick
        self._velocity = np.zeros_like(acceleration)

    def ticked(self, start: np.ndarray, velocity: np.ndarray, now: float) -> None:
        """The motion from ``now`` on: from ``start`` (n,) at ``velocity`` (n,)."""
        self.start, self._velocity, self.time = start, velocity, now

    def at(self, now: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Reference (n,) and velocity (n,); None: hold the measured place."""
        if not np.isfinite(self.start).all():
            return None
        since, on_time = max(now - self.time, 0.0), PATIENCE * self._period
        if since <= on_time:
            return self.start + self._velocity * since, self._velocity
        speed = np.abs(self._velocity)
        left = np.maximum(speed - self._a * (since - on_time), 0.0)
        if since - on_time > float((speed / self._a).max()) + HOLD_AFTER:
            return None
        way = speed * on_time + (speed**2 - left**2) / (2.0 * self._a)
        return self.start + np.sign(self._velocity) * way, np.sign(self._velocity) * left
