"""Delays in seconds, fixed per episode, applied at substep resolution.

Observation. At control tick n the policy sees the state at n T - d. With k = ceil(d / T) that moment lies in control
period n - k, always at the same phase p = k T - d: each period captures its state at that phase (interpolated between
substeps) into a ring, and tick n reads the entry of period n - k.

Action. With d = m T + r, the command in force during period n is that of tick n - m - 1 for the first r seconds and
that of tick n - m after them; a substep in which it changes gets the time-weighted mean, whose impulse is exact.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float, Int, Shaped

from mjx_tt.pytrees import pytree

SMALLEST = 1e-6  # [s]; a delay of zero reads the end of the period before, which is the same moment


@pytree
class Delay:
    """A delay split into whole control periods and a rest, each of the batch shape."""

    periods: Int[Array, "*batch"]
    rest: Float[Array, "*batch"]  # [s]


def split_observation_delay(seconds: Float[ArrayLike, "*batch"], period: float) -> Delay:
    """k and the phase p [s] of the captured moment within a control period, from a delay (...) in seconds."""
    d = jnp.maximum(seconds, SMALLEST)
    k = jnp.ceil(d / period)
    return Delay(k.astype(jnp.int32), k * period - d)


def split_action_delay(seconds: Float[ArrayLike, "*batch"], period: float) -> Delay:
    """m and r [s], from a delay (...) in seconds."""
    seconds = jnp.asarray(seconds)
    m = jnp.floor(seconds / period)
    return Delay(m.astype(jnp.int32), seconds - m * period)


def weigh_capture(delay: Delay, s: Int[Array, ""] | int, timestep: float) -> Array:
    """Weight of the state at a control period's substep boundary ``s`` in the captured one: linear interpolation."""
    return jnp.clip(1.0 - jnp.abs(delay.rest / timestep - s), 0.0, 1.0)


def share_old_command(delay: Delay, s: Int[Array, ""] | int, timestep: float) -> Array:
    """Share of substep ``s`` (0-based) during which the older of the two commands is still in force."""
    return jnp.clip((delay.rest - s * timestep) / timestep, 0.0, 1.0)


def write_ring(
    ring: Shaped[Array, "depth n *batch"], tick: Int[Array, ""] | int, value: Shaped[Array, "n *batch"]
) -> Shaped[Array, "depth n *batch"]:
    """The ring (depth, n, ...) with ``value`` (n, ...) in the slot of control period ``tick``."""
    slot = jnp.mod(tick, ring.shape[0])
    return jax.lax.dynamic_update_index_in_dim(ring, value, slot, 0)


def read_ring(ring: Shaped[Array, "depth n *batch"], tick: Int[Array, "..."]) -> Shaped[Array, "n *batch"]:
    """The entries (n, ...) of control periods ``tick`` (...), which may differ per episode.

    A sum of selections instead of a gather: it stays inside the vector loops.
    """
    depth = ring.shape[0]
    slot = jnp.mod(tick, depth)
    out = ring[0]
    for i in range(1, depth):
        out = jnp.where(slot == i, ring[i], out)
    return out


def count_slots(longest: float, period: float) -> int:
    """Slots needed for delays up to ``longest`` seconds: one more than the periods that have to be remembered."""
    return math.ceil(longest / period) + 2
