"""The policy compiled by JAX, for the control loop: the same numbers as ``numpy_policy.StreamingPolicy``.

It computes the whole history at every tick: on one column that costs
less than a second call would.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from robot_io import contract
from robot_io.policy.policy import forward
from robot_io.policy.pytree import Policy

# One compiled function for all policies: parameters are arguments, so another policy does not compile again.
_forward = jax.jit(partial(forward, xp=jnp))


class JitPolicy:
    """Fed one observation (11,) per tick; computed by the CPU, which answers soonest."""

    def __init__(self, policy: Policy) -> None:
        # Answers come from the calling thread at once, not from a queue: a fifth of the latency.
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        cpu = jax.local_devices(backend="cpu")[0]
        self._policy = jax.device_put(policy.astype(np.float32), cpu)  # once, not at every tick
        self._history = np.zeros((contract.HISTORY, policy.n_observation, 1), np.float32)
        self._empty = True
        self.step(np.zeros(policy.n_observation))  # compiles
        self.reset()

    def reset(self) -> None:
        self._empty = True

    def step(self, observation: np.ndarray) -> np.ndarray:
        """Action (8,). Raises ValueError for another shape or a non-finite number."""
        observation = np.asarray(observation, np.float32)
        size = self._history.shape[1]
        if observation.shape != (size,) or not np.isfinite(observation).all():
            raise ValueError(f"observation {observation}: {size} finite numbers are needed")
        if self._empty:
            self._history[:, :, 0] = observation
            self._empty = False
        else:
            self._history[:-1] = self._history[1:]
            self._history[-1, :, 0] = observation
        return np.asarray(_forward(self._policy, self._history))[:, 0]
