"""A stroke: the velocity that brings a ball to where it is aimed, and how an erring hand changes it.

Component axis first, batch axes last.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from ballmodel import constants as c
from ballmodel.aerodynamics import FlightParams
from ballmodel.flight import free_step
from ballmodel.state import BallState
from ballmodel.vec import Scalars

SOLVER_STEPS, SOLVER_ROUNDS = 16, 4  # of the flight that aims a stroke: within a few millimetres


def estimate_stroke_seconds(
    start: Float[Array | np.ndarray, "3 *batch"], target: Float[Array, "3 *batch"], speed: Scalars, clearance: Scalars
) -> Float[Array, "*batch"]:
    """Time of flight [s] (...) from start to target (3, ...) [m] at a horizontal speed [m/s], or longer: over the net.

    Without air the height over the net plane at the share a of the way is z0 + a (z1 - z0) + g T^2 / 2 a (1 - a).
    """
    across, along = target[0] - start[0], target[1] - start[1]
    share = jnp.clip(start[1] / jnp.maximum(-along, 1e-3), 0.03, 0.97)
    straight = start[2] + share * (target[2] - start[2])
    sag = (c.NET_HEIGHT + c.BALL_RADIUS + clearance - straight) / (share * (1.0 - share))
    over_net = jnp.sqrt(2.0 * jnp.maximum(sag, 0.0) / c.GRAVITY)
    return jnp.maximum(jnp.hypot(across, along) / speed, over_net)


def estimate_fall_seconds(climb: Scalars, height: Scalars) -> Float[Array, "*batch"]:
    """Time [s] (...) without air until a ball that leaves at a height [m] with a climb [m/s] meets the table."""
    square = climb**2 + 2.0 * c.GRAVITY * (height - c.BALL_RADIUS)
    return jnp.asarray(climb + jnp.sqrt(jnp.maximum(square, 0.0))) / c.GRAVITY


def aim_stroke(
    flight: FlightParams,
    start: Float[Array | np.ndarray, "3 *batch"],
    target: Float[Array, "3 *batch"],
    seconds: Float[Array, "*batch"],
    spin: Float[Array, "3 *batch"],
) -> Float[Array, "3 *batch"]:
    """Velocity (3, ...) [m/s] with which a ball of that spin flies from start to target (3, ...) [m] in ``seconds``.

    By shooting: the flight without air first, then each time the miss over the time is taken off.
    """
    flight = replace(flight, integrator="midpoint")
    gravity = jnp.reshape(jnp.array([0.0, 0.0, -c.GRAVITY]), (3,) + (1,) * (start.ndim - 1))
    velocity = (target - start) / seconds[None] - 0.5 * gravity * seconds[None]
    for _ in range(SOLVER_ROUNDS):
        state = BallState(start, velocity, spin)
        state = jax.lax.fori_loop(0, SOLVER_STEPS, lambda _, s: free_step(flight, s, seconds / SOLVER_STEPS), state)
        velocity = velocity + (target - state.position) / seconds[None]
    return velocity


def perturb_stroke(
    key: PRNGKeyArray,
    velocity: Float[Array, "3 *batch"],
    direction: Scalars,
    elevation: Scalars,
    pace: Scalars,
    lift: Scalars = 0.0,
) -> Float[Array, "3 *batch"]:
    """The velocity (3, ...) with Gaussian errors, cut at three deviations: direction and elevation [rad], pace as a
    share.

    lift: constant error of the elevation [rad].
    """
    direction, elevation, pace = (
        size * jax.random.truncated_normal(k, -3.0, 3.0, velocity.shape[1:])
        for k, size in zip(jax.random.split(key, 3), (direction, elevation, pace), strict=True)
    )
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=0)) * (1.0 + jnp.maximum(pace, -0.5))
    level = jnp.hypot(velocity[0], velocity[1])
    azimuth = jnp.arctan2(velocity[1], velocity[0]) + direction
    rise = jnp.arctan2(velocity[2], level) + elevation + lift
    return speed[None] * jnp.stack([jnp.cos(rise) * jnp.cos(azimuth), jnp.cos(rise) * jnp.sin(azimuth), jnp.sin(rise)])
