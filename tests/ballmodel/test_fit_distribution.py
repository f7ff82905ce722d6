"""Serves count from their bounce on the own side; the paper's fit finds the numbers that Gauss-Newton finds."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ballmodel.distribution import AXES, BallDistribution
from ballmodel.fit_distribution import fit_human
from ballmodel.flight import ball_params
from ballmodel.io import MeasuredStates
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset, Trajectory
from tests.ballmodel.test_initial_state import flight


def starts(n, y, speeds, climb, seed=0):
    """Balls without spin from a place near the middle line towards the robot."""
    rng = np.random.default_rng(seed)
    position = np.stack([rng.uniform(-0.3, 0.3, n), np.full(n, y), rng.uniform(0.25, 0.3, n)])
    velocity = np.stack([rng.uniform(-0.1, 0.1, n), -rng.uniform(*speeds, n), np.full(n, climb)])
    return BallState(position, velocity, np.zeros((3, n)))


def test_serves_start_behind_their_bounce():
    """Against the bounce of a plain parabola; drag takes little until there."""
    n, state = 40, starts(40, 1.4, (4.4, 4.6), -1.4)
    serves = MeasuredStates(np.arange(n), state, "serves")
    with pytest.raises(ValueError, match="serves are counted with serves=True"):
        fit_human(serves, ball_params())
    box, report = fit_human(serves, ball_params(), eps=50.0, serves=True)
    assert report.serves == n
    fall = (-1.4 + np.sqrt(1.4**2 + 2 * 9.81 * (state.position[2] - 0.02))) / 9.81
    bounce = state.position[1] + state.velocity[1] * fall
    np.testing.assert_allclose(report.landed.position[1], bounce - 4.0 * 0.02, atol=0.06)
    assert np.all(report.landed.velocity[2] > 1.5) and box.velocity_min[2] > 1.5
    assert np.all(report.landing[1] < 0.0)


def test_what_was_seen_to_land_counts_and_the_other_player_on_request():
    """Fast balls with topspin, which by drag alone fly over the table's end."""
    n, state, rng = 30, starts(30, 1.5, (10.0, 11.0), 1.5), np.random.default_rng(1)
    landing = np.stack([rng.uniform(-0.5, 0.5, n), rng.uniform(-1.3, -1.0, n)])
    landing[:, 0] = np.nan  # one that nobody saw land
    with pytest.raises(ValueError, match="none of 30 balls lands on the robot's side"):
        fit_human(MeasuredStates(np.arange(n), state, "fast"), ball_params())
    box, report = fit_human(MeasuredStates(np.arange(n), state, "fast", landing), ball_params(), eps=50.0)
    assert report.landed.position.shape == (3, n - 1)
    np.testing.assert_allclose([box.landing_min[1], box.landing_max[1]], [landing[1, 1:].min(), landing[1, 1:].max()])
    turn = np.array([[-1.0], [-1.0], [1.0]])
    across = jax.tree.map(lambda part: np.concatenate([part[:, ::2], turn * part[:, 1::2]], axis=1), state)
    both = MeasuredStates(np.arange(n), across, "rally", np.concatenate([landing[:, ::2], -landing[:, 1::2]], axis=1))
    again, _ = fit_human(both, ball_params(), eps=50.0, both_players=True)
    np.testing.assert_allclose(sixteen(again), sixteen(box))
    assert fit_human(both, ball_params(), eps=50.0)[1].elsewhere == n // 2


def sixteen(box: BallDistribution) -> np.ndarray:
    return np.concatenate([getattr(box, f"{part}_{end}") for part in AXES for end in ("min", "max")])


def recording(n=12, noise=0.002):
    """Throws of the paper's step in NumPy with tracker noise; their start states (6, n)."""
    rng = np.random.default_rng(0)
    starts = np.array([0.3, 1.3, 0.3, 0.0, -5.5, 1.2])[:, None] + rng.uniform(-0.05, 0.05, (6, n))
    time = np.arange(0, 0.3, 1 / 125)
    tracks = [flight(start, time) + rng.normal(0.0, noise, (3, len(time))) for start in starts.T]
    return Dataset(tuple(Trajectory("s", str(i), time, x) for i, x in enumerate(tracks)), "throws"), starts


def test_both_fits_find_the_same_sixteen_numbers():
    """Within the tolerances of the simplex, and the box of the throws within the noise; one report of each flight."""
    measured, starts = recording()
    seen = []
    newton, by_newton = fit_human(measured, ball_params())
    simplex, by_simplex = fit_human(measured, ball_params(), fit="nelder-mead", progress=lambda *p: seen.append(p))
    assert seen == [(i + 1, 12) for i in range(12)]
    np.testing.assert_allclose(sixteen(simplex), sixteen(newton), atol=1e-4)
    assert not np.array_equal(by_simplex.fit_rms, by_newton.fit_rms)  # two algorithms
    assert np.all(by_newton.fit_rms <= by_simplex.fit_rms + 1e-12)
    box = np.concatenate([simplex.position_min, simplex.velocity_min, simplex.position_max, simplex.velocity_max])
    np.testing.assert_allclose(box, np.concatenate([starts.min(axis=1), starts.max(axis=1)]), atol=0.02)


def test_a_persons_short_balls_are_drawn_if_asked_for_and_if_there_are_any():
    """Which balls are short, by parabolas and Nakashima's bounce: drag takes little, and makes them shorter."""
    n, start, climb = 60, 0.8, 2.0
    fall = (climb + np.sqrt(climb**2 + 2 * 9.81 * 0.255)) / 9.81
    down = 9.81 * fall - climb
    for speed, short in ((2.3, True), (3.6, False)):
        after = speed * (1.0 - min(0.25 * 1.93 * down / speed, 0.4))
        second = start - speed * fall - after * 2.0 * 0.93 * down / 9.81  # [m] y of the second bounce
        assert (-1.25 < second < 0.0) if short else second < -1.6
        state = starts(n, start, (speed - 0.05, speed + 0.05), climb)
        strokes = MeasuredStates(np.arange(n), state, "strokes")
        for asked in (False, True):
            box, report = fit_human(strokes, ball_params(), eps=50.0, short_balls=asked)
            assert box.short_balls == (asked and short)
            assert (report.outcomes["bounce on the table a second time"] == n) == short
