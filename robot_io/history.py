"""Timestamped samples of one device, read back at any moment between them.

The simulator's delayed observations interpolate linearly between the states around the wanted moment
(``mjx_tt.sim.latency``); so does this.
"""

from __future__ import annotations

from collections import deque

import numpy as np


class History:
    """The newest ``length`` samples of a vector; times must grow.

    longest_hold [s]: how far beyond its newest sample, which then is held, the history still answers.
    """

    def __init__(self, length: int = 64, longest_hold: float = 0.05) -> None:
        self._times: deque[float] = deque(maxlen=length)
        self._values: deque[np.ndarray] = deque(maxlen=length)
        self._longest_hold = longest_hold

    def __len__(self) -> int:
        return len(self._times)

    def clear(self) -> None:
        self._times.clear()
        self._values.clear()

    @property
    def newest(self) -> tuple[float, np.ndarray] | None:
        """Time [s] and value (n,) of the newest sample."""
        return (self._times[-1], self._values[-1]) if self._times else None

    def samples(self) -> list[tuple[float, np.ndarray]]:
        """All that is kept, oldest first."""
        return list(zip(self._times, self._values, strict=True))

    def add(self, time: float, value: np.ndarray) -> bool:
        """Takes a sample; False, and nothing is kept, when it is not newer than the newest."""
        if self._times and time <= self._times[-1]:
            return False
        self._times.append(time)
        self._values.append(np.asarray(value, np.float64))
        return True

    def at(self, time: float) -> np.ndarray | None:
        """Value (n,) at ``time`` [s]: interpolated; the oldest before all samples, the newest for a short while after.

        None without samples or when the newest is older than ``longest_hold``.
        """
        times, values = self._times, self._values
        if not times or time > times[-1] + self._longest_hold:
            return None
        if time >= times[-1]:
            return values[-1]
        i = len(times) - 1
        while i > 0 and times[i - 1] > time:  # what is wanted is among the newest
            i -= 1
        if i == 0:
            return values[0]
        share = (time - times[i - 1]) / (times[i] - times[i - 1])
        return values[i - 1] + share * (values[i] - values[i - 1])

    def slope(self, span: float, at_least: int = 0) -> np.ndarray | None:
        """Rate of change (n,) per second by least squares over the last ``span`` [s]; None with under three samples.

        at_least: newest samples that count however old they are, so that a gap hides no motion.
        """
        return self._slope(self._times, span, at_least)

    def _slope(self, times: deque[float], span: float, at_least: int) -> np.ndarray | None:
        values = self._values
        n, first = 0, times[-1] - span if times else 0.0
        while n < len(times) and (n < at_least or times[-1 - n] >= first):
            n += 1
        if n < 3:
            return None
        t = np.array([times[-1 - i] for i in range(n)])
        t -= t.sum() / n
        x = np.array([values[-1 - i] - values[-1] for i in range(n)])  # differences: exact for what does not move
        return t @ x / (t @ t)
