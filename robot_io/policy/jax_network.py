"""A user's network for the control loop, compiled by JAX, and its export. On the robot the user's Python is not run."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from robot_io import contract
from robot_io.policy.own_network import ExportedNetwork
from robot_io.policy.policy import Policy

_FRAMES = "jax_traceback_in_locations_limit"


class ExportedPolicy:
    """Fed one observation (11,) per tick, like ``numpy_policy.StreamingPolicy``; computed by the CPU."""

    def __init__(self, policy: Policy) -> None:
        jax.config.update("jax_cpu_enable_async_dispatch", False)  # answers come from the calling thread at once
        self._call, self._empty_state = _compiled(policy.network)
        cpu = jax.local_devices(backend="cpu")[0]
        exact = policy.astype(np.float32)
        self._arrays = jax.device_put((exact.theta, exact.mean, exact.inv_std), cpu)
        self._state, self._first = self._empty_state, True
        self.step(np.zeros(policy.n_observation))  # compiles
        self.reset()

    def reset(self) -> None:
        """Forgets everything: the next observation begins an episode."""
        self._state, self._first = self._empty_state, True

    def step(self, observation: np.ndarray) -> np.ndarray:
        """Action (8,) in [-1, 1]. Raises ValueError for another shape or a non-finite number."""
        observation = np.asarray(observation, np.float32)
        size = self._arrays[1].shape[0]
        if observation.shape != (size,) or not np.isfinite(observation).all():
            raise ValueError(f"observation {observation}: {size} finite numbers are needed")
        action, self._state = self._call(*self._arrays, np.bool_(self._first), self._state, observation)
        self._first = False
        return np.asarray(action)

    def episode(self, observations: np.ndarray) -> np.ndarray:
        """Actions (T, 8) for the observations (T, 11) of one episode."""
        self.reset()
        return np.stack([self.step(observation) for observation in observations])


@lru_cache(maxsize=8)
def _compiled(network: ExportedNetwork) -> tuple[Any, tuple[np.ndarray, ...]]:
    """The step, compiled once for all parameters, and a state to begin with."""
    exported = jax.export.deserialize(bytearray(network.exported))
    (*_, state, _), _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    return jax.jit(exported.call), tuple(np.zeros(leaf.shape, leaf.dtype) for leaf in state)


def exported(network: Any, n_observation: int = contract.N_OBSERVATION) -> ExportedNetwork:
    """The robot's form of a network as ``mjx_tt.env.network`` defines it; one that has this form already as it is."""
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
    """A function as ``jax.export`` writes it for the CPU, without the places in source files that it was traced from.

    A policy is passed on; the folders of the machine that exported it are nobody's business. shapes: of its arguments.
    """

    def anew(*arguments: Any) -> Any:  # of a function that was compiled before, JAX keeps the places
        return function(*arguments)

    frames = getattr(jax.config, _FRAMES)
    jax.config.update(_FRAMES, 0)
    try:
        return bytes(jax.export.export(jax.jit(anew), platforms=["cpu"])(*shapes).serialize())
    finally:
        jax.config.update(_FRAMES, frames)


def reference(network: Any, policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Actions (T, 8) for one episode's observations (T, 11), by the user's Python itself, tick by tick.

    Of a network that has only its exported form left, as after fine-tuning, by that.
    """
    if isinstance(network, ExportedNetwork):
        return ExportedPolicy(policy).episode(observations)
    parameters = jax.tree.map(jnp.asarray, network.unflatten(np.asarray(policy.theta, np.float32)))
    rows = (observations - policy.mean) * policy.inv_std
    state, actions = network.start(parameters, jnp.asarray(rows[0])), []
    for row in rows:
        action, state = network.step(parameters, state, jnp.asarray(row))
        actions.append(np.clip(np.asarray(action), -1.0, 1.0))
    return np.stack(actions)
