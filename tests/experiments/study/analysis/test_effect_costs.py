"""Costs of hidden effects: the seed is the unit, since its players share one reality."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from experiments.study.analysis.effect_costs import NOTHING, Outcome, estimate_gain


def outcomes(ratios: dict[tuple[int, str], float]) -> list[Outcome]:
    """Rallies by seed and player, with all effects and without spin."""
    return [
        Outcome(seed, player, "is2r-sim1", world, 50, length)
        for (seed, player), ratio in ratios.items()
        for world, length in ((NOTHING, 10.0), ("spin", 10.0 * ratio))
    ]


def test_the_interval_is_students_t_over_seeds():
    """Five players of a seed that all gain alike are one piece of evidence."""
    by_seed = {0: 1.1, 1: 1.9, 2: 1.3}
    found = estimate_gain(
        outcomes({(s, f"player{k}"): ratio for s, ratio in by_seed.items() for k in range(5)}), "is2r-sim1", "spin"
    )
    logs = np.log([*by_seed.values()])
    half = stats.t.ppf(0.975, 2) * logs.std(ddof=1) / math.sqrt(3)
    assert (found.value, found.n) == (pytest.approx(math.exp(logs.mean())), 3)
    assert (found.low, found.high) == pytest.approx((math.exp(logs.mean() - half), math.exp(logs.mean() + half)))
    assert found.low < 1.0 < found.high  # players counted singly would exclude it


def test_players_of_a_seed_are_averaged_first():
    found = estimate_gain(outcomes({(0, "a"): 1.0, (0, "b"): 4.0, (1, "a"): 2.0}), "is2r-sim1", "spin")
    assert (found.value, found.low, found.high) == pytest.approx((2.0, 2.0, 2.0))


def test_one_seed_has_no_interval():
    found = estimate_gain(outcomes({(0, "a"): 2.0, (0, "b"): 8.0}), "is2r-sim1", "spin")
    assert found.value == pytest.approx(4.0) and math.isnan(found.low) and math.isnan(found.high)
    assert estimate_gain(outcomes({(0, "a"): 2.0}), "is2r-sim1", "magnus") is None
