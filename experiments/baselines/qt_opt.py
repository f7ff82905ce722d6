"""QT-Opt in its small form (Kalashnikov et al. 2018): no actor, the critic's best action is searched for.

Q(s, a) is fitted to r + gamma min_i Q'_i(s', a'), with a' the action that the cross-entropy method finds for the target
network Q' (clipped double Q). What the original adds for its scale is left out: distributed actors and learners,
stored demonstrations, images, and its second, slower target network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from flax import linen, struct

from experiments.config.baselines import QtOpt
from mjx_tt.env.brax import OBSERVATION_SIZE
from robot_io.contract import N_JOINTS


class Critics(linen.Module):
    """Two networks on observation and action: (..., 88), (..., 8) -> (..., 2).

    The first layer adds a part of the observation to one of the action, so that of many actions in one state (axes of
    length 1 in the observation) the observation is taken in once.
    """

    layers: Sequence[int]

    @linen.compact
    def __call__(self, observation, action):
        values = []
        for _ in range(2):
            first = self.layers[0]
            h = linen.relu(linen.Dense(first)(observation) + linen.Dense(first, use_bias=False)(action))
            for width in self.layers[1:]:
                h = linen.relu(linen.Dense(width)(h))
            values.append(linen.Dense(1)(h)[..., 0])
        return jnp.stack(values, axis=-1)


def best_action(value, normals, elites: int):
    """The action (..., 8) that the cross-entropy method finds for ``value``: (..., n, 8) -> (..., n).

    normals: (rounds, n, 8) standard normal numbers, or (rounds, ..., n, 8). Each round draws n actions, cut to [-1, 1],
    about the mean of the round before with its standard deviation, and keeps the best ``elites``; the last mean is the
    answer. The first round draws about 0 with deviation 1/2.
    """
    mean, std = jnp.zeros(N_JOINTS), jnp.full(N_JOINTS, 0.5)
    for z in normals:
        actions = jnp.clip(mean + std * z, -1.0, 1.0)
        values = value(actions)
        actions = jnp.broadcast_to(actions, (*values.shape, N_JOINTS))
        best = jax.lax.top_k(values, elites)[1]
        chosen = jnp.take_along_axis(actions, best[..., None], axis=-2)
        mean, std = chosen.mean(axis=-2, keepdims=True), chosen.std(axis=-2, keepdims=True)
    return mean[..., 0, :]


@struct.dataclass
class QtOptState:
    critic: Any
    target: Any
    optimiser: Any


class QtOptAgent:
    """The agent of ``off_policy.OffPolicyLearner``."""

    def __init__(self, settings: QtOpt) -> None:
        self._settings, self._critics = settings, Critics(tuple(settings.layers))
        self._optimiser = optax.adam(settings.learning_rate)
        # The same numbers at every decision: the policy is a function of what it sees.
        self._normals = self._draw(jax.random.key(0))

    def init(self, key) -> QtOptState:
        critic = self._critics.init(key, jnp.zeros(OBSERVATION_SIZE), jnp.zeros(N_JOINTS))
        return QtOptState(critic, jax.tree.map(jnp.copy, critic), self._optimiser.init(critic))

    def explore(self, agent: QtOptState, normaliser, observation, key):
        search_key, noise_key, random_key, which_key = jax.random.split(key, 4)
        batch = observation.shape[:1]
        seen = running_statistics.normalize(observation, normaliser)
        action = self._best(agent.critic, seen, self._draw(search_key))
        action = action + self._settings.noise * jax.random.normal(noise_key, action.shape)
        random = jax.random.uniform(random_key, action.shape, minval=-1.0, maxval=1.0)
        at_random = jax.random.uniform(which_key, batch) < self._settings.random_share
        return jnp.where(at_random[:, None], random, jnp.clip(action, -1.0, 1.0))

    def update(self, agent: QtOptState, normaliser, batch, key) -> QtOptState:
        settings = self._settings
        following = running_statistics.normalize(batch.next_observation, normaliser)
        action = self._best(agent.target, following, self._draw(key))
        value = self._critics.apply(agent.target, following, action).min(axis=-1)
        wanted = settings.reward_scale * batch.reward + settings.discount * batch.discount * value
        seen = running_statistics.normalize(batch.observation, normaliser)

        def loss(critic):
            return jnp.mean((self._critics.apply(critic, seen, batch.action) - wanted[:, None]) ** 2)

        change, optimiser = self._optimiser.update(jax.grad(loss)(agent.critic), agent.optimiser)
        critic = optax.apply_updates(agent.critic, change)
        return QtOptState(critic, optax.incremental_update(critic, agent.target, settings.target_rate), optimiser)

    def parameters(self, agent: QtOptState):
        return agent.critic

    def decide(self, parameters, observation):
        normaliser, critic = parameters
        return self._best(critic, running_statistics.normalize(observation, normaliser), self._normals)

    def _best(self, critic, seen, normals):
        """``seen``: normalised observations (..., 88)."""
        state = seen[..., None, :]
        return best_action(lambda a: self._critics.apply(critic, state, a)[..., 0], normals, self._settings.elites)

    def _draw(self, key):
        return jax.random.normal(key, (self._settings.rounds, self._settings.candidates, N_JOINTS))
