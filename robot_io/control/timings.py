"""Percentiles of lateness and durations, at a cost that does not grow with the length of a session."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

LOWEST, DECADES, PER_DECADE = 1e-7, 9, 200  # [s]; bins are 1.2 % wide
BINS = DECADES * PER_DECADE


class Timing:
    """A histogram of durations [s] with logarithmic bins."""

    def __init__(self) -> None:
        self.count, self.max = 0, 0.0
        self._bins = np.zeros(BINS + 1, np.int64)

    def add(self, seconds: float) -> None:
        """Counts a duration; what is below 0.1 us or negative counts as 0.1 us."""
        self.count += 1
        if seconds > self.max:
            self.max = seconds
        i = math.ceil(PER_DECADE * math.log10(seconds / LOWEST)) if seconds > LOWEST else 0
        self._bins[min(i, BINS)] += 1

    def percentile(self, share: float) -> float:
        """Upper edge [s] of the percentile's bin (0 to 100), at most 1.2 % too long; NaN without samples."""
        if not self.count:
            return math.nan
        i = int(np.searchsorted(np.cumsum(self._bins), share / 100 * self.count))
        return min(LOWEST * 10 ** (i / PER_DECADE), self.max) if i else 0.0


class Timings:
    """Of the control process: what has to be on time."""

    def __init__(self) -> None:
        self.lateness, self.policy, self.reply, self.tick = Timing(), Timing(), Timing(), Timing()
        self.missed = 0  # ticks left out: their whole period had passed

    def summary(self) -> dict[str, Any]:
        """Percentiles in milliseconds."""
        found: dict[str, Any] = {"missed_ticks": self.missed}
        for name in ("lateness", "policy", "reply", "tick"):
            timing = getattr(self, name)
            if timing.count:
                found[name] = {f"p{p}_ms": 1e3 * timing.percentile(p) for p in (50, 99, 99.9)}
                found[name] |= {"max_ms": 1e3 * timing.max, "count": timing.count}
        return found
