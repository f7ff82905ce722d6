"""The paper's reward for choosing a seed, of what a robot says of its episodes."""

from __future__ import annotations

import pytest

from experiments.sparse_reward import mean_reward, reward_of
from robot_io.control.episode import EpisodeSummary


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
