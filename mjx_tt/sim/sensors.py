"""The ball tracker's camera and filter: how a true position becomes a measured one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from ballmodel.partial_params import value_or
from ballmodel.vec import dot

if TYPE_CHECKING:
    from mjx_tt.sim.model import SensingParams

SHORTEST = 1e-9  # [s], keeps the filter's exponent finite


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """A camera's wrong calibration about the table frame's origin."""

    rows: tuple  # 3 x 3 of scalars or (...), camera_scale Rz Ry Rx
    distortion: jax.Array | float  # [1/m^2]

    def seen(self, p):
        """Measured position (3, ...) [m] of a ball at p (3, ...) [m], without offset and noise."""
        p = p * (1.0 + self.distortion * dot(p, p))
        return jnp.stack([dot(row, p) for row in self.rows])


def camera(params: SensingParams) -> Camera | None:
    """The camera of these parameters; None where all of them were left out."""
    names = ("camera_scale", *(f"camera_rotation_{axis}" for axis in "xyz"), "camera_distortion")
    values = [getattr(params, name) for name in names]
    if all(value is None for value in values):
        return None
    scale, x, y, z, distortion = (value_or(value, nominal) for value, nominal in zip(values, (1.0, 0.0, 0.0, 0.0, 0.0)))
    (cx, cy, cz), (sx, sy, sz) = (tuple(map(f, (x, y, z))) for f in (jnp.cos, jnp.sin))
    rotation = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return Camera(tuple(tuple(scale * entry for entry in row) for row in rotation), distortion)


def smoothed(time_constant, filtered, before, after, timestep: float):
    """The filtered position (3, ...) [m] at a substep's end: df/dt = (p - f) / time_constant, solved exactly for a ball
    that goes straight from ``before`` to ``after`` (3, ...) within the substep."""
    tau = jnp.maximum(time_constant, SHORTEST)
    behind = (after - before) * (tau / timestep)  # by which f follows a steady p
    return after - behind + (filtered - before + behind) * jnp.exp(-timestep / tau)
