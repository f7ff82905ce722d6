"""Spins of each ball's own: their distribution against scikit-learn's, their estimates against the truth, and finding
causes beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from mjx_tt import SimModel
from mjx_tt.diagnosis import diagnose, load_logs
from mjx_tt.diagnosis.ball.flights.spin_prior import WIDEST_STD, learned
from tests.exam.generator.sessions import draw_balls, measure, with_spin
from tests.exam.generator.world import World
from tests.exam.generator.write import ball_csv

pytestmark = pytest.mark.optimised


def _two_kinds(rng, n=600):
    topspin = rng.random(n) < 0.6
    spin = np.where(topspin[:, None], rng.normal([90, 0, -10], [12, 9, 15], (n, 3)), rng.normal(-60, 20, (n, 3)))
    return spin, topspin


def test_spins_that_are_seen_exactly_are_mixed_as_scikit_learn_mixes_them():
    spin, topspin = _two_kinds(np.random.default_rng(0))
    information = np.repeat(1e6 * np.eye(3)[None], len(spin), axis=0)
    found = learned(information, 1e6 * spin, most=2)
    theirs = GaussianMixture(2, random_state=0, tol=1e-6, max_iter=500).fit(spin)
    assert found.components == 2
    own, covariance = found.own_mean.T, found.own_covariance
    for kind in (True, False):
        mine = own[topspin == kind].mean(axis=0)
        k = int(np.argmin(np.linalg.norm(theirs.means_ - mine, axis=1)))
        np.testing.assert_allclose(mine, theirs.means_[k], atol=0.5)
        np.testing.assert_allclose(covariance[topspin == kind].mean(axis=0), theirs.covariances_[k], rtol=0.05, atol=6)
    np.testing.assert_allclose(found.mean, spin.mean(axis=0), atol=0.5)
    np.testing.assert_allclose(found.std, spin.std(axis=0), rtol=0.02)


def test_a_distribution_is_learned_through_flights_that_show_little():
    rng = np.random.default_rng(1)
    n, mean, std = 4000, np.array([40.0, 0.0, -5.0]), np.array([30.0, 20.0, 10.0])
    spin = mean + std * rng.standard_normal((n, 3))
    sigma = np.array([8.0, 30.0, 15.0])  # of what a flight shows about each axis
    seen = spin + sigma * rng.standard_normal((n, 3))
    found = learned(np.repeat(np.diag(sigma**-2)[None], n, axis=0), seen / sigma**2, most=1)
    assert np.all(np.abs(found.mean - mean) < 5 * np.hypot(std, sigma) / np.sqrt(n))
    np.testing.assert_allclose(found.std, std, rtol=0.2)


def _log(tmp_path, world, balls, rng):
    path = tmp_path / "ball.csv"
    path.write_text(ball_csv(measure(world, balls, "iid", rng)))
    return load_logs([path])


def _model(magnus_coefficient):
    nominal = SimModel()
    flight = replace(nominal.ball.flight, magnus_coefficient=magnus_coefficient)
    return replace(nominal, ball=replace(nominal.ball, flight=flight))


@pytest.mark.slow
def test_lift_that_saturates_with_spin_is_named(tmp_path):
    rng = np.random.default_rng(6)
    balls = draw_balls(rng, 200)
    size = rng.uniform(10.0, 160.0, 200) * np.where(balls.human, 1.0, -1.0)
    spin = size * rng.choice([1.0, 1.0, -0.6], 200) * np.array([1.0, 0.1, 0.2])[:, None]
    logs = _log(tmp_path, World(magnus_coefficient=0.9, lift_saturation=1.5), with_spin(balls, spin), rng)
    found = diagnose(logs, _model(0.9))
    assert found.verdict.verdict == "named"
    causes = {c.name: c for c in found.verdict.causes}
    estimate = causes["lift_saturation"].parameters["ball.flight.lift_saturation"]
    assert set(causes) == {"lift_saturation"} and estimate.low - 0.2 < 1.5 < estimate.high + 0.2


@pytest.mark.slow
def test_spins_of_any_size_are_estimated_with_their_intervals(tmp_path):
    """Balls of two kinds, fast topspin and backspin, under another integrator; k is known, nothing is wrong."""
    rng = np.random.default_rng(5)
    balls = draw_balls(rng, 80)
    spin = _two_kinds(rng, 80)[0].T * np.where(balls.human, 1.0, -1.0)
    logs = _log(tmp_path, World(magnus_coefficient=0.6), with_spin(balls, spin), rng)
    found = diagnose(logs, _model(0.6))
    assert found.verdict.verdict == "none"
    spins = found.balls.spins
    kept = [int(name) for name in spins.name]
    error = (spins.mean - spin[:, kept]) / spins.std
    assert 0.8 < np.mean(np.abs(error) < 1.645) < 0.97, "90 % intervals"
    assert np.median(np.abs(spins.mean - spin[:, kept])[[0, 2]]) < 5.0
    spins.save(tmp_path / "spins.csv")
    rows = np.genfromtxt(tmp_path / "spins.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    np.testing.assert_allclose(rows["spin_x"], spins.mean[0], atol=1e-3)


def test_flights_that_show_nothing_do_not_widen_the_spread_without_end():
    """Scores that want spins of thousands, with hardly any information: as wide as people play, and not more."""
    score = 1e-4 * np.random.default_rng(0).normal(0.0, 5000.0, (100, 3))
    found = learned(np.repeat(1e-4 * np.eye(3)[None], 100, axis=0), score, most=1)
    np.testing.assert_array_less(found.std, WIDEST_STD * 1.0001)
    assert found.std.min() > 0.9 * WIDEST_STD
