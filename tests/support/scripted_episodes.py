"""Plays hand-made episodes of the task tick by tick and keeps everything that happens on the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from ballmodel.state import ball_state
from mjx_tt.env.episode import Episodes, EpisodeState, Return
from mjx_tt.env.return_flight import fly_return
from mjx_tt.env.task import Task, TaskConfig, evaluate_rewards
from mjx_tt.pytrees import pytree
from mjx_tt.robot import mjcf
from mjx_tt.sim.model import LATENCIES, SimModel
from robot_io.contract import N_JOINTS, N_OBSERVATION

P, TICKS = 8, 100  # episodes and control periods of most tests: one size, so that they share one compilation


@pytree
class Script:
    """A controller that plays given actions (ticks, 8, P) and remembers what it was shown."""

    actions: jax.Array
    mean: jax.Array

    def start(self, observation):
        return observation

    def act(self, tick, state, observation):
        return self.actions[tick], observation


@pytree
class Overheard:
    """A controller whose state also holds what it last saw and answered."""

    inner: Any

    @property
    def mean(self):
        return self.inner.mean

    def start(self, observation):
        action = jnp.zeros((observation.shape[0] - 3, *observation.shape[1:]))
        return self.inner.start(observation), observation, action

    def act(self, tick, state, observation):
        action, after = self.inner.act(tick, state[0], observation)
        return action, (after, observation, action)


@dataclass(frozen=True)
class Record:
    """Arrays (tick, ..., P) after each control period, the last state, and what came of the return and the rewards."""

    qpos: np.ndarray
    paddle: np.ndarray
    ball: np.ndarray
    command: np.ndarray
    controller: object  # the controller's state; a Script's is what it was shown
    live: np.ndarray
    last: EpisodeState
    back: Return
    terms: np.ndarray  # (11, P)


def script(actions=0.0, ticks: int = TICKS, p: int = P) -> Script:
    """``actions`` is anything that broadcasts to (ticks, 8, P)."""
    return Script(jnp.broadcast_to(jnp.asarray(actions, float), (ticks, N_JOINTS, p)), jnp.zeros(N_OBSERVATION))


def model(ball_noise: float = 0.0, gravity: float = 9.81) -> SimModel:
    """The nominal model with the second-order ball, so that no time step shows."""
    nominal = SimModel()
    flight = replace(nominal.ball.flight, integrator="midpoint", gravity_z=-gravity)
    return replace(
        nominal, ball=replace(nominal.ball, flight=flight), sensing=replace(nominal.sensing, ball_noise=ball_noise)
    )


def episodes(position, velocity, delays=None, simulation: SimModel | None = None, p: int = P) -> Episodes:
    """P episodes from position and velocity (3,) or (3, P); delays {name of model.LATENCIES: seconds or (P,)}."""
    delays = delays or {}
    unknown = delays.keys() - set(LATENCIES)
    if unknown:
        raise ValueError(f"no latencies {unknown}, there are {LATENCIES}")
    position, velocity = (np.broadcast_to(np.reshape(x, (3, -1)), (3, p)).astype(float) for x in (position, velocity))
    seconds = jnp.asarray([np.broadcast_to(delays.get(name, 0.0), p) for name in LATENCIES])
    return Episodes(
        ball=ball_state(jnp.asarray(position), jnp.asarray(velocity)),
        latency=seconds,
        seed=jnp.arange(p, dtype=jnp.uint32) * 7919 + 1,
        model=jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, float), p), simulation or model()),
    )


@cache
def task(engine: str = "fused", sim_rate: float = 300.0) -> Task:
    return Task(TaskConfig(engine=engine, sim_rate=sim_rate))


@cache
def _player(task: Task, ticks: int):
    def play(controller, episodes):
        constants = task.prepare(episodes)

        def advance(state, tick):
            new = task.step(tick, state, episodes, constants, controller)
            return new, (new.qpos, new.pose.position, new.ball.position, new.command, new.controller, new.live)

        state = task.reset(episodes, controller)
        last, kept = jax.lax.scan(advance, state, jnp.arange(ticks, dtype=jnp.int32))
        back = fly_return(task.config, last.ball, last.hit, episodes.model)
        return *kept, last, back, evaluate_rewards(task.config.rewards, last, back)

    return jax.jit(play)


def mujoco_path(velocities: np.ndarray) -> np.ndarray:
    """Joint path (steps + 1, 8) of MuJoCo C from home under velocities (steps, 8)."""
    model = mjcf.load_model()
    data = mujoco.MjData(model)
    path = [mjcf.home_qpos(model)]
    data.qpos[:] = path[0]
    for velocity in velocities:
        data.ctrl[:] = velocity
        mujoco.mj_step(model, data)
        path.append(data.qpos.copy())
    return np.array(path)


def play(task: Task, episodes: Episodes, controller=None, ticks: int = TICKS) -> Record:
    """Plays ``ticks`` control periods; without a controller the robot stands still."""
    controller = controller or script(0.0, ticks, episodes.seed.shape[0])
    return Record(*jax.tree.map(np.asarray, _player(task, ticks)(controller, episodes)))
