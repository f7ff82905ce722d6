"""A policy as one value: the network's parameters and the frozen normaliser of its observations.

Layer formulas and the order of the parameters: ``robot_io.contract`` (paper, appendix E). ``forward`` is the reference
that every other form of the network is compared with.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ballmodel.io.atomic_files import replacing
from robot_io import contract

_KEYS = {"theta": "theta", "mean": "mean", "inv_std": "inverse_scale"}  # of a field: its name in files


@dataclass(frozen=True)
class Policy:
    """Parameters and normaliser, NumPy or JAX arrays; the network's input is (observation - mean) * inv_std.

    A last axis, where there is one, holds P policies side by side. ``robot_io.policy.pytree`` registers the class with
    JAX.

    theta    (976,) or (976, P) parameters in the order of ``contract.parameter_shapes``; of another robot as many as
             its joints take
    mean     (11,) or (11, P) in the observation's units: of three coordinates of the ball and the joints
    inv_std  (11,) or (11, P) reciprocal standard deviations; 0 for a component that never varied
    network  what theta parameterises where it is not this network: then only what knows such networks computes it
    """

    theta: Any
    mean: Any
    inv_std: Any
    network: Any = None

    @classmethod
    def load(cls, path: str | os.PathLike) -> Policy:
        """The policy in a file written by ``save``, float32. Raises OSError, or ValueError for another file.

        A folder with an exported policy: ``robot_io.load_artefact(folder).policy``.
        """
        with np.load(path) as data:
            missing = set(_KEYS.values()) - set(data.files)
            if missing:
                raise ValueError(f"{path}: holds {sorted(data.files)}, missing are {sorted(missing)}")
            return cls(*(np.asarray(data[key], np.float32) for key in _KEYS.values()))

    def save(self, path: str | os.PathLike) -> None:
        """Writes theta, mean and inverse_scale as NPZ, whole or not at all. Raises OSError."""
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **{key: getattr(self, field) for field, key in _KEYS.items()})

    @property
    def n_observation(self) -> int:
        """Numbers in an observation: 11, or three more than another robot has joints."""
        return self.mean.shape[0]

    @property
    def parameters(self) -> dict[str, Any]:
        """Kernels and biases by name, shaped as ``contract.parameter_shapes`` with the axis P last."""
        return contract.unflatten(self.theta, self.n_observation - 3)

    def astype(self, dtype: type) -> Policy:
        """The policy with NumPy arrays of that type."""
        arrays: list[np.ndarray] = [np.asarray(array, dtype) for array in (self.theta, self.mean, self.inv_std)]
        return Policy(arrays[0], arrays[1], arrays[2], self.network)

    def apply(self, history: np.ndarray) -> np.ndarray:
        """Action (8,) in [-1, 1] for a history (8, 11), oldest observation first; or (8, B) for (8, 11, B).

        Computed in float64 whatever the precision of the parameters, so the reference adds no rounding of its own.
        Raises ValueError for a history of another shape.
        """
        expected = (contract.HISTORY, self.n_observation)
        if history.shape[:2] != expected or history.ndim not in (2, 3):
            raise ValueError(f"history has shape {history.shape}, wanted {expected} or {(*expected, 'B')}")
        action = forward(self.astype(np.float64), np.asarray(history, np.float64).reshape(*expected, -1))
        return action if history.ndim == 3 else action[:, 0]


def forward(policy: Policy, history: Any, xp: ModuleType = np) -> Any:
    """Actions (8, B) for raw histories (8, 11, B), oldest first, by NumPy or JAX (``xp``), in the inputs' precision."""
    parameters = policy.parameters
    x = (history - policy.mean[None, :, None]) * policy.inv_std[None, :, None]
    for i, (dilation, gated) in enumerate(zip(contract.DILATIONS, contract.GATED, strict=True), start=1):
        older, newer = parameters[f"conv{i}/kernel"]
        z = older.T @ x[:-dilation] + newer.T @ x[dilation:] + parameters[f"conv{i}/bias"][None, :, None]
        x = gate(z, axis=1, xp=xp) if gated else xp.tanh(z)
    return x[0]  # valid padding has shortened the history to length 1


def gate(z: Any, axis: int, xp: ModuleType = np) -> Any:
    """tanh of the first half times the logistic function of the second, in the form that cannot overflow."""
    signal, opening = xp.split(z, 2, axis=axis)
    return xp.tanh(signal) * (0.5 + 0.5 * xp.tanh(0.5 * opening))
