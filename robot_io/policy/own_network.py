"""A user's network as an artefact holds it: one compiled step, as ``jax.export`` wrote it.

The exported function is ``step(theta, mean, inv_std, first, state, observation) -> action, state``: float32 arrays, the
state a tuple of arrays, and with ``first`` true the state made anew from the observation.
``robot_io.policy.jax_network`` runs it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ExportedNetwork:
    """The network that a policy's theta parameterises where it is not the paper's.

    shapes    of the parameters by name, in their order in theta
    exported  the compiled step, serialised by ``jax.export`` for the CPU
    source    the Python file that defines the network, for those who train or simulate with it
    """

    name: str
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    exported: bytes
    source: str

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for _, shape in self.shapes)

    def unflatten(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters by name from theta (size,)."""
        ends = np.cumsum([int(np.prod(shape)) for _, shape in self.shapes])
        parts = np.split(theta, ends[:-1])
        return {name: part.reshape(shape) for (name, shape), part in zip(self.shapes, parts, strict=True)}
