"""Learning from a replay buffer: what SAC and QT-Opt share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.types import Params, Transition
from flax import struct

from experiments.baselines import learner
from experiments.baselines.learner import Advance, Learner, Measured, NetworkController
from experiments.config.baselines import Replay
from mjx_tt.env.brax import TableTennis
from robot_io.contract import N_JOINTS

CALL = 64  # steps of the environments in one call of ``compiled``


A = TypeVar("A")  # networks and states of their optimisers, a pytree


@struct.dataclass
class Buffer:
    """The last transitions, one a row, as a ring. (Brax's queue moves all of its rows once it is full.)"""

    rows: jax.Array  # (capacity, ``width``)
    added: jax.Array  # () int32, all transitions so far


def width(observation_size: int, joints: int) -> int:
    """Count of numbers in a transition."""
    return 2 * observation_size + joints + 2


def insert(buffer: Buffer, t: Transition) -> Buffer:
    """Adds a batch whose size divides the capacity."""
    rows = jnp.concatenate(
        [t.observation, t.action, t.reward[:, None], t.discount[:, None], t.next_observation], axis=1
    )
    capacity = buffer.rows.shape[0]
    place = jnp.mod(buffer.added, capacity)
    return Buffer(jax.lax.dynamic_update_slice_in_dim(buffer.rows, rows, place, 0), buffer.added + rows.shape[0])


def sample(buffer: Buffer, key: jax.Array, n: int, joints: int = N_JOINTS) -> Transition:
    """n transitions, drawn with replacement from those that the buffer holds; ``joints``: numbers in an action."""
    held = jnp.minimum(buffer.added, buffer.rows.shape[0])
    rows = buffer.rows[jax.random.randint(key, (n,), 0, held)]
    ends = np.cumsum([(rows.shape[1] - joints - 2) // 2, joints, 1, 1])
    observation, action, reward, discount, following = jnp.split(rows, ends, axis=1)
    extras = {"policy_extras": {}, "state_extras": {"truncation": jnp.zeros(n)}}
    return Transition(observation, action, reward[:, 0], discount[:, 0], following, extras)


class Agent(Protocol[A]):
    """Learner from transitions."""

    def init(self, key: jax.Array) -> A: ...

    def explore(
        self, agent: A, normaliser: RunningStatisticsState, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        """Actions (B, joints) to learn from."""

    def update(self, agent: A, normaliser: RunningStatisticsState, batch: Transition, key: jax.Array) -> A:
        """The agent after one gradient step."""

    def parameters(self, agent: A) -> Params:
        """Part of the agent that ``decide`` needs."""

    def decide(self, parameters: tuple[RunningStatisticsState, Params], observation: jax.Array) -> jax.Array:
        """Best actions (..., joints); ``parameters``: (normaliser, those of the agent)."""


@struct.dataclass
class OffPolicyState:
    agent: Any  # of the kind of agent
    normaliser: RunningStatisticsState
    buffer: Buffer
    env: State
    key: jax.Array


@dataclass(frozen=True, eq=False)
class OffPolicyLearner(Learner[OffPolicyState]):
    """Random actions first; then ``gradient_steps`` after every step of the environments."""

    replay: Replay
    env: TableTennis
    agent: Agent[Any]

    def init(self, key: jax.Array) -> OffPolicyState:
        agent_key, env_key, key = jax.random.split(key, 3)
        places = self.replay.environments
        env = jax.jit(self.env.reset)(jax.random.split(env_key, places))
        capacity = -(-self.replay.capacity // places) * places
        size = self.env.observation_size
        buffer = Buffer(jnp.zeros((capacity, width(size, self.env.action_size))), jnp.int32(0))
        return OffPolicyState(self.agent.init(agent_key), learner.empty_normaliser(size), buffer, env, key)

    def compiled(self, state: OffPolicyState) -> Advance[OffPolicyState]:
        return learner.compiled(self._advance, state)

    def controller(self, state: OffPolicyState) -> NetworkController:
        parameters = (state.normaliser, self.agent.parameters(state.agent))
        return learner.network_controller(parameters, state.normaliser, self.agent.decide)

    def _advance(self, state: OffPolicyState) -> tuple[OffPolicyState, Measured]:
        state, measured = jax.lax.scan(self._step, state, None, length=CALL)
        return state, learner.summed(measured)

    def _step(self, state: OffPolicyState, _: None) -> tuple[OffPolicyState, dict[str, jax.Array]]:
        play_key, learn_key, key = jax.random.split(state.key, 3)
        warm = state.buffer.added >= self.replay.random_steps

        def policy(observation: jax.Array, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
            action_key, random_key = jax.random.split(key)
            shape = observation.shape[0], self.env.action_size
            random = jax.random.uniform(random_key, shape, minval=-1.0, maxval=1.0)
            action = self.agent.explore(state.agent, state.normaliser, observation, action_key)
            return jnp.where(warm, action, random), {}

        env, transition, measured = learner.play(self.env, state.env, policy, play_key)
        normaliser = running_statistics.update(state.normaliser, transition.observation)
        buffer = insert(state.buffer, transition)

        def learn(agent: Any, key: jax.Array) -> tuple[Any, None]:
            sample_key, update_key = jax.random.split(key)
            batch = sample(buffer, sample_key, self.replay.batch, self.env.action_size)
            return self.agent.update(agent, normaliser, batch, update_key), None

        keys = jax.random.split(learn_key, self.replay.gradient_steps)
        agent = jax.lax.cond(warm, lambda a: jax.lax.scan(learn, a, keys)[0], lambda a: a, state.agent)
        return OffPolicyState(agent, normaliser, buffer, env, key), measured
