"""Impacts of a ball: where it meets a box (table, net) or the paddle, and what that does to velocity and spin.

Tangential part, with the slip velocity v_s of the contact point and a thin shell, I = 2/3 m r^2:
    dv_t = -alpha v_s,   d omega = -3 / (2 r) n x dv_t
so the slip after the impact is (1 - 5/2 alpha) v_s.
    table and net: alpha = min(mu (1 + e) |v_n| / |v_s|, 2/5 (1 + e_t)): sliding by Coulomb friction, or gripping; at
                   e_t = 0 the contact point sticks (Nakashima), beyond it springs back and its slip ends at -e_t v_s
                   (Cross, American Journal of Physics 70, 482, 2002)
    rubber:        alpha = k_v, tangential impulse proportional to slip; k_v > 2/5 reverses the slip, which Coulomb
                   friction cannot (numbers: github.com/gossardt/tt_rackets)
Normal part: v_n' = -e v_n, e = restitution - slope |v_n| kept within [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp

from ballmodel import constants as c
from ballmodel.io.ranges import Within
from ballmodel.partial_params import optional, value_or
from ballmodel.vec import TINY, Scalars, Vec, Vector, components, cross, dot, norm

STICKING = 2.0 / 5.0  # alpha that brings the contact point of a thin shell to rest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SurfaceParams:
    """Impact on table or net; scalars or of the balls' batch shape."""

    restitution: Annotated[Scalars, Within(0.0, 1.5)]  # e at zero speed
    restitution_slope: Annotated[Scalars, Within(-1.0, 1.0, "s/m")]  # [s/m], loss of e per normal speed
    friction: Annotated[Scalars, Within(0.0, 5.0)]  # mu
    height: Annotated[Scalars, Within(-0.5, 0.5, "m")]  # [m], shift of the surface along z from its nominal place
    # slope dz/dx of the surface, about the table's centre
    tilt_x: Annotated[Scalars, Within(-1.0, 1.0)] | None = optional(0.0)
    tilt_y: Annotated[Scalars, Within(-1.0, 1.0)] | None = optional(0.0)  # slope dz/dy
    # e_t, slip that a gripped contact point springs back with over the slip that it came with
    tangential_restitution: Annotated[Scalars, Within(-1.0, 1.0)] | None = optional(0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PaddleParams:
    """Impact on the paddle's rubber and the blade's size; scalars or of the balls' batch shape."""

    restitution: Annotated[Scalars, Within(0.0, 1.5)] = c.RUBBER_RESTITUTION  # a in e = a - b |v_n|
    restitution_slope: Annotated[Scalars, Within(-1.0, 1.0, "s/m")] = c.RUBBER_RESTITUTION_SLOPE  # b [s/m]
    tangential_gain: Annotated[Scalars, Within(-2.0, 2.0)] = c.RUBBER_TANGENTIAL_GAIN  # k_v
    radius: Annotated[Scalars, Within(0.01, 0.5, "m")] = c.PADDLE_RADIUS  # [m]
    thickness: Annotated[Scalars, Within(0.0, 0.1, "m")] = c.PADDLE_THICKNESS  # [m]
    # [rad], turns the blade's normal about the blade's horizontal in-plane axis; positive turns it downwards (closes)
    tilt: Annotated[Scalars, Within(-1.0, 1.0, "rad")] | None = optional(0.0)
    # [m], shift of the blade along its (turned) normal
    offset: Annotated[Scalars, Within(-0.5, 0.5, "m")] | None = optional(0.0)
    # share of the restitution that is lost at the blade's rim; it grows with the square of the distance from its centre
    rim_loss: Annotated[Scalars, Within(0.0, 1.0)] | None = optional(0.0)


def table_params() -> SurfaceParams:
    """The nominal table."""
    return SurfaceParams(c.TABLE_RESTITUTION, 0.0, c.TABLE_FRICTION, 0.0)


def net_params() -> SurfaceParams:
    """The nominal net: it takes nearly all of the ball's normal speed (estimate, no published measurement)."""
    return SurfaceParams(0.1, 0.0, 0.3, 0.0)


def restitution_at(params: SurfaceParams | PaddleParams, normal_speed: Scalars) -> jax.Array:
    """Coefficient of restitution at a normal speed [m/s], (...)."""
    return jnp.clip(params.restitution - params.restitution_slope * jnp.abs(normal_speed), 0.0, 1.0)


def impact(
    params: SurfaceParams | PaddleParams,
    velocity: Vector,
    spin: Vector,
    normal: Vector,
    radius: Scalars,
    surface_velocity: Vector = (0.0, 0.0, 0.0),
    off_centre: Scalars = 0.0,
) -> tuple[Vec, Vec]:
    """Velocity and spin after an impact on table or net, or on the paddle. Vectors are Vecs or (3, ...) arrays.

    Args:
        params: of the surface.
        velocity, spin: of the ball [m/s], [rad/s].
        normal: unit vector pointing to the ball.
        radius: of the ball [m].
        surface_velocity: [m/s] of the contact point, which it keeps: the arm is so much heavier than the ball (60 kg to
            2.7 g).
        off_centre: square of the contact's distance from the blade's centre over that of the rim.
    """
    velocity, spin, normal = components(velocity), components(spin), components(normal)
    relative = velocity - surface_velocity
    normal_speed = dot(relative, normal)
    contact_arm = normal * -radius
    slip = relative - normal * normal_speed + cross(spin, contact_arm)
    slip = slip - normal * dot(slip, normal)
    e: Scalars = restitution_at(params, normal_speed)
    if isinstance(params, PaddleParams):
        alpha: Scalars = params.tangential_gain
        if params.rim_loss is not None:
            e = e * (1.0 - params.rim_loss * off_centre)
    else:
        e_t = params.tangential_restitution
        sliding = params.friction * (1.0 + e) * jnp.abs(normal_speed) / (norm(slip) + TINY)
        alpha = jnp.minimum(sliding, STICKING if e_t is None else STICKING * (1.0 + e_t))
    tangential = slip * -alpha
    new_velocity = velocity - normal * ((1.0 + e) * normal_speed) + tangential
    new_spin = spin - cross(normal, tangential) / (c.SHELL_INERTIA_FACTOR * radius)
    return new_velocity, new_spin


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, centre and half sizes [m]."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]


TABLE = Box((0.0, 0.0, -c.TABLE_THICKNESS / 2), (c.TABLE_WIDTH / 2, c.TABLE_LENGTH / 2, c.TABLE_THICKNESS / 2))
NET = Box((0.0, 0.0, c.NET_HEIGHT / 2), (c.TABLE_WIDTH / 2 + c.NET_OVERHANG, c.NET_THICKNESS / 2, c.NET_HEIGHT / 2))


class Frame(NamedTuple):
    """Axes of a tilted surface, as Vecs in world coordinates."""

    x: Vec
    y: Vec
    z: Vec  # the surface's normal

    def to_surface(self, v: Vector) -> Vec:
        """A world vector (a Vec or a (3, ...) array) in the surface's axes."""
        return Vec(dot(self.x, v), dot(self.y, v), dot(self.z, v))

    def to_world(self, v: Vector) -> Vec:
        return self.x * v[0] + self.y * v[1] + self.z * v[2]

    def place(self, surface: SurfaceParams, position: Vector) -> Vec:
        """A world position as the surface's own axes have it, its height taken off."""
        return self.to_surface((position[0], position[1], position[2] - surface.height))


def surface_frame(surface: SurfaceParams) -> Frame | None:
    """The axes of a surface that is turned about the origin by its slopes; None where tilts were left out.

    The rotation is the least one that brings z to the normal (-tilt_x, -tilt_y, 1) / sqrt(1 + tilt_x^2 + tilt_y^2);
    it is smooth at zero. Axis-aligned in these axes is the box with its faces, edges and cord.
    """
    if surface.tilt_x is None and surface.tilt_y is None:
        return None
    a, b = value_or(surface.tilt_x, 0.0), value_or(surface.tilt_y, 0.0)
    nz = 1.0 / jnp.sqrt(1.0 + a * a + b * b)
    nx, ny = -a * nz, -b * nz
    s = 1.0 / (1.0 + nz)
    return Frame(Vec(1.0 - nx * nx * s, -nx * ny * s, -nx), Vec(-nx * ny * s, 1.0 - ny * ny * s, -ny), Vec(nx, ny, nz))


def elevation(surface: SurfaceParams, position: Vector) -> Scalars:
    """Height [m] of a position (a Vec or a (3, ...) array) over the surface, straight up: (...)."""
    z = position[2] - surface.height
    for slope, along in ((surface.tilt_x, position[0]), (surface.tilt_y, position[1])):
        z = z if slope is None else z - slope * along
    return z


def box_gap(box: Box, height: Scalars, position: Vector) -> tuple[Vec, jax.Array]:
    """Vector from the nearest point of the box to ``position`` (a Vec or a (3, ...) array) and its length [m], (...).

    ``height`` shifts the box along z. The vector is zero for a point inside the box. A tilted box takes and returns
    vectors in the axes of its ``surface_frame``.
    """
    centre = (box.centre[0], box.centre[1], box.centre[2] + height)
    gap = Vec(
        *(position[i] - jnp.clip(position[i], centre[i] - box.half[i], centre[i] + box.half[i]) for i in range(3))
    )
    return gap, norm(gap)


def surface_gap(box: Box, surface: SurfaceParams, position: Vector) -> tuple[Vec, jax.Array]:
    """``box_gap`` of a box with its surface's height and tilt, in world axes."""
    frame = surface_frame(surface)
    if frame is None:
        return box_gap(box, surface.height, position)
    gap, distance = box_gap(box, 0.0, frame.place(surface, position))
    return frame.to_world(gap), distance
