"""Serves count from their bounce on the own side."""

from __future__ import annotations

import numpy as np
import pytest

from ballmodel.fit_distribution import fit_human
from ballmodel.flight import ball_params
from ballmodel.io import MeasuredStates
from ballmodel.state import BallState


def test_serves_start_behind_their_bounce():
    """Against the bounce of a plain parabola; drag takes little until there."""
    rng = np.random.default_rng(0)
    n = 40
    position = np.stack([rng.uniform(-0.3, 0.3, n), np.full(n, 1.4), rng.uniform(0.25, 0.3, n)])
    velocity = np.stack([rng.uniform(-0.1, 0.1, n), rng.uniform(-4.6, -4.4, n), np.full(n, -1.4)])
    serves = MeasuredStates(np.arange(n), BallState(position, velocity, np.zeros((3, n))), "serves")
    with pytest.raises(ValueError, match="serves are counted with serves=True"):
        fit_human(serves, ball_params())
    box, report = fit_human(serves, ball_params(), eps=50.0, serves=True)
    assert report.serves == n
    fall = (-1.4 + np.sqrt(1.4**2 + 2 * 9.81 * (position[2] - 0.02))) / 9.81
    bounce = position[1] + velocity[1] * fall
    np.testing.assert_allclose(report.landed.position[1], bounce - 4.0 * 0.02, atol=0.06)
    assert np.all(report.landed.velocity[2] > 1.5) and box.velocity_min[2] > 1.5
    assert np.all(report.landing[1] < 0.0)
