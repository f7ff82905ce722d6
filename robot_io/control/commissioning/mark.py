"""Mark of the last second, for a calibration: means of ball, axes and arm, and signs that they did not stand still."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_io.history import History

SPAN = 1.0  # [s]
FEWEST = 30  # samples


@dataclass(frozen=True)
class Stay:
    """Samples of the last second.

    count  of them
    mean   (n,)
    noise  (n,) standard deviation
    moved  (n,) mean of the later half less that of the earlier one
    """

    count: int
    mean: np.ndarray
    noise: np.ndarray
    moved: np.ndarray

    @classmethod
    def of(cls, history: History, now: float) -> Stay:
        """Of what a history holds; NaN where that is too little."""
        values = np.array([value for time, value in history.samples() if time > now - SPAN])
        if len(values) < FEWEST:
            nothing = np.full(3, np.nan)
            return cls(len(values), nothing, nothing, nothing)
        half = len(values) // 2
        return cls(len(values), values.mean(0), values.std(0), values[half:].mean(0) - values[:half].mean(0))

    def trouble(self, moved: float, noise: float) -> str:
        """Reason why it is not a point of something that stands still; empty: it is one."""
        if not np.isfinite(self.mean).all():
            return f"{self.count} samples in the last second, at least {FEWEST} are needed"
        for what, values, allowed in (("moves by", self.moved, moved), ("scatters by", self.noise, noise)):
            if not np.abs(values).max(initial=0.0) <= allowed:  # a robot without linear axes has none of them
                return f"{what} {1e3 * np.abs(values).max():.1f}e-3, allowed is {1e3 * allowed:g}e-3 [m, rad]"
        return ""
