"""The policy compiled by JAX, for the control loop: the same numbers as ``policy_numpy.StreamingPolicy``.

The only module besides ``export`` that needs JAX. It computes the whole history at every tick: on one column that costs
less than a second call would.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax
import numpy as np

from robot_io import contract
from robot_io.policy.export import forward_jax


class JitPolicy:
    """Fed one observation (11,) per tick. Parameters are arguments, so that another policy does not compile again."""

    def __init__(
        self, parameters: Mapping[str, np.ndarray], normaliser_mean: np.ndarray, normaliser_inverse_scale: np.ndarray
    ) -> None:
        # Answers come from the calling thread at once, not from a queue: a fifth of the latency.
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        arguments = (dict(parameters), normaliser_mean, normaliser_inverse_scale)
        # On the device once, not at every tick.
        self._arguments = jax.device_put(jax.tree.map(lambda x: np.asarray(x, np.float32), arguments))
        self._forward = jax.jit(forward_jax)
        self._history = np.zeros((contract.HISTORY, contract.N_OBSERVATION, 1), np.float32)
        self._empty = True
        self.step(np.zeros(contract.N_OBSERVATION))  # compiles
        self.reset()

    def reset(self) -> None:
        self._empty = True

    def step(self, observation: np.ndarray) -> np.ndarray:
        """Action (8,). Raises ValueError for another shape or a non-finite number."""
        observation = np.asarray(observation, np.float32)
        if observation.shape != (contract.N_OBSERVATION,) or not np.isfinite(observation).all():
            raise ValueError(f"observation {observation}: {contract.N_OBSERVATION} finite numbers are needed")
        if self._empty:
            self._history[:, :, 0] = observation
            self._empty = False
        else:
            self._history[:-1] = self._history[1:]
            self._history[-1, :, 0] = observation
        return np.asarray(self._forward(*self._arguments, self._history))[:, 0]
