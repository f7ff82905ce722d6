"""Mixtures of start states: fitted to what made them, read back, refused by name, and sampled as valid balls."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.stats import ks_2samp

from ballmodel import registry
from ballmodel.distribution import BallMixture, save_distribution
from ballmodel.fit_distribution import fit_mixture, start_states
from ballmodel.flight import ball_params
from ballmodel.sampling import KEPT, ROBOT_SIDE, SECOND_BOUNCE, sample_pool, throw
from ballmodel.state import BallState


def strokes(n: int, seed: int = 0) -> BallState:
    """Two kinds of strokes: lobs, and drives whose topspin grows with their speed."""
    rng = np.random.default_rng(seed)
    drive = rng.random(n) < 0.4
    speed = np.where(drive, rng.normal(6.0, 0.4, n), rng.normal(4.2, 0.3, n))
    climb = np.where(drive, rng.normal(0.6, 0.2, n), rng.normal(2.0, 0.2, n))
    position = np.stack([rng.normal(0.2, 0.2, n), rng.normal(1.6, 0.1, n), rng.normal(0.35, 0.05, n)])
    velocity = np.stack([rng.normal(0.0, 0.4, n), -speed, climb])
    spin = np.stack([np.where(drive, 25.0 * speed, 10.0) + rng.normal(0, 5, n), rng.normal(0, 5, n), np.zeros(n)])
    return BallState(position, velocity, spin)


def test_a_mixture_has_the_moments_of_what_made_it_and_reads_back(tmp_path):
    rows = start_states(strokes(900))
    mixture, report = fit_mixture(strokes(900), "two", "a test")
    assert report.chosen >= 2 and report.scores[2] > report.scores[1] + 0.5
    mean = mixture.weights @ mixture.means
    np.testing.assert_allclose(mean, rows.mean(axis=0), atol=0.02 * rows.std(axis=0).max())
    assert np.all(mixture.covariances[:, 8, 8] == 0.0)  # a row that does not vary stays at its value
    save_distribution(tmp_path / "me.yaml", replace(mixture, short_balls=True))
    again = registry.resolve(tmp_path / "me.yaml")
    assert isinstance(again, BallMixture) and (again.name, again.source, again.short_balls) == ("two", "a test", True)
    np.testing.assert_allclose(again.covariances, mixture.covariances, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("short", [False, True])
def test_a_pool_holds_valid_balls_spin_as_the_mixture_has_it(short):
    """Against draws by NumPy, of which the full simulation keeps what it keeps."""
    mixture = replace(fit_mixture(strokes(900))[0], short_balls=short)
    valid = (KEPT, SECOND_BOUNCE) if short else (KEPT,)
    pool = sample_pool(jax.random.key(1), mixture, ball_params(), 3000)
    again = throw(ball_params(), pool.state, *ROBOT_SIDE)
    assert set(np.asarray(again.outcome)) == set(valid)
    np.testing.assert_allclose(again.arrival, pool.arrival, atol=1e-5)
    rng = np.random.default_rng(2)
    component = rng.choice(mixture.weights.size, 6000, p=mixture.weights)
    normal = rng.standard_normal((6000, 9))
    rows = mixture.means[component] + np.einsum("nij,nj->ni", mixture.factors[component], normal)
    state = BallState(*(np.float32(rows[:, i : i + 3].T) for i in (0, 3, 6)))
    kept = np.isin(np.asarray(throw(ball_params(), state, *ROBOT_SIDE).outcome), valid)
    assert abs(kept.mean() - float(pool.acceptance)) < 0.03
    for i, ours in enumerate(start_states(pool.state).T[:8]):
        assert ks_2samp(ours, rows[kept, i]).pvalue > 1e-3, i


def test_no_valid_ball_says_why():
    away = BallMixture(np.ones(1), np.r_[0, 1.5, 0.3, 0, 5.0, 1.0, 0, 0, 0][None], np.eye(9)[None] * 1e-4, "away")
    with pytest.raises(ValueError, match="'away' keeps 0 of .* proposals: .*miss the table"):
        sample_pool(jax.random.key(0), away, ball_params(), 10)
