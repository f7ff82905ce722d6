"""Robots with other joints than the paper's: episodes, and the exported policy against the simulated one."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env.policy import controller, initial_theta
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.robot import robots
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from robot_io import contract
from robot_io.policy import artefact, export
from robot_io.policy.jax_policy import Policy
from tests.support.scripted_episodes import Overheard

OTHERS = [name for name in robots.names() if name != robots.DEFAULT]
TICKS = 60


@pytest.fixture(scope="module", params=OTHERS)
def played(request):
    """A robot, a policy, and what it saw and did in four episodes: (TICKS, 3 + n, 4), (TICKS, n, 4)."""
    robot = robots.load_shipped(request.param)
    simulator = Simulator(TaskConfig(robot=robot))
    model = SimModel(joints=robot.contract.joints)
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), model.ball, 64)
    joints, rng = robot.contract.n_joints, np.random.default_rng(0)
    theta = np.asarray(initial_theta(jax.random.key(0), 0.3, contract.n_parameters(joints)))
    mean = np.concatenate([[0.3, -0.5, 0.3], robot.home]).astype(np.float32)
    policy = Policy(theta, mean, rng.uniform(1.0, 3.0, 3 + joints).astype(np.float32))

    @jax.jit
    def play(policy, pool):
        episodes = simulator.draw(jax.random.key(1), pool, model, (), 4, 1)
        task, plays = simulator.task, Overheard(controller(replace(policy, theta=policy.theta[:, None])))
        constants, state = task.prepare(episodes), task.reset(episodes, plays)

        def advance(state, tick):
            after = task.step(tick, state, episodes, constants, plays)
            return after, (*after.controller[1:], after.qpos, after.command, after.reference)

        return jax.lax.scan(advance, state, jnp.arange(TICKS))[1]

    return robot, policy, [np.asarray(a)[..., 0] for a in play(policy, pool)]


def test_the_artefacts_numpy_policy_answers_as_the_simulated_one(played, tmp_path):
    robot, policy, (seen, action, *_) = played
    report = export.write(tmp_path / "artefact", policy, {}, robot=robot.contract)
    assert report["largest_difference"] <= 1e-5
    loaded = artefact.load(tmp_path / "artefact")
    assert loaded.contract == robot.contract  # from the manifest alone
    for episode in range(seen.shape[2]):
        streaming = loaded.streaming()
        mine = np.array([streaming.step(observation) for observation in seen[:, :, episode]])
        np.testing.assert_allclose(mine, action[:, :, episode], rtol=0, atol=1e-5)
    assert np.abs(action).max() > 0.5


def test_commands_keep_the_robots_own_limits(played):
    robot, _, (*_, command, reference) = played
    limits = robot.contract.limits
    v, a = (np.array(x)[:, None] for x in (limits.velocity, limits.acceleration))
    assert (np.abs(command) <= v * (1 + 1e-5)).all()
    assert (np.abs(np.diff(command, axis=0)) <= a / 75.0 * (1 + 1e-4) + 1e-6).all()
    lower, upper = (np.array(x)[:, None] for x in (limits.lower, limits.upper))
    assert (reference > lower).all() and (reference < upper).all()
    assert np.ptp(reference, axis=0).min() > 0.05  # every joint moved


def test_latency_of_axes_and_arm_is_by_the_contract():
    """Of the UR10e the rail is late by the axes' delay, its other joints by the arm's."""
    robot = robots.load_shipped("ur10e_rail")
    simulator = Simulator(TaskConfig(robot=robot))
    values = {"latency.festo_action": 0.1, "latency.abb_action": 0.02, "drives.elbow.action_delay": 0.03}
    values |= {f"latency.{name}_std": 0.0 for name in models.LATENCIES}
    model = models.with_values(SimModel(joints=robot.contract.joints), values)
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), model.ball, 64)
    constants = simulator.task.prepare(simulator.draw(jax.random.key(1), pool, model, (), 2, 1))
    delay = np.asarray(constants.action.periods)[:, 0, 0]
    expected = np.full(7, 0.02)
    expected[0], expected[robot.contract.joints.index("elbow")] = 0.1, 0.05
    np.testing.assert_array_equal(delay, np.floor(expected * 75.0))
