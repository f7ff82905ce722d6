"""Intervals and tests of shares and means, by ``scipy.stats``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a share (Wilson 1927): it stays within [0, 1] and holds near both ends.

    Raises ValueError without trials or with more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(
            f"{successes} successes in {trials} trials; at least one trial and no more successes are allowed"
        )
    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def t_interval(values: ArrayLike) -> tuple[float, float, float]:
    """Mean and Student's 95 % interval of the mean of independent values (at least two)."""
    values = np.asarray(values, float)
    mean = float(values.mean())
    if not values.std():
        return mean, mean, mean
    with _nearly_equal_values():
        interval = stats.ttest_1samp(values, 0.0).confidence_interval()
    return mean, float(interval.low), float(interval.high)


def welch_interval(a: ArrayLike, b: ArrayLike) -> tuple[float, float, float]:
    """Mean of b minus mean of a with Welch's 95 % interval (1947), for independent samples of different spread."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    difference = float(b.mean() - a.mean())
    if not a.std() and not b.std():
        return difference, difference, difference
    with _nearly_equal_values():
        interval = stats.ttest_ind(b, a, equal_var=False).confidence_interval()
    return difference, float(interval.low), float(interval.high)


@contextmanager
def _nearly_equal_values() -> Iterator[None]:
    """Without SciPy's warning that their t is imprecise: intervals and p are as good as those of equal values."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Precision loss", RuntimeWarning)
        yield
