"""The paper's tables, fitting a distribution, and sampling from it against an independent simulation."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binomtest, ks_2samp

from ballmodel import registry
from ballmodel.distribution import BallDistribution, load_distribution, save_distribution
from ballmodel.fit_distribution import fit_distribution
from ballmodel.flight import ball_params
from ballmodel.sampling import KEPT, OUTCOMES, UNDECIDED, coarse_outcome, sample_pool, throw
from ballmodel.state import BallState, ball_state

pytestmark = pytest.mark.optimised

BOX = BallDistribution(
    (0.0, 1.2, 0.2), (0.3, 1.5, 0.5), (-0.8, -6.5, 0.0), (0.8, -4.0, 1.8), (-0.3, -1.2), (0.5, -0.4), "box"
)
SLOW = replace(BOX, velocity_min=(-0.8, -4.5, 0.4), velocity_max=(0.8, -2.8, 2.2), name="slow")


# --- the paper's tables


def test_rows_read_off_the_paper():
    narrow = registry.load("narrow")
    assert (narrow.position_min, narrow.position_max) == ((0.15, 1.01, 0.25), (0.55, 1.57, 0.64))
    assert (narrow.velocity_min, narrow.velocity_max) == ((-0.9, -9.4, -1.2), (0.9, -5.0, 1.5))
    assert (narrow.landing_min, narrow.landing_max) == ((0.18, -1.26), (0.62, -0.33))
    novice = registry.load("player3/M1")
    assert (novice.position_min, novice.position_max) == ((-0.93, 0.05, -0.15), (0.79, 1.83, 1.10))
    assert (novice.velocity_min, novice.velocity_max) == ((-2.59, -7.11, -1.23), (2.59, -2.19, 2.79))
    assert (novice.landing_min, novice.landing_max) == ((-0.67, -1.37), (0.76, -0.18))
    assert registry.load("player5/M2").landing_min[0] == -0.666
    assert registry.load("player1/M0").position_max[1] == 2.51
    assert registry.load("s2r-oracle").velocity_min == (-3.45, -7.35, -1.72)


# --- YAML


def test_yaml_round_trip(tmp_path):
    path = tmp_path / "me.yaml"
    distribution = replace(BOX, source="a test", short_balls=True)
    save_distribution(path, distribution)
    assert load_distribution(path) == distribution == registry.resolve(path)
    assert [p.name for p in tmp_path.iterdir()] == ["me.yaml"]
    assert registry.resolve("narrow") == registry.load("narrow")
    with pytest.raises(FileNotFoundError, match="none.yaml"):
        registry.resolve(tmp_path / "none.yaml")


# --- fitting


def test_fit_finds_the_box_and_drops_planted_outliers():
    rng = np.random.default_rng(0)
    low, high = np.array([-0.5, 1.0, 0.1, -1, -6, 0, -0.5, -1.3]), np.array([0.5, 1.5, 0.6, 1, -4, 2, 0.5, -0.2])
    points = rng.uniform(low, high, (600, 8)).T
    wild = np.array([[0, 9], [1.2, 1.2], [0.3, 0.3], [12, 0], [-5, -5], [1, 1], [0, 0], [-1, -1]])
    points = np.concatenate([points, wild], axis=1)
    state = BallState(points[:3], points[3:6], np.zeros((3, 602)))
    distribution, report = fit_distribution(state, points[6:], name="planted")
    assert (report.n, report.outlier[-2:].all(), report.outlier.mean() < 0.05) == (602, True, True)
    inside = points[:, ~report.outlier]
    assert distribution.position_min == tuple(inside[:3].min(axis=1))
    assert distribution.velocity_max == tuple(inside[3:6].max(axis=1))
    assert distribution.landing_max == tuple(inside[6:].max(axis=1))


# --- sampling


def brute_force(distribution, n, seed, dt=1 / 1500):
    """Proposals, (6, n), and which are kept, by a simulation in plain NumPy that shares no code with the package.

    The net is the plane y = 0 and a ball 20 mm in radius; the table is met where the centre is a radius above it.
    """
    rng = np.random.default_rng(seed)
    x = rng.uniform(distribution.position_min, distribution.position_max, (n, 3)).T
    v = rng.uniform(distribution.velocity_min, distribution.velocity_max, (n, 3)).T
    proposal = np.concatenate([x, v])
    k_d = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027)
    alive, bounced, kept = np.ones(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    landing, arrival = np.zeros((2, n)), np.zeros(n)
    for i in range(int(3.0 / dt)):
        a = -k_d * np.sqrt((v**2).sum(0)) * v - np.array([[0], [0], [9.81]])
        x, v = x + dt * v + dt * dt / 2 * a, v + dt * a
        gap_y, gap_z = np.maximum(np.abs(x[1]) - 0.0025, 0), np.maximum(x[2] - 0.1525, 0)
        alive &= ~((np.hypot(gap_y, gap_z) < 0.02) & (np.abs(x[0]) < 0.915))
        hit = (x[2] < 0.02) & (x[2] > -0.01) & (v[2] < 0) & (np.abs(x[0]) < 0.7625) & (np.abs(x[1]) < 1.37)
        in_box = np.all((x[:2].T >= distribution.landing_min) & (x[:2].T <= distribution.landing_max), axis=1)
        again = alive & hit & bounced
        if distribution.short_balls:
            kept, arrival = kept | again, np.where(again, i * dt, arrival)
        alive &= ~(hit & (bounced | ~in_box))
        landing = np.where(hit & ~bounced, x[:2], landing)
        # Nakashima's bounce of a ball without spin: the contact point slips with the ball's own velocity.
        speed = np.hypot(v[0], v[1]) + 1e-12
        lost = np.minimum(0.25 * 1.93 * np.abs(v[2]) / speed, 0.4)
        v = np.where(hit, np.stack([v[0] * (1 - lost), v[1] * (1 - lost), -0.93 * v[2]]), v)
        bounced |= hit
        done = alive & ~kept & (x[1] < -1.37)
        kept |= done & bounced
        arrival = np.where(done & bounced, i * dt, arrival)
        alive &= ~done
        if not alive.any():
            break
    return proposal, kept, landing, arrival


@pytest.mark.parametrize("box", [BOX, replace(SLOW, short_balls=True)], ids=["once", "short"])
def test_pool_is_distributed_like_brute_force_rejection(box):
    pool = sample_pool(jax.random.key(0), box, ball_params(), 3000)
    proposal, kept, landing, arrival = brute_force(box, 8000, 1)
    drawn = np.concatenate([pool.state.position, pool.state.velocity, pool.landing, pool.arrival[None]])
    reference = np.concatenate([proposal, landing, arrival[None]])[:, kept]
    assert kept.sum() > 500
    for ours, theirs in zip(drawn, reference, strict=True):
        assert ks_2samp(ours, theirs).pvalue > 1e-3
    # Correlations as well: the boundaries of what is kept are not along the axes.
    for pair in (3, 4, 5):
        assert ks_2samp(drawn[1] + drawn[pair], reference[1] + reference[pair]).pvalue > 1e-3
    assert binomtest(int(kept.sum()), kept.size, float(pool.acceptance)).pvalue > 1e-3
    assert float(pool.rejected.sum()) == pytest.approx(1.0, abs=1e-5)


def test_both_simulations_decide_alike_ball_by_ball():
    proposal, kept, landing, arrival = brute_force(BOX, 3000, 2)
    state = ball_state(proposal[:3].astype("f4"), proposal[3:].astype("f4"))
    thrown = throw(ball_params(), state, BOX.landing_min, BOX.landing_max)
    ours = np.asarray(thrown.outcome) == KEPT
    assert np.mean(ours != kept) < 0.02  # balls within the integration error of a boundary
    both = ours & kept
    np.testing.assert_allclose(np.asarray(thrown.landing)[:, both], landing[:, both], atol=0.01)
    np.testing.assert_allclose(np.asarray(thrown.arrival)[both], arrival[both], atol=0.005)


@pytest.mark.parametrize("name", [pytest.param("large", marks=pytest.mark.slow), "player3/M2", "narrow"])
def test_the_coarse_flight_never_drops_a_ball_that_the_full_simulation_keeps(name):
    distribution, params = registry.load(name), ball_params()
    rng = np.random.default_rng(5)
    n = 20000
    position = rng.uniform(distribution.position_min, distribution.position_max, (n, 3)).T
    velocity = rng.uniform(distribution.velocity_min, distribution.velocity_max, (n, 3)).T
    state = ball_state(position.astype("f4"), velocity.astype("f4"))
    box = distribution.landing_min, distribution.landing_max
    coarse = np.asarray(jax.jit(coarse_outcome)(params, state, *box))
    full = np.asarray(jax.jit(throw)(params, state, *box).outcome)
    assert (full == KEPT).sum() > 500
    assert not np.any((coarse != UNDECIDED) & (full == KEPT))
    assert np.mean(coarse != UNDECIDED) > 0.2


def test_a_ball_that_rises_against_the_tables_underside_has_not_landed():
    params = ball_params()
    state = ball_state(jnp.array([[-0.229], [1.386], [-0.387]]), jnp.array([[1.12], [-28.58], [5.46]]))
    outcome = throw(params, state, (-0.76, -1.37), (0.76, -0.1)).outcome
    assert OUTCOMES[int(outcome[0])] == "miss the table's top"


def test_same_key_same_balls_and_more_balls_extend_them():
    draw = [sample_pool(jax.random.key(k), BOX, ball_params(), n) for k, n in ((0, 100), (0, 100), (0, 5000), (1, 100))]
    np.testing.assert_array_equal(draw[0].state.position, draw[1].state.position)
    np.testing.assert_array_equal(draw[0].state.velocity, draw[2].state.velocity[:, :100])
    assert not np.array_equal(draw[0].state.position, draw[3].state.position)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"position_max": (0.3, 1.5, 0.21), "velocity_min": (0, -9, 0.0), "velocity_max": (0, -8, 0.2)}, OUTCOMES[2]),
        ({"velocity_min": (0, -30.0, 2.0), "velocity_max": (0, -25.0, 3.0)}, OUTCOMES[4]),
    ],
)
def test_an_impossible_box_says_which_constraint_fails(change, reason):
    with pytest.raises(ValueError, match="keeps 0 of .* proposals") as error:
        sample_pool(jax.random.key(0), replace(BOX, **change), ball_params(), 10, min_acceptance=1e-4)
    first = str(error.value).split(": ", 1)[1].split(", ")[0]
    assert first.endswith(reason), error.value
