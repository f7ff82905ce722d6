"""The metric of the actions: beside derivatives of NumPy's network at observations that brax's environment shows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from ballmodel import registry
from ballmodel.sampling import sample_pool
from bgs import normalizer, optimizers
from bgs.strategy import BGSConfig
from experiments.config.optimiser import ActionMetric
from experiments.training import action_metric
from experiments.training.update import Trainer
from mjx_tt.env import own
from mjx_tt.env.brax import TableTennis
from mjx_tt.env.episode import reshaped
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import SimModel
from robot_io.policy.policy import forward

N = 16
TASK = TaskConfig(sim_rate=75.0, max_steps=90)
BGS = BGSConfig(num_directions=4, sigma=0.05, elite_fraction=1.0, step=optimizers.make("sgd", 0.01))
STATISTICS = normalizer.from_sums(
    jnp.int32(100), jnp.zeros(11), jnp.asarray([0.0, 50.0, 30.0, *[10.0] * 8]), jnp.asarray([40.0] * 11)
)


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.load("player3/M0"), SimModel().ball, 64)


@pytest.fixture(scope="module")
def theta():
    return initial_theta(jax.random.key(5), 0.2)


def drawn(simulator, pool):
    return simulator.draw(jax.random.key(1), pool, SimModel(), (), 1, N)


def measured(simulator, pool, theta, network=None, episodes=None):
    def local(theta, episodes):
        return action_metric.measure(simulator, jax.random.key(2), theta, STATISTICS, network, episodes)

    play = jax.jit(simulator.on_devices(local, out_specs=PartitionSpec()))
    episodes = drawn(simulator, pool) if episodes is None else episodes
    return np.asarray(play(*simulator.replicate((theta, episodes))), np.float64)


@pytest.fixture(scope="module")
def found(pool, theta):
    return measured(Simulator(TASK), pool, theta)


def test_it_is_the_mean_of_the_actions_derivatives_where_the_policy_plays(found, pool, theta):
    simulator = Simulator(TASK)
    ticks = np.asarray(jax.random.randint(jax.random.key(2), (1, N), 0, TASK.max_steps))[0]
    mean, inv_std = (np.asarray(x) for x in normalizer.normaliser(STATISTICS))
    # The same episodes, step by step, in the environment that shows its histories.
    env = TableTennis(simulator, pool, SimModel())
    state, advance = env.begin(reshaped(drawn(simulator, pool), N), jax.random.key(9)), jax.jit(env.step)
    over, windows = np.zeros(N, bool), []
    for tick in range(TASK.max_steps):
        history = np.moveaxis(np.asarray(state.obs).reshape(N, 8, 11), 0, -1)
        windows += [history[:, :, i] for i in np.flatnonzero((ticks == tick) & ~over)]
        state = advance(state, forward(Policy(np.asarray(theta), mean, inv_std), history).T)
        over |= np.asarray(state.done) > 0
    assert 3 < len(windows) < N

    def actions(theta):
        return np.stack([forward(Policy(theta, mean, inv_std), w[..., None])[:, 0] for w in np.float64(windows)])

    exact, size = np.asarray(theta, np.float64), 1e-5
    chosen = np.random.default_rng(0).choice(theta.shape[0], 60, replace=False)
    steps = size * np.eye(976)[chosen]
    slopes = np.stack([(actions(exact + step) - actions(exact - step)) / (2 * size) for step in steps])
    wanted = np.einsum("iwj,kwj->ik", slopes, slopes) / len(windows)
    np.testing.assert_allclose(found[np.ix_(chosen, chosen)], wanted, rtol=0, atol=2e-4 * np.abs(wanted).max())


def test_devices_share_the_episodes(found, pool, theta):
    np.testing.assert_allclose(
        measured(Simulator(TASK, devices=2), pool, theta), found, rtol=0, atol=1e-5 * np.abs(found).max()
    )


NETWORK = """
import jax.numpy as jnp
from mjx_tt.env.own import network

@network("linear", shapes={"weights": (8, 11), "bias": (8,)})
class Linear:
    @staticmethod
    def start(parameters, x):
        return ()

    @staticmethod
    def step(parameters, state, x):
        return parameters["weights"] @ x + parameters["bias"], state
"""


def test_a_network_of_ones_own(pool):
    """A linear one: the metric joins no two joints, is the same for each, and holds the inputs' second moments."""
    network = own.load(NETWORK, "linear.py").networks["linear"]
    found = measured(Simulator(TASK), pool, jnp.full(network.size, 1e-3), network)
    weights, bias = found[:88, :88].reshape(8, 11, 8, 11), found[88:, 88:]
    np.testing.assert_allclose(bias, np.eye(8), atol=1e-6)
    for i in range(8):
        for j in range(8):
            wanted = weights[0, :, 0] if i == j else np.zeros((11, 11))
            np.testing.assert_allclose(weights[i, :, j], wanted, atol=1e-4 * np.abs(weights).max())
    moments = weights[0, :, 0]
    assert np.linalg.eigvalsh(moments).min() > -1e-4 * np.trace(moments) and moments[1, 1] > 0.01


@pytest.fixture(scope="module")
def trainer(pool):
    return Trainer(Simulator(TASK), BGS, pool, SimModel(), repeats=2, metric=ActionMetric(every=2, damping=0.1))


@pytest.fixture(scope="module")
def trained(trainer, theta):
    """States before and after each of four updates, for which the metric is measured before the first and the third."""
    states = [trainer.init(jax.random.key(1), theta, STATISTICS)]
    for _ in range(4):
        states.append(trainer.update(states[-1])[0])
    return states


def test_training_measures_it_in_time(trained):
    factors = [np.asarray(state.bgs.factor) for state in trained]
    np.testing.assert_array_equal(factors[0], np.eye(976))
    assert np.abs(factors[1] - factors[0]).max() > 0.1
    np.testing.assert_array_equal(factors[2], factors[1])
    assert 0 < np.abs(factors[3] - factors[2]).max()
    np.testing.assert_array_equal(factors[4], factors[3])


def test_a_state_taken_up_again_goes_on_to_the_same_numbers(trainer, trained):
    kept = jax.tree.map(jnp.asarray, trained[1])
    again = trainer.update(trainer.update(kept)[0])[0]
    np.testing.assert_array_equal(again.bgs.theta, trained[3].bgs.theta)
    np.testing.assert_array_equal(again.bgs.factor, trained[3].bgs.factor)


def test_members_change_the_actions_as_much_as_before(trained, pool):
    """sigma keeps its meaning: the mean square of an action's change is that of isotropic perturbations."""
    simulator = Simulator(TASK)
    episodes = simulator.draw(jax.random.key(8), pool, SimModel(), (), 1, 512)

    found = measured(simulator, pool, trained[0].bgs.theta, episodes=episodes)
    factor = np.asarray(trained[1].bgs.factor, np.float64)
    assert np.trace(factor.T @ found @ factor) == pytest.approx(np.trace(found), rel=0.2)
