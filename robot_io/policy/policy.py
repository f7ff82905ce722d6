"""A policy as one value, the network's parameters and the frozen normaliser of its observations; and the network.

Layer formulas and the order of the parameters: ``robot_io.contract`` (paper, appendix E). ``forward`` computes a whole
history and is the reference. ``start`` and ``step`` compute one tick after the other and remember what they need; how
a layer's product is computed is their caller's: NumPy in the control loop, JAX in training.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from ballmodel.io.atomic_files import replacing
from robot_io import contract

Past: TypeAlias = tuple[tuple[Any, ...], ...]  # by layer: its inputs of the last ticks, oldest first
Layer: TypeAlias = Callable[[int, Any, Any], Any]  # number of the layer from 0, its older and newer input -> output

_KEYS = {"theta": "theta", "mean": "mean", "inv_std": "inverse_scale"}  # of a field: its name in files


@dataclass(frozen=True)
class Policy:
    """Parameters and normaliser, NumPy or JAX arrays; the network's input is (observation - mean) * inv_std.

    A last axis, where there is one, holds P policies side by side. ``robot_io.policy.jax_policy`` registers the
    class with JAX.

    theta    (976,) or (976, P) parameters in the order of ``contract.parameter_shapes``; of another robot as many as
             its joints take
    mean     (11,) or (11, P) in the observation's units: of three coordinates of the ball and the joints
    inv_std  (11,) or (11, P) reciprocal standard deviations; 0 for a component that never varied
    network  a user-defined one that theta parameterises instead of the paper's
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
        """Arrays by name, shaped as ``contract.parameter_shapes`` or the network's, with the axis P last."""
        shapes = contract.parameter_shapes(self.n_observation - 3) if self.network is None else self.network.shapes
        return contract.unflatten(self.theta, dict(shapes))

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


def start(layer: Layer, x: Any) -> Past:
    """What ``step`` remembers as if the normalised observation ``x`` had always been there."""
    past = []
    for i, dilation in enumerate(contract.DILATIONS):
        past.append((x,) * dilation)
        x = layer(i, x, x)
    return tuple(past)


def step(layer: Layer, past: Past, x: Any) -> tuple[Any, Past]:
    """The action for the newest normalised observation ``x``, and what is remembered of it.

    928 multiply-adds instead of the 4,576 of ``forward``: a layer needs its input of ``DILATIONS`` ticks before.
    """
    later = []
    for i, inputs in enumerate(past):
        later.append((*inputs[1:], x))
        x = layer(i, inputs[0], x)
    return x, tuple(later)


class LoopPolicy:
    """A policy in the control loop: fed one observation per control tick."""

    dtype: type = np.float32  # in which it computes

    def __init__(self, policy: Policy, robot: contract.Contract = contract.PAPER) -> None:
        """``robot``: whose contract the policy was trained for. Raises ValueError where it has other joints."""
        if policy.n_observation != robot.n_observation:
            raise ValueError(
                f"the policy has observations of {policy.n_observation} numbers, those of {robot.robot} have "
                f"{robot.n_observation}"
            )
        self._names = robot.observation_names
        self._first = True

    def reset(self) -> None:
        """Forgets everything: the next observation begins an episode."""
        self._first = True

    def step(self, observation: np.ndarray) -> np.ndarray:
        """Action (joints,) in [-1, 1] for the newest observation (n,).

        Raises ValueError for another shape or a non-finite number, and then remembers nothing of it.
        """
        observation = np.asarray(observation, self.dtype)
        size = len(self._names)
        if observation.shape != (size,):
            raise ValueError(f"observation has shape {observation.shape}, expected {size} finite numbers")
        if not np.isfinite(observation).all():
            bad = [name for name, value in zip(self._names, observation, strict=True) if not np.isfinite(value)]
            raise ValueError(f"observation has a non-finite {', '.join(bad)}, expected {size} finite numbers")
        action = self.act(observation, self._first)
        self._first = False
        return action

    def episode(self, observations: np.ndarray) -> np.ndarray:
        """Actions (T, joints) for the observations (T, n) of one episode."""
        self.reset()
        return np.stack([self.step(observation) for observation in observations])

    def act(self, observation: np.ndarray, first: bool) -> np.ndarray:
        """The action for an observation that was checked; ``first``: of an episode."""
        raise NotImplementedError


@dataclass(frozen=True)
class ExportedNetwork:
    """A user-defined network as an artefact holds it: one compiled step.

    The step is ``step(theta, mean, inv_std, first, state, observation) -> action, state``: float32 arrays, the state a
    tuple of arrays, and with ``first`` true the state made anew from the observation.

    shapes    of the parameters by name, in their order in theta
    exported  the step, serialised by ``jax.export`` for the CPU; ``robot_io.policy.jax_policy`` runs it
    source    the Python file that defines the network, for those who train or simulate with it
    """

    name: str
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    exported: bytes
    source: str

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for _, shape in self.shapes)
