"""Soft actor-critic (Haarnoja et al. 2018) with brax's networks and losses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from brax.training import gradients
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.agents.sac import losses, networks
from brax.training.types import Params, Transition
from flax import struct

from experiments.config.baselines import Sac
from mjx_tt.env.brax import OBSERVATION_SIZE
from robot_io.contract import N_JOINTS


@struct.dataclass
class SacState:
    policy: Params
    critic: Params
    target: Params
    log_alpha: jax.Array  # () of the entropy's weight
    optimisers: tuple[optax.OptState, optax.OptState, optax.OptState]  # of policy, critic, log_alpha


class SacAgent:
    """The agent of ``off_policy.OffPolicyLearner``."""

    def __init__(self, settings: Sac, observation_size: int = OBSERVATION_SIZE, joints: int = N_JOINTS) -> None:
        self._settings = settings
        self._networks = networks.make_sac_networks(
            observation_size, joints, running_statistics.normalize, hidden_layer_sizes=tuple(settings.layers)
        )
        self._make_policy = networks.make_inference_fn(self._networks)
        self._optimiser = optax.adam(settings.learning_rate)
        three = losses.make_losses(self._networks, settings.reward_scale, settings.discount, joints)
        self._alpha_step, self._critic_step, self._actor_step = (
            gradients.gradient_update_fn(loss, self._optimiser, pmap_axis_name=None) for loss in three
        )

    def init(self, key: jax.Array) -> SacState:
        policy_key, critic_key = jax.random.split(key)
        policy, critic = self._networks.policy_network.init(policy_key), self._networks.q_network.init(critic_key)
        log_alpha = jnp.log(jnp.float32(self._settings.first_entropy_weight))
        optimisers = tuple(self._optimiser.init(part) for part in (policy, critic, log_alpha))
        # Copies: a state that is given away whole must not hold the same array twice.
        return SacState(policy, critic, jax.tree.map(jnp.copy, critic), log_alpha, optimisers)

    def explore(
        self, agent: SacState, normaliser: RunningStatisticsState, observation: jax.Array, key: jax.Array
    ) -> jax.Array:
        return self._make_policy((normaliser, agent.policy))(observation, key)[0]

    def update(
        self, agent: SacState, normaliser: RunningStatisticsState, batch: Transition, key: jax.Array
    ) -> SacState:
        alpha_key, critic_key, actor_key = jax.random.split(key, 3)
        for_policy, for_critic, for_alpha = agent.optimisers
        alpha = jnp.exp(agent.log_alpha)
        _, log_alpha, for_alpha = self._alpha_step(
            agent.log_alpha, agent.policy, normaliser, batch, alpha_key, optimizer_state=for_alpha
        )
        _, critic, for_critic = self._critic_step(
            agent.critic, agent.policy, normaliser, agent.target, alpha, batch, critic_key, optimizer_state=for_critic
        )
        _, policy, for_policy = self._actor_step(
            agent.policy, normaliser, agent.critic, alpha, batch, actor_key, optimizer_state=for_policy
        )
        target = optax.incremental_update(critic, agent.target, self._settings.target_rate)
        return SacState(policy, critic, target, log_alpha, (for_policy, for_critic, for_alpha))

    def parameters(self, agent: SacState) -> Params:
        return agent.policy

    def decide(self, parameters: tuple[RunningStatisticsState, Params], observation: jax.Array) -> jax.Array:
        return self._make_policy(parameters, deterministic=True)(observation, None)[0]
