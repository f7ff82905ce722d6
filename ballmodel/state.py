"""The state of a ball."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BallState:
    """Position, velocity and spin of one or many balls; component axis first, batch axes last."""

    position: jax.Array  # (3, ...) [m], ball centre
    velocity: jax.Array  # (3, ...) [m/s]
    spin: jax.Array  # (3, ...) [rad/s], angular velocity


def ball_state(position, velocity, spin=None) -> BallState:
    """Builds a BallState; without ``spin`` the ball does not rotate. Raises ValueError on shapes that do not match."""
    position, velocity = jnp.asarray(position), jnp.asarray(velocity)
    spin = jnp.zeros_like(velocity) if spin is None else jnp.asarray(spin)
    for name, value in (("position", position), ("velocity", velocity), ("spin", spin)):
        if value.ndim < 1 or value.shape[0] != 3 or value.shape != position.shape:
            raise ValueError(
                f"{name} has shape {value.shape}; position, velocity and spin must share one shape (3, ...)"
            )
    return BallState(position, velocity, spin)


def where(condition, a: BallState, b: BallState) -> BallState:
    """Element-wise choice between two states; ``condition`` has the batch shape."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
