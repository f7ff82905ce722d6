"""Intervals against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from experiments.stats import t_interval, welch_interval, wilson


@pytest.mark.parametrize("successes, trials", [(0, 10), (10, 10), (1, 3), (1871, 2000), (1, 100_000)])
def test_wilson_interval_is_where_the_score_test_turns(successes, trials):
    """Its ends are the shares p whose distance to the measured one is 1.96 of their own standard deviations."""
    share = successes / trials
    for p, at_bound in zip(wilson(successes, trials), (0.0, 1.0), strict=True):
        distance = norm.ppf(0.975) * np.sqrt(p * (1 - p) / trials)
        assert abs(p - share) == pytest.approx(distance, abs=1e-12) or (p == at_bound == share)


def test_intervals_are_those_of_student_and_welch():
    chance = np.random.default_rng(0)
    a, b = chance.normal(1, 1, 30), chance.normal(2, 3, 20)
    half = student.ppf(0.975, 29) * a.std(ddof=1) / np.sqrt(30)
    assert t_interval(a) == pytest.approx((a.mean(), a.mean() - half, a.mean() + half))
    spreads, sizes = np.array([a.var(ddof=1) / 30, b.var(ddof=1) / 20]), np.array([30, 20])
    half = student.ppf(0.975, spreads.sum() ** 2 / (spreads**2 / (sizes - 1)).sum()) * np.sqrt(spreads.sum())
    mean = b.mean() - a.mean()
    assert welch_interval(a, b) == pytest.approx((mean, mean - half, mean + half))
    assert t_interval([2.0, 2.0]) == (2.0, 2.0, 2.0) and welch_interval([1.0, 1.0], [3.0, 3.0]) == (2.0, 2.0, 2.0)
