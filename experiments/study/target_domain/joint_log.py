"""A minute of the virtual reality's robot: all joints move a little, their commands and measured positions are kept.

What a laboratory records before the first ball. Each joint follows a sum of sines of its own, so that its position
stays near home while its speed and acceleration take many values (multisine: Schoukens and Ljung, IEEE Control Systems
39, 2019). Robot, drives, latencies and encoders are the reality's, run by the simulator of its rallies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PRNGKeyArray

from ballmodel.state import BallState
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.env.episode import Episodes, EpisodeState, Tick
from mjx_tt.env.task import Task
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from robot_io.contract import LIMITS, JointLimits

REST = 0.5  # [s] before the first motion, in which the joints stand where they are
SINES = 6
FREQUENCIES = (0.25, 3.0)  # [Hz]
REACH = 0.04  # of a joint's range that its position leaves home by, about


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sweeps:
    """Actions by tick as a ``Controller``."""

    actions: Array  # (ticks, n)

    @property
    def mean(self) -> Array:
        return jnp.zeros(3 + self.actions.shape[1])

    def start(self, observation: Array) -> tuple:
        return ()

    def act(self, tick: Tick, state: tuple, observation: Array) -> tuple[Array, tuple]:
        return jnp.broadcast_to(self.actions[tick][:, None], (self.actions.shape[1], *observation.shape[1:])), ()


def multisine(rng: np.random.Generator, ticks: int, period: float, limits: JointLimits = LIMITS) -> np.ndarray:
    """Actions (ticks, n) in [-1, 1]: derivatives of sums of sines that begin and end softly, after a rest."""
    time = np.arange(ticks) * period - REST
    (low, high), n = np.log(FREQUENCIES), len(limits.joints)
    frequency = np.exp(rng.uniform(low, high, (SINES, n)))
    phase = rng.uniform(0.0, 2.0 * np.pi, (SINES, n))
    reach = REACH * (np.asarray(limits.upper) - np.asarray(limits.lower))
    rate = 2.0 * np.pi * frequency
    speed = rate * np.cos(rate * time[:, None, None] + phase) / np.maximum(frequency, 1.0)
    velocity = reach * speed.sum(axis=1) / np.sqrt(SINES)
    soft = np.clip(time / 0.5, 0.0, 1.0) * np.clip((time[-1] - time) / 0.5, 0.0, 1.0)
    return np.clip(velocity * soft[:, None] / np.asarray(limits.policy_velocity), -1.0, 1.0)


def record(task: Task, model: SimModel, key: PRNGKeyArray, seconds: float = 60.0) -> tuple[JointRecord, ...]:
    """The log of a robot of that model which was swept for so many seconds, a record for each joint."""
    ticks, period = round(seconds / task.config.period), task.config.period
    actions = multisine(np.random.default_rng(int(jax.random.bits(key))), ticks, period, task.contract.limits)
    commands, positions = _swept(model, Sweeps(jnp.asarray(actions, jnp.float32)), task=task)
    time = np.arange(ticks) * period
    numbers = [np.asarray(values, np.float64).T for values in (commands, positions)]
    return tuple(
        JointRecord(name, time, command, time, position, task.config.robot)
        for name, command, position in zip(task.contract.joints, *numbers, strict=True)
    )


@partial(jax.jit, static_argnames="task")
def _swept(model: SimModel, sweeps: Sweeps, task: Task) -> tuple[Array, Array]:
    """Commands and measured positions (ticks, n)."""
    # Over a minute what an episode's latency is off its mean averages out.
    latency = jnp.stack([jnp.full((1,), getattr(model.latency, name)) for name in models.LATENCIES])
    still = jnp.zeros((3, 1))
    episodes = Episodes(
        ball=BallState(jnp.array([[0.0], [0.0], [1.0]]), still, still),
        latency=latency,
        seed=jnp.zeros((1,), jnp.uint32),
        model=model,
    )
    constants = task.prepare(episodes)

    def advance(s: EpisodeState, tick: Tick) -> tuple[EpisodeState, tuple[Array, Array]]:
        seen = task.observe(tick, s, episodes, constants)
        s = task.step(tick, s, episodes, constants, sweeps)
        kept = replace(s, ball=episodes.ball, live=jnp.ones_like(s.live))  # no ball is played
        return kept, (s.command[:, 0], seen[3:, 0])

    ticks = jnp.arange(sweeps.actions.shape[0])
    _, found = jax.lax.scan(advance, task.reset(episodes, sweeps), ticks)
    return found
