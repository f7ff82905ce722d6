"""The paper's reward for choosing a seed: +1 hit, +1 landed on the human's side, -2 and nothing else for a fault.

One rule for simulation, virtual reality and robots (Abeyruwan et al. 2022, appendix "Seed Selection for Rounds of
Simulated Training"). A ball that the human did not bring onto the robot's half is no episode.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from robot_io.control.episode import MISSED, RETURNED, EpisodeSummary

EPISODES = 50  # with each policy
FAULT = -2.0


def mean_reward(hit: ArrayLike, returned: ArrayLike, fault: ArrayLike, valid: ArrayLike = True) -> float | None:
    """Mean over the episodes with a valid ball, or with a fault; None without any. Arrays are of one shape."""
    reward = np.where(fault, FAULT, np.asarray(hit, float) + np.asarray(returned, float))
    counts = np.broadcast_to(np.asarray(valid) | np.asarray(fault), reward.shape)
    return float(reward[counts].mean()) if counts.any() else None


def reward_of(played: Iterable[EpisodeSummary]) -> float | None:
    """The mean over a robot's episodes."""
    rows = [
        (one.outcome != MISSED, one.outcome == RETURNED, one.fault is not None, one.human_fault is None)
        for one in played
        if not one.discarded
    ]
    return mean_reward(*np.array(rows, bool).T) if rows else None
