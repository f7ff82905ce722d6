"""The rollout: drawing, blocks, failed episodes and statistics, against episodes that are played tick by tick."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env import reward_weights, rollout
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.env.policy import Policy, PolicyController, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import Range, SimModel
from robot_io.contract import unflatten
from tests.support.scripted_episodes import Overheard, play

R, P = 6, 4
MEAN = np.array([0.0, 0.5, 0.3, *[0.1] * 8], np.float32)
INVERSE_SCALE = np.array([3.0, 1.5, 4.0, *[1.0] * 8], np.float32)
RANDOMISE = (Range("ball.table.restitution", 0.88, 0.97),)


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.load("narrow"), SimModel().ball, 64)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(TaskConfig(sim_rate=75.0))  # one substep: compiles in half the time


@pytest.fixture(scope="module")
def episodes(simulator, pool):
    draw = jax.jit(lambda key: simulator.draw(key, pool, SimModel(), RANDOMISE, R, P))
    return draw(jax.random.key(1))


@pytest.fixture(scope="module")
def theta():
    return np.stack([initial_theta(jax.random.key(i), 0.2) for i in range(P)], axis=1)


@pytest.fixture(scope="module")
def run(simulator, theta, episodes):
    """The rollout in three blocks of two rows each, compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "CPU_BLOCK", 2 * P)
        assert simulator._block_rows(R, P) == 2
        roll = jax.jit(lambda theta, episodes: simulator.rollout(Policy(theta, MEAN, INVERSE_SCALE), episodes))
        return roll.lower(theta, episodes).compile()


@pytest.fixture(scope="module")
def result(run, theta, episodes):
    return jax.tree.map(np.asarray, run(theta, episodes))


def flat(x):
    """(..., R, P) -> (..., R x P), the batch of a rollout's block."""
    return x.reshape(*x.shape[:-2], -1) if x.ndim >= 2 else x


@pytest.fixture(scope="module")
def played(simulator, episodes, theta):
    """The same episodes tick by tick, all in one block."""
    controller = Overheard(PolicyController(unflatten(theta), MEAN, INVERSE_SCALE))
    return play(simulator.task, jax.tree.map(flat, episodes), controller, ticks=120)


def test_equals_the_same_episodes_played_tick_by_tick(result, played):
    """So neither the loop nor the size of its blocks changes an episode."""
    assert not played.live[-1].any()  # so that 120 ticks are all of it
    np.testing.assert_allclose(flat(result.terms), played.terms, atol=2e-4)
    weights = np.array(list(reward_weights.SIM_WEIGHTS.values()))
    np.testing.assert_allclose(result.returns, np.tensordot(weights, result.terms, 1), atol=1e-5)
    np.testing.assert_array_equal(flat(result.steps), played.live.sum(axis=0) + 1)
    hit, returned = played.last.hit, played.back.returned & played.last.hit
    np.testing.assert_array_equal(flat(result.outcome), np.where(returned, RETURNED, np.where(hit, HIT, MISSED)))
    np.testing.assert_allclose(flat(result.peak_velocity), played.last.accumulators.peak_velocity, rtol=1e-5)
    assert result.finite.all()


def test_statistics_equal_numpys_over_everything_that_was_observed(result, played):
    seen = np.asarray(played.controller[1], np.float64)  # (ticks, 11, R x P)
    alive = np.concatenate([np.ones((1, R * P), bool), played.live[:-1]])
    for column in range(P):
        x = np.concatenate([seen[alive[:, b], :, b] for b in range(column, R * P, P)])
        assert result.observation_counts[column] == len(x)
        np.testing.assert_allclose(result.observation_sums[0, :, column], (x - MEAN).sum(axis=0), rtol=1e-4, atol=1e-2)
        np.testing.assert_allclose(
            result.observation_sums[1, :, column], ((x - MEAN) ** 2).sum(axis=0), rtol=1e-4, atol=1e-2
        )


@pytest.mark.parametrize("value", [np.nan, np.inf], ids=str)
def test_a_column_that_is_not_finite_is_masked_and_counted_alone(run, result, theta, episodes, value):
    broken = theta.copy()
    broken[:, 2] = value
    found = jax.tree.map(np.asarray, run(broken, episodes))
    good = [0, 1, 3]
    assert not found.finite[:, 2].any() and found.finite[:, good].all()
    assert np.isnan(found.returns[:, 2]).all()
    assert (found.outcome[:, 2] == MISSED).all()
    assert found.observation_counts[2] == 0 and not found.observation_sums[..., 2].any()
    np.testing.assert_array_equal(found.returns[:, good], result.returns[:, good])
    np.testing.assert_array_equal(found.observation_sums[..., good], result.observation_sums[..., good])
