"""The 976-parameter policy in NumPy: the reference that every other implementation is compared with.

Both forms compute in float64 whatever the parameters' precision, so the reference adds no rounding of its own. Layer
formulas and the order of the parameters: ``robot_io.contract`` (paper, appendix E).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from robot_io import contract


def forward(
    parameters: Mapping[str, np.ndarray],
    normaliser_mean: np.ndarray,
    normaliser_inverse_scale: np.ndarray,
    history: np.ndarray,
) -> np.ndarray:
    """Action (8,) in [-1, 1] for a history (8, 11), oldest observation first; or (8, B) for (8, 11, B).

    ``parameters`` are shaped as ``contract.parameter_shapes``; the normaliser's arrays are (11,) and the first layer
    sees (x - mean) * inverse_scale. Raises ValueError for a history of another shape.
    """
    expected = (contract.HISTORY, contract.N_OBSERVATION)
    if history.shape[:2] != expected or history.ndim not in (2, 3):
        raise ValueError(f"history has shape {history.shape}, wanted {expected} or {(*expected, 'B')}")
    batched = history.ndim == 3
    x = np.asarray(history, np.float64).reshape(*expected, -1)
    x = (x - _float64(normaliser_mean)[:, None]) * _float64(normaliser_inverse_scale)[:, None]
    for i, (dilation, gated) in enumerate(zip(contract.DILATIONS, contract.GATED), start=1):
        older, newer = _float64(parameters[f"conv{i}/kernel"])
        bias = _float64(parameters[f"conv{i}/bias"])[:, None]
        pre_activation = older.T @ x[:-dilation] + newer.T @ x[dilation:] + bias
        x = _gate(pre_activation, axis=1) if gated else np.tanh(pre_activation)
    action = x[0]  # valid padding has shortened the history to length 1
    return action if batched else action[:, 0]


class StreamingPolicy:
    """The same policy fed one observation per control tick, remembering what it already computed.

    Each layer keeps as many of its past inputs as its dilation: one observation, two outputs of layer 1, four of
    layer 2. Equal to ``forward`` over the last eight observations, the first one since ``reset`` filling the history.
    """

    def __init__(
        self,
        parameters: Mapping[str, np.ndarray],
        normaliser_mean: np.ndarray,
        normaliser_inverse_scale: np.ndarray,
    ) -> None:
        self._mean = _float64(normaliser_mean)
        self._inverse_scale = _float64(normaliser_inverse_scale)
        # Both taps as one matrix (outputs, 2 * inputs): one product a layer and tick.
        self._weights = [
            _float64(parameters[f"conv{i}/kernel"]).reshape(-1, len(parameters[f"conv{i}/bias"])).T.copy()
            for i, _ in enumerate(contract.DILATIONS, start=1)
        ]
        self._biases = [_float64(parameters[f"conv{i}/bias"]) for i, _ in enumerate(contract.DILATIONS, start=1)]
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
        if observation.shape != (contract.N_OBSERVATION,):
            raise ValueError(f"observation has shape {observation.shape}, wanted {(contract.N_OBSERVATION,)}")
        if not np.isfinite(observation).all():
            bad = [n for n, v in zip(contract.OBSERVATION_NAMES, observation) if not np.isfinite(v)]
            raise ValueError(f"observation has a non-finite {', '.join(bad)}")
        x = (observation - self._mean) * self._inverse_scale
        for past, weights, bias, gated in zip(self._past, self._weights, self._biases, contract.GATED):
            if not past:  # a constant history gives every layer a constant input
                past.extend([x] * past.maxlen)
            pre_activation = weights @ np.concatenate((past[0], x)) + bias
            past.append(x)
            x = _gate(pre_activation, axis=0) if gated else np.tanh(pre_activation)
        return x


def _gate(pre_activation: np.ndarray, axis: int) -> np.ndarray:
    signal, gate = np.split(pre_activation, 2, axis=axis)
    return np.tanh(signal) * (0.5 + 0.5 * np.tanh(0.5 * gate))  # the logistic function, without overflow


def _float64(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, np.float64)
