"""A network of the user's own in place of the paper's: a class with ``start`` and ``step``, marked by a decorator."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from robot_io.contract import unflatten

State: TypeAlias = Any  # a pytree of arrays, whatever a network remembers
Parameters: TypeAlias = Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Network:
    """A network in streaming form, for one policy and one robot; training runs many of both side by side.

    shapes  of its parameters by name, in the order in which they stand in theta
    start   parameters, first normalised observation (11,) -> state: a pytree of arrays, () for none
    step    parameters, state, normalised observation (11,) -> action (8,), cut to [-1, 1], and the next state
    source  the file that defines it
    """

    name: str
    shapes: dict[str, tuple[int, ...]]
    start: Callable[[Parameters, Array], State]
    step: Callable[[Parameters, State, Array], tuple[Array, State]]
    source: str = ""

    def __post_init__(self) -> None:
        check_name("network", self.name, "gru")

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def unflatten(self, theta: Any) -> dict[str, Any]:
        """Parameters by name from theta (size, ...)."""
        return unflatten(theta, self.shapes)


def check_name(what: str, name: Any, example: str) -> None:
    """Raises ValueError for a name that is no identifier."""
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"{what} {name!r}: the name must be letters, digits and underscores, such as {example}")


def network(name: str, shapes: Mapping[str, tuple[int, ...]]) -> Callable[[type], Network]:
    """Makes a class whose static methods are ``start`` and ``step`` a network of that name; see ``Network``."""

    def make(defined: type) -> Network:
        missing = [part for part in ("start", "step") if not callable(getattr(defined, part, None))]
        if missing:
            raise ValueError(f"network {name!r}: has no {' and no '.join(missing)}")
        return Network(name, dict(shapes), defined.start, defined.step)  # type: ignore[attr-defined]

    return make


def check_network(network: Network, n_observation: int, n_joints: int) -> None:
    """Traces a network once. Raises ValueError, or what its own code raises."""
    bad = {
        name: shape
        for name, shape in network.shapes.items()
        if not (isinstance(shape, tuple) and shape and all(isinstance(n, int) and n > 0 for n in shape))
    }
    if bad or not network.shapes:
        raise ValueError(f"shapes are {network.shapes}: tuples of positive whole numbers by name are wanted")

    def run(theta: Array, x: Array) -> tuple[Array, State, State]:
        parameters = network.unflatten(theta)
        state = jax.tree.map(jnp.asarray, network.start(parameters, x))
        action, after = network.step(parameters, state, x)
        return jnp.asarray(action), state, jax.tree.map(jnp.asarray, after)

    numbers = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in (network.size, n_observation)]
    action, before, after = jax.eval_shape(run, *numbers)
    if action.shape != (n_joints,):
        raise ValueError(f"step returns an action {action.shape}, ({n_joints},) is wanted")
    forms = [jax.tree.map(lambda x: (x.shape, str(x.dtype)), state) for state in (before, after)]
    if forms[0] != forms[1]:
        raise ValueError(f"step returns another kind of state than start does: {after} instead of {before}")
