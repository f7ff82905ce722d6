"""QT-Opt in its small form (Kalashnikov et al. 2018): no actor, the critic's best action is searched for.

Q(s, a) is fitted to r + gamma min_i Q'_i(s', a'), with a' the action that the cross-entropy method finds for the target
network Q' (clipped double Q). What the original adds for its scale is left out: distributed actors and learners,
stored demonstrations, images, and its second, slower target network. Brax has no QT-Opt; its critics, replay buffer,
actor step and running statistics serve here, too.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State
from brax.training import acting, gradients, networks
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.replay_buffers import ReplayBufferState, UniformSamplingQueue
from brax.training.types import Params, Transition
from flax import struct

from experiments.baselines.learners import (
    PIECE,
    BudgetSpent,
    EpisodeCounter,
    NetworkController,
    Observer,
    empty_normaliser,
)
from experiments.config.baselines import QtOpt

Exploration = Callable[[jax.Array, jax.Array], tuple[jax.Array, dict[str, Any]]]  # (observation, key) -> action, extras


def best_action(value: Callable[[jax.Array], jax.Array], normals: jax.Array, elites: int) -> jax.Array:
    """The action (..., joints) that the cross-entropy method finds for ``value``: (..., n, joints) -> (..., n).

    Each round draws n actions, cut to [-1, 1], about the mean of the round before with its standard deviation, and
    keeps the best. The first round draws about 0 with deviation 1/2; the last mean is the answer.

    Args:
        value: worth of actions.
        normals: (rounds, n, joints) standard normal numbers, or (rounds, ..., n, joints).
        elites: actions that a round keeps.
    """
    joints = normals.shape[-1]
    mean, std = jnp.zeros(joints), jnp.full(joints, 0.5)
    for z in normals:
        actions = jnp.clip(mean + std * z, -1.0, 1.0)
        values = value(actions)
        actions = jnp.broadcast_to(actions, (*values.shape, joints))
        best = jax.lax.top_k(values, elites)[1]
        chosen = jnp.take_along_axis(actions, best[..., None], axis=-2)
        mean, std = chosen.mean(axis=-2, keepdims=True), chosen.std(axis=-2, keepdims=True)
    return mean[..., 0, :]


@struct.dataclass
class QtOptState:
    """Everything that learning changes."""

    critic: Params
    target: Params
    optimiser: optax.OptState
    normaliser: RunningStatisticsState
    buffer: ReplayBufferState
    env: State
    key: jax.Array


class QtOptLearner:
    """Random actions first, then ``gradient_steps`` after every step of the environments."""

    def __init__(self, settings: QtOpt, env: Env) -> None:
        self._settings, self.env = settings, EpisodeCounter(env)
        size, joints = env.observation_size, env.action_size
        self._critics = networks.make_q_network(
            size, joints, running_statistics.normalize, hidden_layer_sizes=tuple(settings.layers)
        )
        self._optimiser = optax.adam(settings.learning_rate)
        self._descend = gradients.gradient_update_fn(self._loss, self._optimiser, pmap_axis_name=None)
        seen, action, replay = jnp.zeros(size), jnp.zeros(joints), settings.replay
        extras: dict[str, Any] = {"policy_extras": {}, "state_extras": {}}
        self._queue = UniformSamplingQueue(
            replay.capacity, Transition(seen, action, 0.0, 0.0, seen, extras), replay.batch * replay.gradient_steps
        )
        # The same numbers at every decision: the policy is a function of what it sees.
        self._normals = self._draw(jax.random.key(0))

    def train(self, seed: int, observe: Observer) -> None:
        """As ``Learner``."""
        self.env = EpisodeCounter(self.env.env)
        fill, piece = (jax.jit(function, donate_argnums=0) for function in (self._fill, self._piece))
        state = jax.jit(self.init)(jax.random.PRNGKey(seed))
        with suppress(BudgetSpent):
            observe(self.controller(state.normaliser, state.critic), self.env.counts())
            state = fill(state)
            while True:
                state = piece(state)
                observe(self.controller(state.normaliser, state.critic), self.env.counts())

    def template(self) -> NetworkController:
        """As ``Learner``."""
        critic = self._critics.init(jax.random.PRNGKey(0))
        return jax.eval_shape(lambda: self.controller(empty_normaliser(self.env.observation_size), critic))

    def controller(self, normaliser: RunningStatisticsState, critic: Params) -> NetworkController:
        """The search without exploration."""
        return NetworkController.of(normaliser, critic, self._decide)

    def init(self, key: jax.Array) -> QtOptState:
        """The state before learning, its buffer empty."""
        critic_key, env_key, buffer_key, key = jax.random.split(key, 4)
        critic = self._critics.init(critic_key)
        target = jax.tree.map(jnp.copy, critic)  # a state that is given away whole must not hold an array twice
        env = self.env.reset(jax.random.split(env_key, self._settings.replay.environments))
        normaliser, buffer = empty_normaliser(self.env.observation_size), self._queue.init(buffer_key)
        return QtOptState(critic, target, self._optimiser.init(critic), normaliser, buffer, env, key)

    def update(self, state: QtOptState, batch: Transition) -> QtOptState:
        """One gradient step."""
        search_key, key = jax.random.split(state.key)
        wanted = self.wanted(state, batch, self._draw(search_key))
        _, critic, optimiser = self._descend(
            state.critic, state.normaliser, batch, wanted, optimizer_state=state.optimiser
        )
        target = optax.incremental_update(critic, state.target, self._settings.target_rate)
        return replace(state, critic=critic, target=target, optimiser=optimiser, key=key)

    def wanted(self, state: QtOptState, batch: Transition, normals: jax.Array) -> jax.Array:
        """Values (B,) that the critics are to have."""
        action = self._best(state.target, state.normaliser, batch.next_observation, normals)
        value = self._critics.apply(state.normaliser, state.target, batch.next_observation, action).min(axis=-1)
        return self._settings.reward_scale * batch.reward + self._settings.discount * batch.discount * value

    def _loss(self, critic: Params, normaliser: Params, batch: Transition, wanted: jax.Array) -> jax.Array:
        values = self._critics.apply(normaliser, critic, batch.observation, batch.action)
        return jnp.mean((values - wanted[:, None]) ** 2)

    def _fill(self, state: QtOptState) -> QtOptState:
        steps = -(-self._settings.replay.random_steps // self._settings.replay.environments)
        return jax.lax.fori_loop(0, steps, lambda _, s: self._play(s, self._random), state)

    def _piece(self, state: QtOptState) -> QtOptState:
        return jax.lax.fori_loop(0, PIECE, lambda _, s: self._learn(self._play(s, partial(self._explore, s))), state)

    def _play(self, state: QtOptState, policy: Exploration) -> QtOptState:
        action_key, key = jax.random.split(state.key)
        env, transition = acting.actor_step(self.env, state.env, policy, action_key)
        normaliser = running_statistics.update(state.normaliser, transition.observation)
        buffer = self._queue.insert_internal(state.buffer, transition)
        return replace(state, env=env, normaliser=normaliser, buffer=buffer, key=key)

    def _learn(self, state: QtOptState) -> QtOptState:
        buffer, drawn = self._queue.sample_internal(state.buffer)
        batches = jax.tree.map(lambda x: x.reshape(self._settings.replay.gradient_steps, -1, *x.shape[1:]), drawn)
        return jax.lax.scan(lambda s, batch: (self.update(s, batch), None), replace(state, buffer=buffer), batches)[0]

    def _random(self, observation: jax.Array, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
        return jax.random.uniform(key, (observation.shape[0], self.env.action_size), minval=-1.0), {}

    def _explore(self, state: QtOptState, observation: jax.Array, key: jax.Array) -> tuple[jax.Array, dict[str, Any]]:
        search_key, noise_key, random_key, which_key = jax.random.split(key, 4)
        action = self._best(state.critic, state.normaliser, observation, self._draw(search_key))
        action = jnp.clip(action + self._settings.noise * jax.random.normal(noise_key, action.shape), -1.0, 1.0)
        at_random = jax.random.uniform(which_key, (observation.shape[0], 1)) < self._settings.random_share
        return jnp.where(at_random, self._random(observation, random_key)[0], action), {}

    def _decide(self, parameters: Params, observation: jax.Array) -> jax.Array:
        normaliser, critic = parameters
        return self._best(critic, normaliser, observation, self._normals)

    def _best(self, critic: Params, normaliser: Params, observation: jax.Array, normals: jax.Array) -> jax.Array:
        def value(actions: jax.Array) -> jax.Array:
            shape = (*observation.shape[:-1], actions.shape[-2])
            seen = jnp.broadcast_to(observation[..., None, :], (*shape, observation.shape[-1]))
            actions = jnp.broadcast_to(actions, (*shape, actions.shape[-1]))
            return self._critics.apply(normaliser, critic, seen, actions)[..., 0]

        return best_action(value, normals, self._settings.elites)

    def _draw(self, key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (self._settings.rounds, self._settings.candidates, self.env.action_size))
