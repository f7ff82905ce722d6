"""Which part of a rally's ball a log of hits has."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.study.target_domain.lab_logs import AWAY, count_visible

RATE = 125.0  # [Hz]


def thrown(height: float, up: float, seconds: float = 1.4) -> np.ndarray:
    """A parabola from behind the player's end of the table, (3, T) [m]."""
    t = np.arange(round(seconds * RATE)) / RATE
    return np.stack([0.0 * t, 1.7 - 3.0 * t, height + up * t - 4.905 * t**2])


@pytest.mark.parametrize(("height", "up"), [(0.3, 1.0), (-0.07, 2.5), (-0.4, 3.5)])
def test_a_ball_is_seen_until_it_falls_below_the_table_however_low_it_was_struck(height, up):
    low = -0.03  # under the table's plane
    falls_below = (up + (up**2 + 4.0 * 4.905 * (height - low)) ** 0.5) / 9.81  # [s]
    assert count_visible(thrown(height, up)) / RATE == pytest.approx(falls_below, abs=1.01 / RATE)


def test_a_ball_is_seen_until_it_passes_the_robot_or_comes_back_past_the_player():
    passing = thrown(0.3, 7.0)
    assert count_visible(passing) / RATE == pytest.approx(4.0 / 3.0, abs=1.01 / RATE)
    back, t = passing.copy(), np.arange(passing.shape[1]) / RATE
    back[1] = np.where(t < 0.3, 1.7 - 3.0 * t, 0.8 + 3.0 * (t - 0.3))  # where it was struck again after 0.6 s
    assert count_visible(back) / RATE == pytest.approx(0.6 + AWAY / 3.0, abs=1.01 / RATE)
