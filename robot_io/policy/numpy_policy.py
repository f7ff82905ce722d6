"""The policy in NumPy for the control loop: one observation in, one action out, in float64."""

from __future__ import annotations

from collections import deque

import numpy as np

from robot_io import contract
from robot_io.policy.policy import Policy, gate


class StreamingPolicy:
    """A policy fed one observation per control tick, remembering what it already computed.

    Each layer keeps as many of its past inputs as its dilation: one observation, two outputs of layer 1, four of
    layer 2. Equal to ``Policy.apply`` over the last eight observations, the first since ``reset`` filling the history.
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
        self._past: list[deque[np.ndarray]] = []
        self.reset()

    def reset(self) -> None:
        """Forgets everything: the next observation begins an episode."""
        self._past = [deque(maxlen=dilation) for dilation in contract.DILATIONS]

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
        layers = zip(contract.DILATIONS, self._past, self._weights, self._biases, contract.GATED, strict=True)
        for dilation, past, weights, bias, gated in layers:
            if not past:  # a constant history gives every layer a constant input
                past.extend([x] * dilation)
            pre_activation = weights @ np.concatenate((past[0], x)) + bias
            past.append(x)
            x = gate(pre_activation, axis=0) if gated else np.tanh(pre_activation)
        return x
