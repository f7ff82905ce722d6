"""What the comparison asks of an algorithm, and what learners with networks have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from brax.envs.base import State
from brax.training.acme import running_statistics, specs
from brax.training.types import Transition

from mjx_tt.env.brax import OBSERVATION_SIZE, TableTennis, flatten
from mjx_tt.env.task import Controller
from robot_io.contract import HISTORY, N_OBSERVATION

# Sums over the episodes that ended within a call of ``advance``, scalars on the device; "steps": control steps.
MEASURED = ("episodes", "steps", "hit", "returned", "episode_return")


class Learner(Protocol):
    """One algorithm on one task."""

    def init(self, key) -> Any:
        """Everything that learning changes, a pytree."""

    def compiled(self, state) -> Callable[[Any], tuple[Any, dict[str, jax.Array]]]:
        """A piece of learning, ready to run: from a state, which it may consume, to the next one and ``MEASURED``."""

    def controller(self, state) -> Controller:
        """The policy learned so far, without exploration."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkController:
    """A network on the history of observations as a ``task.Controller``."""

    parameters: Any
    mean: jax.Array  # (11,) of the newest observation in the normaliser
    decide: Callable = field(metadata={"static": True})  # (parameters, (..., 88)) -> (..., 8) in [-1, 1]

    def start(self, observation):
        return jnp.broadcast_to(observation, (HISTORY, *observation.shape))

    def act(self, tick, history, observation):
        history = jnp.concatenate([history[1:], observation[None]])
        return jnp.moveaxis(self.decide(self.parameters, flatten(history)), -1, 0), history


def network_controller(parameters, normaliser, decide) -> NetworkController:
    """``normaliser``: brax's running statistics of the histories."""
    return NetworkController(parameters, normaliser.mean[-N_OBSERVATION:], decide)


def empty_normaliser():
    """Brax's running statistics of histories (88,), before the first."""
    return running_statistics.init_state(specs.Array((OBSERVATION_SIZE,), jnp.dtype("float32")))


def compiled(advance, state):
    """``advance`` compiled for ``state``, whose memory it takes over."""
    return jax.jit(advance, donate_argnums=0).lower(state).compile()


def play(env: TableTennis, state: State, policy, key) -> tuple[State, Transition, dict[str, jax.Array]]:
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


def summed(measured: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Measurements stacked along axis 0, added up."""
    return {name: value.sum(axis=0) for name, value in measured.items()}
