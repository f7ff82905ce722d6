"""Proximal policy optimisation (Schulman et al. 2017) with brax's networks, loss and normaliser.

Brax's own training loop is not used: it neither counts episodes nor hands out the policy at chosen moments of training.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import State
from brax.training import gradients
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.ppo import losses, networks
from brax.training.types import Params, Transition
from flax import struct

from experiments.baselines import learner
from experiments.baselines.learner import Advance, Learner, Measured, NetworkController
from experiments.config.baselines import Ppo
from mjx_tt.env.brax import TableTennis

Learned = tuple[losses.PPONetworkParams, optax.OptState]  # of a scan


@struct.dataclass
class PpoState:
    parameters: losses.PPONetworkParams
    optimiser: optax.OptState
    normaliser: RunningStatisticsState
    env: State
    key: jax.Array


class PpoLearner(Learner[PpoState]):
    """One call of ``compiled`` plays ``unroll`` steps in every environment and learns from them ``epochs`` times."""

    def __init__(self, settings: Ppo, env: TableTennis) -> None:
        self._settings, self._env = settings, env
        self._networks = networks.make_ppo_networks(
            env.observation_size,
            env.action_size,
            running_statistics.normalize,
            policy_hidden_layer_sizes=tuple(settings.policy_layers),
            value_hidden_layer_sizes=tuple(settings.value_layers),
        )
        self._make_policy = networks.make_inference_fn(self._networks)
        self._optimiser = optax.chain(
            optax.clip_by_global_norm(settings.max_gradient_norm), optax.adam(settings.learning_rate)
        )
        loss = partial(
            losses.compute_ppo_loss,
            ppo_network=self._networks,
            entropy_cost=settings.entropy_cost,
            discounting=settings.discount,
            reward_scaling=settings.reward_scale,
            gae_lambda=settings.gae_lambda,
            clipping_epsilon=settings.clip,
        )
        self._descend = gradients.gradient_update_fn(loss, self._optimiser, pmap_axis_name=None, has_aux=True)

    def init(self, key: jax.Array) -> PpoState:
        policy_key, value_key, env_key, key = jax.random.split(key, 4)
        parameters = losses.PPONetworkParams(
            self._networks.policy_network.init(policy_key), self._networks.value_network.init(value_key)
        )
        env = jax.jit(self._env.reset)(jax.random.split(env_key, self._settings.environments))
        normaliser = learner.empty_normaliser(self._env.observation_size)
        return PpoState(parameters, self._optimiser.init(parameters), normaliser, env, key)

    def compiled(self, state: PpoState) -> Advance[PpoState]:
        return learner.compiled(self._advance, state)

    def controller(self, state: PpoState) -> NetworkController:
        parameters = (state.normaliser, state.parameters.policy)
        return learner.network_controller(parameters, state.normaliser, self._decide)

    def _decide(self, parameters: tuple[RunningStatisticsState, Params], observation: jax.Array) -> jax.Array:
        return self._make_policy(parameters, deterministic=True)(observation, None)[0]

    def _advance(self, state: PpoState) -> tuple[PpoState, Measured]:
        play_key, learn_key, key = jax.random.split(state.key, 3)
        policy = self._make_policy((state.normaliser, state.parameters.policy))

        def play(env: State, key: jax.Array) -> tuple[State, tuple[Transition, dict[str, jax.Array]]]:
            env, transition, measured = learner.play(self._env, env, policy, key)
            return env, (transition, measured)

        env, (data, measured) = jax.lax.scan(play, state.env, jax.random.split(play_key, self._settings.unroll))
        normaliser = running_statistics.update(state.normaliser, data.observation)
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)  # (environments, unroll, ...), as the loss wants it
        keys = jax.random.split(learn_key, self._settings.epochs)
        learn = partial(self._epoch, normaliser=normaliser, data=data)
        (parameters, optimiser), _ = jax.lax.scan(learn, (state.parameters, state.optimiser), keys)
        return PpoState(parameters, optimiser, normaliser, env, key), learner.summed(measured)

    def _epoch(
        self, carry: Learned, key: jax.Array, normaliser: RunningStatisticsState, data: Transition
    ) -> tuple[Learned, None]:
        order_key, loss_key = jax.random.split(key)
        parts = self._settings.minibatches
        order = jax.random.permutation(order_key, self._settings.environments).reshape(parts, -1)

        def descend(carry: Learned, chosen: tuple[jax.Array, jax.Array]) -> tuple[Learned, None]:
            parameters, optimiser = carry
            index, key = chosen
            batch = jax.tree.map(lambda x: x[index], data)
            _, parameters, optimiser = self._descend(parameters, normaliser, batch, key, optimizer_state=optimiser)
            return (parameters, optimiser), None

        return jax.lax.scan(descend, carry, (order, jax.random.split(loss_key, parts)))
