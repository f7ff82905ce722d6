"""The ball tracker's camera and filter: how a true position becomes a measured one."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ballmodel import constants as c
from ballmodel.partial_params import optional, value_or
from ballmodel.vec import Scalars, dot, row

SHORTEST = 1e-9  # [s], keeps the filter's exponent finite


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SensingParams:
    """The ball tracker: how it measures a position.

    measured = camera_scale R (1 + camera_distortion |p|^2) p + offset + noise,   R = Rz Ry Rx
    with p the ball's position, delayed by ``latency.ball_observation`` times ``clock_rate`` and, with ``smoothing``,
    filtered: df/dt = (p - f) / smoothing. (Filter and camera commute but for the distortion's change along the flight;
    the noise is added behind both.)
    """

    # Half width of the uniform noise on each coordinate, per control step [m]: "2 x the diameter" is its whole width.
    ball_noise: Float[Array, "*#batch"] | float = c.BALL_DIAMETER
    ball_offset_x: Float[Array, "*#batch"] | float = 0.0  # [m], calibration bias
    ball_offset_y: Float[Array, "*#batch"] | float = 0.0
    ball_offset_z: Float[Array, "*#batch"] | float = 0.0
    camera_scale: Float[Array, "*#batch"] | float | None = optional(1.0)
    camera_rotation_x: Float[Array, "*#batch"] | float | None = optional(0.0)  # [rad] about the table frame's axes
    camera_rotation_y: Float[Array, "*#batch"] | float | None = optional(0.0)
    camera_rotation_z: Float[Array, "*#batch"] | float | None = optional(0.0)
    camera_distortion: Float[Array, "*#batch"] | float | None = optional(0.0)  # [1/m^2]
    # Measured over true time. A policy reads no clock: all that this can do to it is to stretch the tracker's latency.
    clock_rate: Float[Array, "*#batch"] | float | None = optional(1.0)
    smoothing: Float[Array, "*#batch"] | float | None = optional(0.0)  # [s] time constant of the tracker's filter
    jitter: Float[Array, "*#batch"] | float | None = optional(
        0.0
    )  # [s] deviation of the moment of each measurement, Gaussian


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """A camera's wrong calibration about the table frame's origin."""

    rows: tuple[tuple[Scalars, Scalars, Scalars], ...]  # 3 x 3, camera_scale Rz Ry Rx
    distortion: Scalars  # [1/m^2]

    def seen(self, p: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
        """Measured position (3, ...) [m] of a ball at p (3, ...) [m], without offset and noise."""
        p = p * row(1.0 + self.distortion * dot(p, p))
        return jnp.stack([dot(row, p) for row in self.rows])


def camera(params: SensingParams) -> Camera | None:
    """The camera of these parameters; None where all of them are omitted."""
    names = ("camera_scale", *(f"camera_rotation_{axis}" for axis in "xyz"), "camera_distortion")
    values = [getattr(params, name) for name in names]
    if all(value is None for value in values):
        return None
    scale, x, y, z, distortion = (
        value_or(value, nominal) for value, nominal in zip(values, (1.0, 0.0, 0.0, 0.0, 0.0), strict=True)
    )
    (cx, cy, cz), (sx, sy, sz) = (tuple(map(f, (x, y, z))) for f in (jnp.cos, jnp.sin))
    rotation = (
        (cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        (-sy, cy * sx, cy * cx),
    )
    return Camera(tuple((scale * a, scale * b, scale * c) for a, b, c in rotation), distortion)


def smoothed(
    time_constant: Scalars,
    filtered: Float[Array, "3 *batch"],
    before: Float[Array | np.ndarray, "3 *batch"],
    after: Float[Array | np.ndarray, "3 *batch"],
    timestep: float,
) -> Float[Array, "3 *batch"]:
    """The filtered position (3, ...) [m] at a substep's end: df/dt = (p - f) / time_constant, solved exactly for a ball
    that goes straight from ``before`` to ``after`` (3, ...) within the substep."""
    tau = row(jnp.maximum(time_constant, SHORTEST))
    behind = (after - before) * (tau / timestep)  # by which f follows a steady p
    return jnp.asarray(after) - behind + (filtered - before + behind) * jnp.exp(-timestep / tau)
