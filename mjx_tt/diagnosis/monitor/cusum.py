"""Change detection by cumulative sums (Page, Biometrika 41, 1954), of many scores at once and in both directions.

Scores are standardised by a reference: what the believed world leaves unexplained is the same before and after, and
only a change counts. A sum begins anew wherever it falls to zero, so the place where the alarm's began is the estimate
of when the change came.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import brentq

DRIFT = 0.75  # deviations a ball that a sum forgets: half of the smallest shift that is looked for
# Of the drift: mean and deviation of some 40 reference balls are known to a sixth and a ninth of a deviation only.
RESERVE = 0.25
CLIP = 4.0  # deviations by which one ball counts at most: one outlier is no change
FEWEST = 20  # reference balls that must show a score


@dataclass(frozen=True)
class Alarm:
    """A change that is beyond chance."""

    name: str  # of the score that moved most, in deviations
    shift: float  # deviations by which it moved, with its sign
    others: tuple[str, ...]  # scores that moved at least half as much, the largest first
    since: int  # first ball, counted from the monitor's begin, after the change
    at: int  # ball at which it was noticed


def threshold(run_length: float, drift: float = DRIFT - RESERVE) -> float:
    """Height [deviations] that one sum passes once in ``run_length`` balls by chance (Siegmund, 1985, eq. 2.56)."""

    def excess(height: float) -> float:
        b = 2.0 * drift * (height + 1.166)
        return math.log((math.exp(b) - b - 1.0) / (2.0 * drift**2)) - math.log(run_length)

    return float(brentq(excess, 0.1, 200.0))


class Cusum:
    """A running test of scores (M,) of ball after ball against reference balls (n, M); NaN: a ball does not show it.

    false_alarms: balls in which one alarm by chance is allowed, of all scores together.
    """

    def __init__(self, names: tuple[str, ...], reference: Float[np.ndarray, "n M"], false_alarms: float) -> None:
        self._shown = np.isfinite(reference).sum(axis=0) >= FEWEST
        reference = np.where(self._shown, reference, 0.0)
        self._mean = np.nan_to_num(np.nanmean(reference, axis=0))
        deviation = np.nanstd(reference, axis=0, ddof=1)
        self._shown &= deviation > 1e-9
        self._deviation = np.where(self._shown, deviation, 1.0)
        self.names = names
        self.height = threshold(false_alarms * 2 * max(int(self._shown.sum()), 1))
        self._sums = np.zeros((2, len(names)))  # of what rises and of what falls
        self._begun: Int[np.ndarray, "2 M"] = np.zeros((2, len(names)), int)
        self._seen: list[Float[np.ndarray, " M"]] = []

    def add(self, score: Float[np.ndarray, " M"]) -> Alarm | None:
        """Takes the next ball's scores; the alarm that they raise, if any."""
        whole = np.where(self._shown, (score - self._mean) / self._deviation, np.nan)
        self._seen.append(whole)
        z = np.clip(whole, -CLIP, CLIP)
        known = np.isfinite(z)
        step = np.where(known, np.stack([z, -z]) - DRIFT, 0.0)
        self._begun[self._sums == 0.0] = len(self._seen) - 1
        self._sums = np.maximum(self._sums + step, 0.0)
        if not (self._sums > self.height).any():
            return None
        side, which = np.unravel_index(int(np.argmax(self._sums)), self._sums.shape)
        since = int(self._begun[side, which])
        recent = np.stack(self._seen[since:])
        count = np.isfinite(recent).sum(axis=0)
        middle = np.array([np.median(x[np.isfinite(x)]) if n else 0.0 for x, n in zip(recent.T, count, strict=True)])
        moved = middle * np.sqrt(count)
        order = np.argsort(-np.abs(moved))
        first = int(order[0])
        others = tuple(self.names[i] for i in order[1:] if abs(moved[i]) >= 0.5 * abs(moved[first]))
        return Alarm(self.names[first], float(middle[first]), others, since, len(self._seen) - 1)
