"""Updates by first-order gradients: devices, failed episodes, statistics, and that they learn from few balls."""

from __future__ import annotations

from dataclasses import replace
from textwrap import indent

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from bgs import normalizer, optimizers
from bgs.strategy import BGSConfig
from experiments.config import build
from experiments.config.experiment import load
from experiments.training.first_order import FirstOrderTrainer
from experiments.training.loop import make_trainer
from mjx_tt.env.episode import MISSED
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import SimModel
from tests.support.small_network import SMALL

PAIRS, REPEATS = 2, 4
TASK = TaskConfig(sim_rate=75.0)  # one substep: compiles in half the time
BGS = BGSConfig(num_directions=PAIRS, sigma=0.01, step=optimizers.make("sgd", 0.01), ema_decay=0.5)


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.load("narrow"), SimModel().ball, 64)


def trainer_on(devices, pool, config=BGS, repeats=REPEATS):
    return FirstOrderTrainer(Simulator(TASK, devices), config, pool, SimModel(), episodes_per_direction=repeats)


def updated(devices, pool):
    """A trainer, the states before and after one update, and its metrics."""
    trainer = trainer_on(devices, pool)
    before = trainer.init(jax.random.key(1))
    after, metrics = trainer.update(before)
    return trainer, before, after, jax.tree.map(float, metrics)


@pytest.fixture(scope="module")
def one(pool):
    return updated(1, pool)


def test_two_devices_learn_what_one_learns(one, pool):
    _, _, after, metrics = updated(2, pool)
    np.testing.assert_allclose(after.bgs.theta, one[2].bgs.theta, rtol=1e-4, atol=1e-6)
    assert metrics == pytest.approx(one[3], rel=1e-3, abs=1e-6)


def test_an_update_climbs_the_clipped_gradient_and_averages(one):
    _, before, after, metrics = one
    change = np.asarray(after.bgs.theta - before.bgs.theta)
    # Plain steps of rate 0.01 along a gradient whose norm is cut to 1.
    assert np.linalg.norm(change) == pytest.approx(0.01 * min(1.0, metrics["gradient_norm"]), rel=1e-3)
    assert metrics["update_norm"] == pytest.approx(np.linalg.norm(change), rel=1e-4)
    np.testing.assert_allclose(after.bgs.average, (before.bgs.theta + after.bgs.theta) / 2, rtol=1e-5, atol=1e-7)
    assert int(after.bgs.updates) == 1


def poisoned(trainer, pool, balls):
    """What an update reads, with balls (k,) of the pool that fly nowhere."""
    position = pool.state.position.at[0, balls].set(jnp.nan)
    pool = replace(pool, state=replace(pool.state, position=position))
    return trainer.simulator.replicate(pool), trainer.inputs[1]


def test_policies_that_meet_a_ball_without_a_finite_cost_are_counted_and_do_not_learn(one, pool):
    trainer, before, whole, _ = one
    _, episodes = trainer._draw(before, trainer.inputs, 2 * PAIRS)
    thrown, x = np.asarray(episodes.ball.position[0]), np.asarray(pool.state.position[0])
    ball = next(i for i in range(len(x)) if (thrown == x[i]).any())
    failed = int((thrown == x[ball]).any(axis=0).sum())
    assert 0 < failed < 2 * PAIRS
    after, metrics = trainer._update(before, poisoned(trainer, pool, [ball]))
    assert float(metrics["non_finite"]) == failed * REPEATS
    assert np.isfinite(np.asarray(after.bgs.theta)).all() and float(metrics["update_norm"]) > 0.0
    assert np.abs(np.asarray(after.bgs.theta - whole.bgs.theta)).max() > 0.0


def test_without_one_finite_episode_nothing_changes(one, pool):
    trainer, _, before, _ = one
    after, metrics = trainer._update(before, poisoned(trainer, pool, np.arange(64)))
    np.testing.assert_array_equal(after.bgs.theta, before.bgs.theta)
    np.testing.assert_array_equal(after.bgs.average, before.bgs.average)
    assert np.abs(np.asarray(before.bgs.average - before.bgs.theta)).max() > 0.0  # a step would move it
    assert float(metrics["non_finite"]) == 2 * PAIRS * REPEATS and int(after.bgs.updates) == 2


OTHERS = {
    "a network of one's own": "definitions: |\n" + indent(SMALL, "  ") + "\nnetwork: small\nballs: player3/M0",
    "another robot": "robot: ur10e_rail\nballs: player3/M0",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHERS)
def test_other_networks_and_robots_learn_as_well(kind, tmp_path):
    """A step along the gradient of one update plays these very balls better."""
    file = tmp_path / "other.yaml"
    file.write_text(
        f"name: other\n{OTHERS[kind]}\ntask: {{sim_rate: 75.0}}\n"
        "optimiser: {gradient: first_order, num_directions: 1, repeats: 8, sigma: 1.0e-6, ema_decay: 0.0, "
        "step: {kind: sgd, learning_rate: 0.003, schedule: {kind: constant}}}\ntraining: {pool: 32, devices: 1}\n"
    )
    trainer = make_trainer(build.experiment(load(file), str(file)))
    before = trainer.init(jax.random.key(1))
    after, metrics = trainer.update(before)
    # The same update again, with the same balls, from the later parameters.
    again = replace(after, bgs=replace(after.bgs, updates=before.bgs.updates), statistics=before.statistics)
    _, better = trainer.update(again)
    assert float(metrics["gradient_norm"]) > 0.0 and float(metrics["non_finite"]) == 0.0
    assert float(better["mean_return"]) > float(metrics["mean_return"])


@pytest.mark.slow
def test_it_learns_to_hit_from_fifteen_thousand_balls(pool):
    """From random weights; the simulator judges. BGS needs some hundred times as many."""
    config = replace(BGS, num_directions=1, step=optimizers.make("adam", 0.01, 0.9, 0.99), ema_decay=0.9)
    trainer = trainer_on(1, pool, config, repeats=64)
    state = trainer.init(jax.random.key(2))
    for _ in range(120):
        state, _ = trainer.update(state)
    simulator = trainer.simulator
    episodes = simulator.draw(jax.random.key(3), pool, SimModel(), (), 200, 1)

    def share(theta):
        policy = Policy(theta[:, None], *normalizer.normaliser(state.statistics))
        return float((np.asarray(jax.jit(simulator.rollout)(policy, episodes).outcome) != MISSED).mean())

    assert share(trainer.init(jax.random.key(2)).bgs.theta) < 0.05
    assert share(state.bgs.average) > 0.5
