"""Policies computed by JAX: compiled for the control loop, and a user-defined network's export.

``Policy`` is a JAX pytree once this module is imported. On the robot a user's Python is not run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from robot_io import contract
from robot_io.policy.policy import ExportedNetwork, LoopPolicy, forward
from robot_io.policy.policy import Policy as Policy

jax.tree_util.register_dataclass(Policy, data_fields=["theta", "mean", "inv_std"], meta_fields=["network"])

PLATFORMS = ("cpu", "cuda", "tpu")  # on which an export runs
_FRAMES = "jax_traceback_in_locations_limit"


def exact_forward(policy: Policy, history: Any) -> jax.Array:
    """Histories (8, 11, B) to actions (8, B), not in an accelerator's short format."""
    with jax.default_matmul_precision("highest"):
        return forward(policy, history, xp=jnp)


# One compiled function for all policies: parameters are arguments, so another policy does not compile again.
jitted_forward = jax.jit(exact_forward)


class _JaxPolicy(LoopPolicy):
    """Computed by the CPU, which answers soonest.

    Answers come from the calling thread at once, not from a queue: a fifth of the latency.
    """

    def __init__(self, policy: Policy, robot: contract.Contract = contract.PAPER) -> None:
        super().__init__(policy, robot)
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        self._cpu_policy = jax.device_put(policy.astype(np.float32), jax.local_devices(backend="cpu")[0])
        self.step(np.zeros(policy.n_observation))  # compiles
        self.reset()


class JitPolicy(_JaxPolicy):
    """The paper's network: the same numbers as ``numpy_policy.StreamingPolicy``.

    It computes the whole history at every tick: on one column that costs less than a second call would.
    """

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        if first:
            self._history = np.tile(observation[:, None], (contract.HISTORY, 1, 1))
        else:
            self._history[:-1] = self._history[1:]
            self._history[-1, :, 0] = observation
        return np.asarray(jitted_forward(self._cpu_policy, self._history))[:, 0]


class ExportedPolicy(_JaxPolicy):
    """A user-defined network."""

    def __init__(self, policy: Policy, robot: contract.Contract = contract.PAPER) -> None:
        self._call, self._state = _compiled(policy.network)
        super().__init__(policy, robot)

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        policy = self._cpu_policy
        arrays = policy.theta, policy.mean, policy.inv_std
        action, self._state = self._call(*arrays, np.bool_(first), self._state, observation)
        return np.asarray(action)


@lru_cache(maxsize=8)
def _compiled(network: ExportedNetwork) -> tuple[Any, tuple[np.ndarray, ...]]:
    """The step, compiled once for all parameters, and a state to begin with."""
    exported = jax.export.deserialize(bytearray(network.exported))
    (*_, state, _), _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    return jax.jit(exported.call), tuple(np.zeros(leaf.shape, leaf.dtype) for leaf in state)


def exported(network: Any, n_observation: int = contract.N_OBSERVATION) -> ExportedNetwork:
    """The robot's form of a network as the simulator has it; one that has this form already as it is."""
    if isinstance(network, ExportedNetwork):
        return network

    def number(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    def first_state(theta: Any, x: Any) -> Any:
        return jax.tree.map(jnp.asarray, network.start(network.unflatten(theta), x))

    x = number(n_observation)
    state = jax.eval_shape(first_state, number(network.size), x)
    tree = jax.tree.structure(state)

    def step(theta: Any, mean: Any, inv_std: Any, first: Any, leaves: tuple, observation: Any) -> tuple:
        with jax.default_matmul_precision("highest"):
            normalised = (observation - mean) * inv_std
            fresh = jax.tree.leaves(first_state(theta, normalised))
            before = [jnp.where(first, new, old) for new, old in zip(fresh, leaves, strict=True)]
            action, after = network.step(network.unflatten(theta), jax.tree.unflatten(tree, before), normalised)
            return jnp.clip(jnp.asarray(action), -1.0, 1.0), tuple(map(jnp.asarray, jax.tree.leaves(after)))

    arguments = [number(network.size), x, x, jax.ShapeDtypeStruct((), bool), tuple(jax.tree.leaves(state)), x]
    content = serialised(step, *arguments)
    return ExportedNetwork(network.name, tuple(network.shapes.items()), content, network.source)


def serialised(function: Callable[..., Any], *shapes: Any) -> bytes:
    """A function as ``jax.export`` writes it for ``PLATFORMS``, without the source places that it was traced from.

    A policy is passed on; the folders of the machine that exported it are nobody's business. shapes: of its arguments.
    """

    def anew(*arguments: Any) -> Any:  # of a function that was compiled before, JAX keeps the places
        return function(*arguments)

    frames = getattr(jax.config, _FRAMES)
    jax.config.update(_FRAMES, 0)
    try:
        return bytes(jax.export.export(jax.jit(anew), platforms=PLATFORMS)(*shapes).serialize())
    finally:
        jax.config.update(_FRAMES, frames)


def reference(network: Any, policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Actions (T, 8) for one episode's observations (T, 11), by the user's Python itself, tick by tick."""
    parameters = jax.tree.map(jnp.asarray, network.unflatten(np.asarray(policy.theta, np.float32)))
    rows = (observations - policy.mean) * policy.inv_std
    state, actions = network.start(parameters, jnp.asarray(rows[0])), []
    for row in rows:
        action, state = network.step(parameters, state, jnp.asarray(row))
        actions.append(np.clip(np.asarray(action), -1.0, 1.0))
    return np.stack(actions)
