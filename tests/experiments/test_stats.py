"""Intervals against their definitions, and the paper's reward for choosing a seed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from experiments.sparse_reward import mean_reward, reward_of
from experiments.stats import t_interval, welch_interval, wilson
from robot_io.control.episode import EpisodeSummary


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


def played(outcome: str, fault: str | None = None, human: str | None = None, discarded=False) -> EpisodeSummary:
    return EpisodeSummary(1, 1, 0.0, 1.0, 9, outcome, 0.1, False, 0.0, (0.0, 0.0), fault, discarded, human_fault=human)


def test_a_faulted_episode_is_minus_two_and_nothing_else():
    """By hand: 0, 1, 2, and a ball that was hit before the robot faulted."""
    assert reward_of([played("missed"), played("hit"), played("returned")]) == 1.0
    assert reward_of([played("returned"), played("hit", "limit"), played("returned", "clearance")]) == -2.0 / 3.0


def test_what_says_nothing_of_the_policy_is_no_episode():
    away = [played("missed", human="net"), played("missed", discarded=True)]
    assert reward_of([played("returned"), *away]) == 2.0
    assert reward_of(away) is None and reward_of([]) is None
    assert mean_reward([True, False], [True, False], [False, True], [False, False]) == -2.0


def test_a_policy_that_faults_is_not_preferred_for_the_balls_it_hit():
    """Hits of faulted episodes made the first of these policies the better one: 1.5 against 1."""
    faulting = [*[played("returned")] * 5, *[played("hit", "following_error")] * 5]
    careful = [*[played("hit")] * 10]
    assert reward_of(faulting) == pytest.approx(0.0) and reward_of(careful) == pytest.approx(1.0)
