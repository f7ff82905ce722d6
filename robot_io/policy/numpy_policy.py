"""The policy in NumPy for the control loop: one observation in, one action out, in float64."""

from __future__ import annotations

import numpy as np

from robot_io import contract
from robot_io.policy.policy import Past, Policy, gate, start, step


class StreamingPolicy:
    """A policy fed one observation per control tick, remembering what it already computed.

    Equal to ``Policy.apply`` over the last eight observations, the first since ``reset`` filling the history.
    """

    def __init__(self, policy: Policy, robot: contract.Contract = contract.PAPER) -> None:
        """``robot``: whose contract the policy was trained for. Raises ValueError where it has other joints."""
        if policy.n_observation != robot.n_observation:
            raise ValueError(
                f"the policy has observations of {policy.n_observation} numbers, those of {robot.robot} have "
                f"{robot.n_observation}"
            )
        self._names = robot.observation_names
        exact = policy.astype(np.float64)
        parameters = exact.parameters
        self._mean, self._inv_std = exact.mean, exact.inv_std
        # Both taps as one matrix (outputs, 2 * inputs): one product a layer and tick.
        self._weights = [
            parameters[f"conv{i}/kernel"].reshape(-1, len(parameters[f"conv{i}/bias"])).T.copy()
            for i, _ in enumerate(contract.DILATIONS, start=1)
        ]
        self._biases = [parameters[f"conv{i}/bias"] for i, _ in enumerate(contract.DILATIONS, start=1)]
        self._past: Past | None = None

    def reset(self) -> None:
        """Forgets everything: the next observation begins an episode."""
        self._past = None

    def step(self, observation: np.ndarray) -> np.ndarray:
        """Action (8,) for the newest observation (11,).

        Raises ValueError for another shape or a non-finite number, and then remembers nothing of it.
        """
        observation = np.asarray(observation, np.float64)
        if observation.shape != self._mean.shape:
            raise ValueError(f"observation has shape {observation.shape}, wanted {self._mean.shape}")
        if not np.isfinite(observation).all():
            bad = [n for n, v in zip(self._names, observation, strict=True) if not np.isfinite(v)]
            raise ValueError(f"observation has a non-finite {', '.join(bad)}")
        x = (observation - self._mean) * self._inv_std
        past = start(self._layer, x) if self._past is None else self._past
        action, self._past = step(self._layer, past, x)
        return action

    def _layer(self, i: int, older: np.ndarray, newer: np.ndarray) -> np.ndarray:
        z = self._weights[i] @ np.concatenate((older, newer)) + self._biases[i]
        return gate(z, axis=0) if contract.GATED[i] else np.tanh(z)
