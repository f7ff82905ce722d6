"""QT-Opt in its small form (Kalashnikov et al. 2018): no actor, the critic's best action is searched for.

Q(s, a) is fitted to r + gamma min_i Q'_i(s', a'), with a' the action that the cross-entropy method finds for the target
network Q' (clipped double Q). What the original adds for its scale is left out: distributed actors and learners,
stored demonstrations, images, and its second, slower target network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.types import Params, Transition
from flax import linen, struct

from experiments.config.baselines import QtOpt
from mjx_tt.env.brax import OBSERVATION_SIZE
from robot_io.contract import N_JOINTS


class Critics(linen.Module):
    """Two networks on observation and action: (..., size), (..., joints) -> (..., 2).

    The first layer adds a part of the observation to one of the action, so that of many actions in one state (axes of
    length 1 in the observation) the observation is taken in once.
    """

    layers: Sequence[int]

    @linen.compact
    def __call__(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        values = []
        for _ in range(2):
            first = self.layers[0]
            h = linen.relu(linen.Dense(first)(observation) + linen.Dense(first, use_bias=False)(action))
            for width in self.layers[1:]:
                h = linen.relu(linen.Dense(width)(h))
            values.append(linen.Dense(1)(h)[..., 0])
        return jnp.stack(values, axis=-1)


def best_action(value: Callable[[jax.Array], jax.Array], normals: jax.Array, elites: int) -> jax.Array:
    """The action (..., joints) that the cross-entropy method finds for ``value``: (..., n, joints) -> (..., n).

    normals: (rounds, n, joints) standard normal numbers, or (rounds, ..., n, joints). Each round draws n actions, cut
    to [-1, 1], about the mean of the round before with its standard deviation, and keeps the best ``elites``; the last
    mean is the answer. The first round draws about 0 with deviation 1/2.
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
    critic: Params
    target: Params
    optimiser: optax.OptState


class QtOptAgent:
    """The agent of ``off_policy.OffPolicyLearner``."""

    def __init__(self, settings: QtOpt, observation_size: int = OBSERVATION_SIZE, joints: int = N_JOINTS) -> None:
        self._settings, self._critics = settings, Critics(tuple(settings.layers))
        self._size, self._joints = observation_size, joints
        self._optimiser = optax.adam(settings.learning_rate)
        # The same numbers at every decision: the policy is a function of what it sees.
        self._normals = self._draw(jax.random.key(0))

    def init(self, key: jax.Array) -> QtOptState:
        critic = self._critics.init(key, jnp.zeros(self._size), jnp.zeros(self._joints))
        return QtOptState(critic, jax.tree.map(jnp.copy, critic), self._optimiser.init(critic))

    def explore(
        self, agent: QtOptState, normaliser: RunningStatisticsState, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        search_key, noise_key, random_key, which_key = jax.random.split(key, 4)
        batch = observation.shape[:1]
        seen = running_statistics.normalize(observation, normaliser)
        action = self._best(agent.critic, seen, self._draw(search_key))
        action = action + self._settings.noise * jax.random.normal(noise_key, action.shape)
        random = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
        at_random = jax.random.uniform(which_key, batch) < self._settings.random_share
        return jnp.where(at_random[:, None], random, jnp.clip(action, -1.0, 1.0))

    def update(
        self, agent: QtOptState, normaliser: RunningStatisticsState, batch: Transition, key: jax.Array
    ) -> QtOptState:
        settings = self._settings
        following = running_statistics.normalize(batch.next_observation, normaliser)
        action = self._best(agent.target, following, self._draw(key))
        value = self._values(agent.target, following, action).min(axis=-1)
        wanted = settings.reward_scale * batch.reward + settings.discount * batch.discount * value
        seen = running_statistics.normalize(batch.observation, normaliser)

        def loss(critic: Params) -> jax.Array:
            return jnp.mean((self._values(critic, seen, batch.action) - wanted[:, None]) ** 2)

        change, optimiser = self._optimiser.update(jax.grad(loss)(agent.critic), agent.optimiser)
        critic = optax.apply_updates(agent.critic, change)
        return QtOptState(critic, optax.incremental_update(critic, agent.target, settings.target_rate), optimiser)

    def parameters(self, agent: QtOptState) -> Params:
        return agent.critic

    def decide(self, parameters: tuple[RunningStatisticsState, Params], observation: jax.Array) -> jax.Array:
        normaliser, critic = parameters
        return self._best(critic, running_statistics.normalize(observation, normaliser), self._normals)

    def _best(self, critic: Params, seen: jax.Array, normals: jax.Array) -> jax.Array:
        """``seen``: normalised observations (..., size)."""
        state = seen[..., None, :]
        return best_action(lambda a: self._values(critic, state, a)[..., 0], normals, self._settings.elites)

    def _values(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Both networks' values (..., 2) under the parameters ``critic``."""
        # Of flax's two kinds of result, the one with changed variables comes only when ``mutable`` is given.
        return cast(jax.Array, self._critics.apply(critic, observation, action))

    def _draw(self, key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (self._settings.rounds, self._settings.candidates, self._joints))
