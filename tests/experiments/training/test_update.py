"""The compiled update: devices, failed episodes, common random numbers, one compilation, both engines."""

from __future__ import annotations

import logging
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from bgs import normalizer, optimizers, strategy
from bgs.strategy import BGSConfig
from experiments.config import build, experiment, files
from experiments.training import loop
from experiments.training.update import Trainer
from mjx_tt.env import reward_weights
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig, weigh_rewards
from mjx_tt.sim import model as models
from mjx_tt.sim.model import Samples, SimModel

PAIRS, REPEATS = 4, 2
TASK = TaskConfig(sim_rate=75.0)  # one substep: compiles in half the time
BGS = BGSConfig(num_directions=PAIRS, sigma=0.05, elite_fraction=1.0, step=optimizers.make("sgd", 0.01))


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.load("narrow"), SimModel().ball, 64)


@pytest.fixture(scope="module")
def trainer(pool):
    return Trainer(Simulator(TASK), BGS, pool, SimModel(), episodes_per_direction=REPEATS)


@pytest.fixture(scope="module")
def run(trainer):
    """The state before and after each of three updates, and their metrics."""
    return updates(trainer)


def updates(trainer):
    states, metrics = [trainer.init(jax.random.key(1))], []
    for _ in range(3):
        state, measured = trainer.update(states[-1])
        states.append(state)
        metrics.append(jax.tree.map(float, measured))
    return states, metrics


@pytest.mark.parametrize("devices", [1, 2])
def test_several_updates_compile_once(trainer, trainer_on_two, run, run_on_two, devices, caplog):
    trainer, states = {1: (trainer, run[0]), 2: (trainer_on_two, run_on_two[0])}[devices]
    with jax.log_compiles(True), caplog.at_level(logging.WARNING):
        for state in states:
            trainer.update(state)
        assert not [r for r in caplog.records if "compil" in r.getMessage().lower()]
        jax.jit(lambda x: x + devices)(1.0)
    assert [r for r in caplog.records if "compil" in r.getMessage().lower()], "compilations are not logged any more"


PATH = "ball.table.restitution"


def in_samples(pool, *restitutions: float) -> Trainer:
    rows = Samples((PATH,), np.array(restitutions)[:, None], np.ones(len(restitutions)))
    return Trainer(Simulator(TASK), BGS, pool, SimModel(), (rows,), REPEATS)


def test_a_program_compiled_for_some_samples_serves_others(pool):
    first, second = in_samples(pool, 0.9, 0.95), in_samples(pool, 0.2, 0.2)
    state = first.init(jax.random.key(1))
    program = first.lower(state).compile()
    metrics = [program(state, one.inputs)[1]["mean_return"] for one in (first, second)]
    assert metrics[0] != metrics[1]  # the samples do something
    # All samples alike are a number of the model.
    known = Trainer(
        Simulator(TASK), BGS, pool, models.with_values(SimModel(), {PATH: 0.2}), episodes_per_direction=REPEATS
    )
    theta, same = (x[0].bgs.theta for x in (program(state, second.inputs), known.update(state)))
    np.testing.assert_allclose(theta, same, atol=1e-5)


def test_samples_of_the_same_parameters_have_one_program_others_another():
    def program(model: dict) -> str:
        config = experiment.load(files.find_shipped("quickstart", "train")).model_copy(update={"model": model})
        return loop.program(config, 1)

    def world(restitution: float, height: float, **samples: list) -> dict:
        ball = {"table": {"restitution": restitution, "height": height}}
        return {"ball": ball, "randomise": {"samples": samples, "ball.net.height": [0.0, 0.01]}}

    one = program(world(0.9, 0.0, **{PATH: [0.9, 0.8]}))
    assert one == program(world(0.7, 0.0, **{PATH: [0.7, 0.6]}))  # what is drawn replaces the model's number
    assert program(world(0.9, 0.01, **{PATH: [0.9, 0.8]})) == program(world(0.9, 0.02, **{PATH: [0.9, 0.8]}))
    others = [
        world(0.9, 0.01, **{PATH: [0.9, 0.8]}),  # another number is used
        world(0.9, 0.0, **{PATH: [0.9, 0.8, 0.7]}),
        world(0.9, 0.0, **{"ball.table.height": [0.0, 0.0]}),
    ]
    assert len({one, *map(program, others)}) == 4


@pytest.fixture(scope="module")
def trainer_on_two(pool):
    return Trainer(Simulator(TASK, devices=2), BGS, pool, SimModel(), episodes_per_direction=REPEATS)


@pytest.fixture(scope="module")
def run_on_two(trainer_on_two):
    return updates(trainer_on_two)


def test_two_devices_give_the_update_of_one(run, run_on_two):
    """To the order of float32 sums, over several updates, so that statistics and normaliser take part."""
    for before, one, two in zip(run[0][:-1], run[0][1:], run_on_two[0][1:], strict=True):
        change = np.asarray(one.bgs.theta) - np.asarray(before.bgs.theta)
        np.testing.assert_allclose(two.bgs.theta, one.bgs.theta, rtol=0, atol=1e-3 * np.abs(change).max())
        np.testing.assert_array_equal(two.statistics.count, one.statistics.count)
        np.testing.assert_allclose(two.statistics.mean, one.statistics.mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(two.statistics.m2, one.statistics.m2, rtol=1e-4)
    for one, two in zip(run[1], run_on_two[1], strict=True):
        assert two == pytest.approx(one, rel=1e-3, abs=1e-5)
    assert {shard.device for shard in run_on_two[0][1].bgs.theta.addressable_shards} == set(jax.devices()[:2])


def drawn(trainer, state):
    """Population and episodes (R, 2 x pairs) of the update of ``state``."""
    direction_key, episode_key = jax.random.split(jax.random.fold_in(state.key, state.bgs.updates))
    population = strategy.ask(direction_key, state.bgs, BGS)
    return population, trainer.simulator.draw(episode_key, trainer.pool, SimModel(), (), REPEATS, 2 * PAIRS)


def test_update_is_the_step_that_the_returns_call_for(trainer, run):
    """By hand from the returns: sum of D_i delta_i / (k s), times the learning rate; and statistics merged."""
    before, after = run[0][0], run[0][1]
    population, episodes = drawn(trainer, before)
    theta, directions = population.members, population.directions
    result = jax.jit(trainer.simulator.rollout)(Policy(theta, *normalizer.normaliser(before.statistics)), episodes)
    returns = np.asarray(result.returns, np.float64).mean(axis=0)
    plus, minus = returns[:PAIRS], returns[PAIRS:]
    gradient = np.asarray(directions) @ (plus - minus) / (PAIRS * returns.std())
    change = np.asarray(after.bgs.theta) - np.asarray(before.bgs.theta)
    np.testing.assert_allclose(change, 0.01 * gradient, rtol=0, atol=1e-3 * np.abs(change).max())
    assert np.abs(change).max() > 1e-5
    counts, sums = np.asarray(result.observation_counts), np.asarray(result.observation_sums).sum(axis=-1)
    assert float(normalizer.total(after.statistics)) == counts.sum()
    np.testing.assert_allclose(after.statistics.mean, sums[0] / counts.sum(), rtol=1e-4, atol=1e-5)
    deviations = sums[1] - sums[0] ** 2 / counts.sum()
    np.testing.assert_allclose(after.statistics.m2, deviations, rtol=1e-3, atol=1e-2)
    metrics = run[1][0]
    assert metrics["mean_return"] == pytest.approx(returns.mean(), rel=1e-4)
    assert metrics["steps"] == pytest.approx(np.asarray(result.steps).mean(), rel=1e-5)
    assert metrics["non_finite"] == metrics["failed_pairs"] == 0


def test_failed_episodes_are_counted_and_their_pairs_dropped(trainer, run, pool):
    """A ball of the pool that is not finite fails every member that draws it, and with it the member's pair."""
    start = run[0][0]
    population, episodes = drawn(trainer, start)
    x = np.asarray(pool.state.position[0])
    thrown = np.asarray(episodes.ball.position[0])
    poisoned = next(i for i in range(len(x)) if (thrown == x[i]).any())
    meets = (thrown == x[poisoned]).any(axis=0)
    pairs = meets[:PAIRS] | meets[PAIRS:]
    assert 0 < pairs.sum() < PAIRS
    position = pool.state.position.at[0, poisoned].set(jnp.nan)
    bad_pool = trainer.simulator.replicate(replace(pool, state=replace(pool.state, position=position)))
    state, metrics = trainer._update(start, (bad_pool, trainer.inputs[1]))
    assert metrics["failed_pairs"] == pairs.sum()
    assert metrics["non_finite"] == (thrown == x[poisoned]).sum()
    assert np.isfinite(state.bgs.theta).all() and np.isfinite(state.statistics.mean).all()
    # The change lies in the span of the directions that are left.
    directions = np.asarray(population.directions, np.float64)[:, ~pairs]
    change = np.asarray(state.bgs.theta, np.float64) - np.asarray(start.bgs.theta, np.float64)
    left = change - directions @ np.linalg.lstsq(directions, change, rcond=None)[0]
    assert np.linalg.norm(change) > 1e-4 and np.linalg.norm(left) < 1e-3 * np.linalg.norm(change)


TINY = """
name: tiny
balls: narrow
task: {{engine: {engine}}}
optimiser: {{num_directions: 1, repeats: 1, sigma: 1.0e-12, common_random_numbers: true}}
training: {{pool: 16, devices: 1}}
"""


@pytest.mark.slow
def test_the_same_yaml_trains_under_both_engines():
    """The smallest experiment: one pair, one episode each. Common random numbers give both members of a pair the same
    ball, latencies and noise, so without a difference in their parameters there is none in their returns."""
    returns = {}
    for engine in ("fused", "mjx"):
        settings = experiment.parse(files.read_yaml(TINY.format(engine=engine), "tiny.yaml"), "tiny.yaml")
        trainer = loop.make_trainer(build.experiment(settings, "tiny.yaml"))
        state, metrics = trainer.update(trainer.init(build.key(0, build.INITIAL_STATE)))
        assert trainer.simulator.task.engine.name == engine
        assert int(state.bgs.updates) == 1 and np.isfinite(state.bgs.theta).all()
        assert metrics["non_finite"] == 0 and metrics["gradient_norm"] == 0
        returns[engine] = float(metrics["mean_return"])
    assert returns["fused"] == pytest.approx(returns["mjx"], rel=1e-3)


@pytest.mark.slow
def test_later_weights_take_over_after_their_update(trainer, run, pool):
    """Before it nothing changes; from then on the step is that of a task with these weights."""
    changed = reward_weights.SIM_WEIGHTS | {"state_transition": 0.0}
    weights = tuple(changed.values())
    changing = Trainer(
        Simulator(TASK), BGS, pool, SimModel(), episodes_per_direction=REPEATS, reward_schedule=(2, weights)
    )
    other = Trainer(
        Simulator(replace(TASK, rewards=weigh_rewards(changed))), BGS, pool, SimModel(), episodes_per_direction=REPEATS
    )
    states, metrics = updates(changing)
    for i in (1, 2):
        np.testing.assert_allclose(states[i].bgs.theta, run[0][i].bgs.theta, rtol=0, atol=1e-6)
    expected, _ = other.update(states[2])
    np.testing.assert_allclose(states[3].bgs.theta, expected.bgs.theta, rtol=0, atol=1e-6)
    assert np.abs(np.asarray(states[3].bgs.theta - trainer.update(states[2])[0].bgs.theta)).max() > 1e-4
    for measured, used in zip(metrics, (tuple(reward_weights.SIM_WEIGHTS.values()),) * 2 + (weights,), strict=True):
        terms = [measured[f"reward/{name}"] for name in reward_weights.TERMS]
        assert measured["mean_return"] == pytest.approx(np.dot(used, terms), rel=1e-5)
