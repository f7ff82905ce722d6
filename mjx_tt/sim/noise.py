"""Observation noise from a counter-based hash: the same counter gives the same number on every device.

Threefry costs as much as a fifth of the arm's dynamics; a 32-bit integer hash with good avalanche is nearly free and
needs no state in the loop. Finaliser "lowbias32": Wellons, hash prospector, bias 0.17.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int, UInt32

from mjx_tt.sim.sensors import SensingParams


def _hash(x: Array) -> Array:
    x = x ^ (x >> 16)
    x = x * jnp.uint32(0x7FEB352D)
    x = x ^ (x >> 15)
    x = x * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def symmetric_uniform(
    seed: UInt32[Array | np.ndarray, "*batch"], counter: Int[Array, ""] | int, n: int
) -> Float[Array, "n *batch"]:
    """Uniform numbers in (-1, 1), shape (n, ...), from per-episode seeds (...) uint32 and a step counter."""
    base = _hash(seed ^ (jnp.asarray(counter, jnp.uint32) * jnp.uint32(0x9E3779B9)))
    bits = [_hash(base + jnp.uint32((i + 1) * 0x85EBCA6B & 0xFFFFFFFF)) for i in range(n)]
    # 24 bits fill a float32 mantissa; the half step keeps the mean at zero.
    return jnp.stack([((b >> 8).astype(jnp.float32) + 0.5) * (2.0**-23) - 1.0 for b in bits])


def add_to_ball(
    ball: Float[Array, "3 *batch"], sensing: SensingParams, seed: UInt32[Array, "*batch"], tick: Int[Array, ""] | int
) -> Float[Array, "3 *batch"]:
    """The ball's place as the tracker reports it at a control step: with its noise and its offset."""
    u = symmetric_uniform(seed, tick, 3).astype(ball.dtype)
    offset = (sensing.ball_offset_x, sensing.ball_offset_y, sensing.ball_offset_z)
    return jnp.stack([ball[i] + sensing.ball_noise * u[i] + offset[i] for i in range(3)])


def normal(seed: UInt32[Array, "*batch"], counter: Int[Array, ""] | int, skip: int) -> Float[Array, "*batch"]:
    """A standard normal number per episode (...): the normal quantile of the uniform number after ``skip`` others."""
    u = symmetric_uniform(seed, counter, skip + 1)[skip]
    largest = 1.0 - 2.0**-24  # rounding may make it 1, whose normal number is infinite
    return jnp.sqrt(2.0) * jax.scipy.special.erfinv(jnp.clip(u, -largest, largest))
