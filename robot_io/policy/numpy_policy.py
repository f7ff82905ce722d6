"""The policy in NumPy for the control loop: one observation in, one action out, in float64."""

from __future__ import annotations

import numpy as np

from robot_io import contract
from robot_io.policy.policy import LoopPolicy, Past, Policy, gate, start, step


class StreamingPolicy(LoopPolicy):
    """The paper's network, remembering what it already computed.

    Equal to ``Policy.apply`` over the last eight observations, the first since ``reset`` filling the history.
    """

    dtype = np.float64

    def __init__(self, policy: Policy, robot: contract.Contract = contract.PAPER) -> None:
        super().__init__(policy, robot)
        exact = policy.astype(np.float64)
        self._mean, self._inv_std = exact.mean, exact.inv_std
        kernels, biases = ([exact.parameters[f"conv{i}/{part}"] for i in (1, 2, 3)] for part in ("kernel", "bias"))
        # Both taps as one matrix (outputs, 2 * inputs): one product a layer and tick.
        self._weights = [kernel.reshape(-1, kernel.shape[-1]).T.copy() for kernel in kernels]
        self._biases = biases
        self._past: Past = ()

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        x = (observation - self._mean) * self._inv_std
        action, self._past = step(self._layer, start(self._layer, x) if first else self._past, x)
        return action

    def _layer(self, i: int, older: np.ndarray, newer: np.ndarray) -> np.ndarray:
        z = self._weights[i] @ np.concatenate((older, newer)) + self._biases[i]
        return gate(z, axis=0) if contract.GATED[i] else np.tanh(z)
