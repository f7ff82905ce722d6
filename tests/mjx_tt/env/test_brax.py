"""The brax environment: its rewards add up to the simulator's return, its episodes follow each other with new balls."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env.brax import OBSERVATION_SIZE, TableTennis
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.reward_weights import TERMS
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig, weigh_rewards
from mjx_tt.sim.model import Range, SimModel
from robot_io.contract import HISTORY, N_OBSERVATION
from robot_io.policy.policy import forward

B, STEPS = 64, 130
MEAN = np.array([0.0, 0.5, 0.3, *[0.1] * 8], np.float32)
INVERSE_SCALE = np.array([3.0, 1.5, 4.0, *[1.0] * 8], np.float32)
# Wide paddles, so that a policy which has learned nothing hits some of the balls; it returns none.
RANDOMISE = (Range("ball.table.restitution", 0.88, 0.97), Range("ball.paddle.radius", 0.1, 0.8))


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.load("player3/M0"), SimModel().ball, 256)


@pytest.fixture(scope="module")
def env(pool):
    weights = dict(zip(TERMS, np.linspace(0.4, 1.4, 11), strict=True))
    task = TaskConfig(sim_rate=75.0, max_steps=110, rewards=weigh_rewards(weights))
    return TableTennis(Simulator(task, 1), pool, SimModel(), RANDOMISE)


@pytest.fixture(scope="module")
def theta():
    return initial_theta(jax.random.key(5), 0.05)


@pytest.fixture(scope="module")
def played(env, theta):
    """The episodes that were begun with, and observations, rewards, ends and metrics (step, B, ...) from then on."""
    episodes = env.draw(jax.random.key(1), (B,))

    def policy(observation):
        history = jnp.moveaxis(observation.reshape(B, HISTORY, N_OBSERVATION), 0, -1)
        normalised = (history - MEAN[None, :, None]) * INVERSE_SCALE[None, :, None]
        return forward(Policy(theta, np.zeros(11), np.ones(11)), normalised, xp=jnp).T

    @jax.jit
    def play(episodes):
        def step(state, _):
            after = env.step(state, policy(state.obs))
            balls = after.pipeline_state.episodes.ball.position
            return after, (state.obs, after.reward, after.done, after.metrics, balls)

        return jax.lax.scan(step, env.begin(episodes, jax.random.key(2)), None, length=STEPS)[1]

    return episodes, *jax.tree.map(np.asarray, play(episodes))


@pytest.fixture(scope="module")
def simulated(env, theta, played):
    """The same policy, streaming, on the same episodes in the simulator."""
    simulator = env._simulator
    episodes = jax.tree.map(lambda x: x[..., None, :] if x.ndim else x, played[0])
    columns = jnp.repeat(theta[:, None], B, axis=1)
    result = jax.jit(simulator.rollout)(Policy(columns, MEAN, INVERSE_SCALE), episodes)
    return jax.tree.map(np.asarray, result)


def test_rewards_add_up_to_the_return_of_the_simulator(played, simulated):
    _, _, reward, done, metrics, _ = played
    assert done.any(axis=0).all()
    last = done.argmax(axis=0)
    first_episode = np.arange(STEPS)[:, None] <= last
    np.testing.assert_array_equal(last + 1, simulated.steps[0])
    outcome = simulated.outcome[0]
    assert {MISSED, HIT} <= set(outcome) and len(set(last)) > 5, "episodes of one kind would show little"
    np.testing.assert_allclose((reward * first_episode).sum(axis=0), simulated.returns[0], rtol=2e-5, atol=2e-4)
    column = np.arange(B)
    np.testing.assert_allclose(metrics["episode_return"][last, column], simulated.returns[0], rtol=2e-5, atol=2e-4)
    np.testing.assert_array_equal(metrics["hit"][last, column] == 1, outcome != MISSED)
    np.testing.assert_array_equal(metrics["returned"][last, column] == 1, outcome == RETURNED)
    for name in metrics:
        assert not metrics[name][done == 0].any(), f"{name} counts at steps that end nothing"


def test_the_next_episode_begins_at_once_with_another_ball(played, env, pool):
    episodes, observation, _, done, _, balls = played
    last = done.argmax(axis=0)
    starts = np.asarray(pool.state.position).T
    known = {tuple(ball) for ball in starts}
    fresh = balls[last, :, np.arange(B)]
    assert {tuple(ball) for ball in fresh} <= known
    changed = (fresh != np.asarray(episodes.ball.position).T).any(axis=1)
    assert changed.mean() > 0.9  # of 256 balls some may come twice
    assert len({tuple(ball) for ball in fresh}) > B / 2
    inside = last + 1 < STEPS
    after = observation[np.minimum(last + 1, STEPS - 1), np.arange(B)].reshape(B, HISTORY, N_OBSERVATION)[inside]
    np.testing.assert_array_equal(after, np.broadcast_to(after[:, :1], after.shape))
    # The tracker reports the ball of the new episode, within its noise, and the robot at home.
    noise = SimModel().sensing.ball_noise
    assert np.abs(after[:, 0, :3] - fresh[inside]).max() <= noise
    np.testing.assert_allclose(after[:, 0, 3:], np.broadcast_to(env._task.home, (inside.sum(), 8)), atol=1e-6)


def test_brax_sees_an_environment_of_any_batch(env):
    raw = jax.random.split(jax.random.PRNGKey(3), 4)
    for keys, batch in ((jax.random.PRNGKey(3), ()), (raw, (4,)), (jax.random.wrap_key_data(raw), (4,))):
        shapes = jax.eval_shape(env.reset, keys)
        after = jax.eval_shape(env.step, shapes, jax.ShapeDtypeStruct((*batch, env.action_size), jnp.float32))
        assert shapes.obs.shape == (*batch, OBSERVATION_SIZE) == (*batch, env.observation_size)
        assert after.reward.shape == after.done.shape == batch
        assert jax.tree.map(lambda x: (x.shape, x.dtype), shapes) == jax.tree.map(lambda x: (x.shape, x.dtype), after)
