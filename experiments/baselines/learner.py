"""The interface of an algorithm to the comparison, and the common parts of learners with networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training.acme import running_statistics, specs
from brax.training.acme.running_statistics import RunningStatisticsState
from brax.training.types import Params, Policy, Transition
from jax.typing import ArrayLike

from mjx_tt.env.brax import OBSERVATION_SIZE, TableTennis, flatten
from mjx_tt.env.episode import Controller, Tick
from robot_io.contract import HISTORY

# Sums over the episodes that ended within a call of ``advance``, scalars on the device; "steps": control steps.
MEASURED = ("episodes", "steps", "hit", "returned", "episode_return")
Measured = dict[str, ArrayLike]

S = TypeVar("S")  # everything that learning changes, a pytree
Advance = Callable[[S], tuple[S, Measured]]  # a piece of learning: from a state, which it may consume, to the next one
Decide = Callable[[Params, jax.Array], jax.Array]  # (parameters, (..., size)) -> (..., joints) in [-1, 1]


class Learner(Protocol[S]):
    """One algorithm on one task."""

    def init(self, key: jax.Array) -> S:
        """Everything that learning changes, a pytree."""

    def compiled(self, state: S) -> Advance[S]:
        """A piece of learning, ready to run: from a state, which it may consume, to the next one and ``MEASURED``."""

    def controller(self, state: S) -> Controller:
        """The policy learned so far, without exploration."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkController:
    """A network on the history of observations as a ``task.Controller``."""

    parameters: Params
    mean: jax.Array  # (observed,) of the newest observation in the normaliser
    decide: Decide = field(metadata={"static": True})

    def start(self, observation: jax.Array) -> jax.Array:
        return jnp.broadcast_to(observation, (HISTORY, *observation.shape))

    def act(self, tick: Tick, history: jax.Array, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        history = jnp.concatenate([history[1:], observation[None]])
        return jnp.moveaxis(self.decide(self.parameters, flatten(history)), -1, 0), history


def network_controller(parameters: Params, normaliser: RunningStatisticsState, decide: Decide) -> NetworkController:
    """``normaliser``: brax's running statistics of the histories."""
    newest = normaliser.mean.shape[0] // HISTORY
    return NetworkController(parameters, normaliser.mean[-newest:], decide)


def empty_normaliser(size: int = OBSERVATION_SIZE) -> RunningStatisticsState:
    """Brax's running statistics of histories (size,), before the first."""
    return running_statistics.init_state(specs.Array((size,), jnp.dtype("float32")))


def compiled(advance: Advance[S], state: S) -> Advance[S]:
    """``advance`` compiled for ``state``, whose memory it takes over."""
    return jax.jit(advance, donate_argnums=0).lower(state).compile()


def play(
    env: TableTennis, state: State, policy: Policy, key: jax.Array
) -> tuple[State, Transition, dict[str, jax.Array]]:
    """One step of all environments; ``policy``: (observation, key) -> (action, extras). Also what it measured."""
    action, extras = policy(state.obs, key)
    after = env.step(state, action)
    transition = Transition(
        observation=state.obs,
        action=action,
        reward=after.reward,
        discount=1.0 - after.done,
        next_observation=after.obs,
        extras={"policy_extras": extras, "state_extras": {"truncation": after.info["truncation"]}},
    )
    steps = jnp.float32(after.done.shape[0])
    measured = {"episodes": after.done.sum(), "steps": steps} | {k: v.sum() for k, v in after.metrics.items()}
    return after, transition, measured


def summed(measured: dict[str, jax.Array]) -> Measured:
    """Measurements stacked along axis 0, added up."""
    return {name: value.sum(axis=0) for name, value in measured.items()}
