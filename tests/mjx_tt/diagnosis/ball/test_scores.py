"""Scores of sets: what a size costs, and pairs that undo each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from mjx_tt.diagnosis.ball import scores
from mjx_tt.diagnosis.ball.scores import Scores


def of_columns(columns: np.ndarray, target: np.ndarray) -> Scores:
    """Scores of balls (n, samples, K) whose residuals are ``target`` (n, samples)."""
    gram, right = columns.swapaxes(1, 2) @ columns, (columns.swapaxes(1, 2) @ target[..., None])[..., 0]
    return Scores(gram.sum(axis=0), right.sum(axis=0), gram, right, 0.0, ())


def test_a_size_costs_its_surprise_by_students_distribution():
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(20, 30, 3))
    theta, scale = np.array([0.5, -3.0, 12.0]), np.array([1.0, 1.0, 1.5])
    free = of_columns(columns, columns @ theta)
    rated = replace(free, scale=scale)
    density = student(scores.FREEDOM)
    cost = 2.0 * (density.logpdf(0.0) - density.logpdf(theta / scale))
    for subset in [(0,), (1,), (0, 1, 2)]:
        sizes = scores.solve(free, subset)
        price = 2.0 * (density.logpdf(0.0) - density.logpdf(sizes / scale[list(subset)])).sum()
        assert scores.gain(free, subset) - scores.gain(rated, subset) == pytest.approx(price)
        every = scores.all_gains(rated, (0, 1, 2))
        assert every[subset] == pytest.approx(scores.gain(rated, subset), rel=1e-6)
    assert cost[2] > cost[1] > 3.0 > cost[0] > 0.0


@pytest.mark.parametrize(
    ("angle", "theta", "refused"),
    [
        (0.1, (5.0, -4.5), True),
        (0.1, (5.0, 4.5), False),  # they add up
        (1.0, (5.0, -4.5), False),  # two patterns
        (np.pi - 0.1, (5.0, 4.5), True),  # one pattern, turned round
    ],
)
def test_two_sizes_of_one_pattern_may_not_undo_each_other(angle, theta, refused):
    rng = np.random.default_rng(1)
    one, other = np.linalg.qr(rng.normal(size=(40, 2)))[0].T
    columns = np.stack([one, np.cos(angle) * one + np.sin(angle) * other], axis=1)
    balls = np.repeat(columns[None], 12, axis=0)
    rated = of_columns(balls, balls @ np.array(theta))
    assert scores.undo(rated, (0, 1), scores.solve(rated, (0, 1)), 0.97) is refused
