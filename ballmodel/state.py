"""The state of a ball."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BallState:
    """Position, velocity and spin of one or many balls; component axis first, batch axes last."""

    position: Float[jax.Array | np.ndarray, "3 *batch"]  # [m], ball centre
    velocity: Float[jax.Array | np.ndarray, "3 *batch"]  # [m/s]
    spin: Float[jax.Array | np.ndarray, "3 *batch"]  # [rad/s], angular velocity


def ball_state(position: ArrayLike, velocity: ArrayLike, spin: ArrayLike | None = None) -> BallState:
    """Builds a BallState; without ``spin`` the ball does not rotate. Raises ValueError on shapes that do not match."""
    position, velocity = jnp.asarray(position), jnp.asarray(velocity)
    spin = jnp.zeros_like(velocity) if spin is None else jnp.asarray(spin)
    for name, value in (("position", position), ("velocity", velocity), ("spin", spin)):
        if value.ndim < 1 or value.shape[0] != 3 or value.shape != position.shape:
            raise ValueError(
                f"{name} has shape {value.shape}; position, velocity and spin must share one shape (3, ...)"
            )
    return BallState(position, velocity, spin)


def where(condition: Bool[jax.Array, "*batch"], a: BallState, b: BallState) -> BallState:
    """Element-wise choice between two states; ``condition`` has the batch shape."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
