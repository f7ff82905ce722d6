"""The differentiable roll-out plays the episodes that the simulator plays; its slopes are those of its values."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env.episode import MISSED, RETURNED, reshape_episodes
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig, weigh_rewards
from mjx_tt.gradient import motion as motions
from mjx_tt.gradient.incoming import fly_incoming
from mjx_tt.gradient.network import differentiable
from mjx_tt.gradient.objective import Objective
from mjx_tt.sim.actuators import DriveParams, JointDrive
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.sensors import SensingParams
from robot_io.policy import artefact
from tests.support.paths import ROOT

R, P, TICKS = 32, 4, 110
CONFIG = TaskConfig(sim_rate=150.0)
FAULTS = ("collision", "paddle_height", "style")
SHIPPED = ROOT / "experiments/shipped/policies/quickstart"
WRONG = SimModel(
    drives=DriveParams(
        joint_1=JointDrive(lag=0.01, velocity_gain=0.97, backlash=0.004),
        joint_5=JointDrive(resonance=12.0, joint_offset=0.01, deadband=0.01),
        gantry_y=JointDrive(acceleration_limit=20.0, coulomb_friction=0.01, action_delay=0.01),
    ),
    sensing=SensingParams(ball_noise=0.005, camera_rotation_x=0.01, smoothing=0.01, filter_time=0.02, jitter=0.002),
)


@pytest.fixture(scope="module")
def policy():
    shipped = artefact.load(SHIPPED).policy
    theta = jnp.asarray(shipped.theta, jnp.float32)
    # Four policies that play differently well.
    members = theta[:, None] + jnp.array([[0.0, 0.02, 0.04, 0.08]]) * jax.random.normal(jax.random.key(3), (976, P))
    return Policy(members, jnp.asarray(shipped.mean, jnp.float32), jnp.asarray(shipped.inv_std, jnp.float32))


@pytest.fixture(scope="module")
def pool():
    return sample_pool(jax.random.key(0), registry.resolve("player3/M0"), SimModel().ball, 256)


def episodes(pool, model=SimModel()):  # noqa: B008
    return Simulator(CONFIG).draw(jax.random.key(1), pool, model, (), R, P)


@pytest.mark.parametrize("model", [SimModel(), WRONG], ids=["nominal", "wrong in every way"])
def test_it_hits_and_returns_the_balls_that_the_simulator_does(policy, pool, model):
    drawn = episodes(pool, model)
    simulator = Simulator(CONFIG)
    played = jax.jit(Objective(simulator.task, TICKS).play)(policy, reshape_episodes(drawn, -1))
    wanted = jax.jit(simulator.rollout)(policy, drawn)
    hit, returned = (np.asarray(x).reshape(R, P) for x in (played.hit, played.returned))
    outcome = np.asarray(wanted.outcome)
    assert 0.15 < (outcome == RETURNED).mean() < 0.95 and 0.05 < (outcome == MISSED).mean()
    # A touch at the blade's rim or a landing on the table's edge may turn out otherwise by rounding.
    assert (hit != (outcome != MISSED)).mean() < 0.02
    assert (returned != (outcome == RETURNED)).mean() < 0.04
    both = hit & (outcome != MISSED)
    np.testing.assert_array_equal(np.asarray(played.ends).reshape(R, P)[both], np.asarray(wanted.steps)[both])
    # Also of a miss all control periods count, until the ball is out of play: most faults are there.
    alike, misses = hit == (outcome != MISSED), outcome == MISSED
    steps = np.minimum(np.asarray(wanted.steps), TICKS)
    np.testing.assert_array_equal(np.asarray(played.steps).reshape(R, P)[alike], steps[alike])
    terms = np.asarray(wanted.terms)[[CONFIG.terms.index(name) for name in FAULTS]]
    counted, faults = -terms.sum(0)[alike], np.asarray(played.faults).reshape(R, P)[alike]
    assert counted[misses[alike]].sum() > 20
    assert np.abs(faults - counted).sum() <= 0.01 * counted.sum() + 1.0  # a gap of nothing may round to either side


class Loops:
    """An engine whose joints are independent velocity loops, whose derivatives are then exact."""

    name = "loops"

    def __init__(self, task, gain):
        self.gain, self.timestep = gain, 1.0 / task.config.sim_rate

    def step(self, qpos, qvel, ctrl):
        velocity = qvel + self.gain.reshape(-1, *(1,) * (qvel.ndim - 1)).astype(qvel.dtype) * (ctrl - qvel)
        return qpos + self.timestep * velocity, velocity


def test_slopes_are_those_of_finite_differences_where_joints_are_independent(policy, pool):
    """Episode by episode, of balls that are hit in the same substep at both ends: across a change there is no slope.

    Without faults, whose number has none; of misses it is left out that the nearer ones say more.
    """
    faultless = dict(zip(CONFIG.terms, CONFIG.reward_weights, strict=True)) | dict.fromkeys(FAULTS, 0.0)
    simulator = Simulator(replace(CONFIG, rewards=weigh_rewards(faultless)))
    simulator.task.engine = Loops(simulator.task, motions.measure_response(simulator.task))
    objective = Objective(simulator.task, TICKS)
    drawn = reshape_episodes(episodes(pool), -1)

    def play(theta):
        played = objective.play(replace(policy, theta=theta), drawn)
        return played.cost, (played.hit, played.substep)

    step, tiny = np.random.default_rng(1).normal(size=policy.theta.shape).astype(np.float32), 1e-4
    _, told, (hit, substep) = jax.jit(lambda theta: jax.jvp(play, (theta,), (step,), has_aux=True))(policy.theta)
    (low, before), (high, after) = (jax.jit(play)(policy.theta + sign * tiny * step) for sign in (-1.0, 1.0))
    same = np.asarray(hit)
    assert same.sum() > 40
    for there in (before, after):
        same = same & np.asarray(there[0]) & (np.asarray(there[1]) == np.asarray(substep))
    assert same.sum() > 30
    ahead, told = (np.asarray(high) - np.asarray(low))[same] / (2 * tiny), np.asarray(told)[same]
    # In float32 a difference this small has some percent of noise; few episodes have a kink within it.
    assert np.median(np.abs(told - ahead) / (np.abs(ahead) + 0.1)) < 0.03
    assert (np.abs(told - ahead) < 0.2 * np.abs(ahead) + 0.5).mean() > 0.95


def test_the_loops_of_the_robot_predict_what_the_dynamics_do(policy, pool):
    """The motion's derivatives leave out how joints disturb each other: a hundredth of what the commands do."""
    simulator = Simulator(CONFIG)
    task, drawn = simulator.task, reshape_episodes(episodes(pool), -1)
    constants = task.prepare(drawn)
    ball, servos = fly_incoming(task, drawn, constants, 60), motions.Servos(task)

    def joints(theta):
        controller = differentiable(replace(policy, theta=theta))
        moved = motions.simulate_motion(task, servos, controller, drawn, constants, ball)
        return moved.joints[-1]

    step = np.random.default_rng(2).normal(size=policy.theta.shape).astype(np.float32)
    told = np.asarray(jax.jit(lambda theta: jax.jvp(joints, (theta,), (step,))[1])(policy.theta))
    tiny = 1e-3
    moved = jax.jit(joints)
    ahead = (np.asarray(moved(policy.theta + tiny * step)) - np.asarray(moved(policy.theta - tiny * step))) / (2 * tiny)
    assert np.median(np.abs(told - ahead)) < 0.03 * np.sqrt((ahead**2).mean())
