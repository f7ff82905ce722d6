"""The moment at which the blade meets the ball, or is nearest to it, and the ball's way back from there.

Whether and when a ball is hit is decided without derivatives, as the episode decides it. What follows has them: the
impact by joint positions and velocities of that moment, the landing by the impact. A ball that is missed is given the
impact that it would have had at the blade's middle, so that it says how to hold the blade as well as where.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from ballmodel import contact, flight
from ballmodel.flight import BallParams, PaddlePose
from ballmodel.state import BallState, where
from ballmodel.vec import components, dot, row, stack
from mjx_tt.env.task import Task
from mjx_tt.gradient.incoming import Incoming
from mjx_tt.gradient.motion import Motion
from mjx_tt.pytrees import pytree

STEP, STEPS = 0.025, 48  # [s] of the returning ball's flight, and how many: 1.2 s
NEVER = 1e3  # [m^2] squared distance of a ball that cannot be played
SLOWEST = 1e-3  # [m], [m/s] below which a quotient is not taken


@pytree
class Meeting:
    """The moments of hits, and the nearest ones of misses, in episodes (L,).

    substep   in which it is
    last      in which the episode ends: that of the hit, or in which a missed ball is out of play
    playable  the ball bounced and could be reached by somebody
    hit       as the episode counts it
    """

    substep: Int[Array, " L"]
    last: Int[Array, " L"]
    playable: Bool[Array, " L"]
    hit: Bool[Array, " L"]


@pytree
class Strike:
    """Outcomes of these moments.

    distance  [m^2] of the ball's centre from the blade's, squared; of a hit in the blade's plane
    ball      after the impact, that of a missed ball at the blade's middle
    """

    distance: Float[Array, " L"]
    ball: BallState


@pytree
class Landing:
    """Places where balls come down to the table's height, without table and net.

    crossed  over the net's plane; height [m] of the ball's centre there, with ``crossed`` only
    down     within the flight that is looked at; position [m] x and y, or the last ones
    """

    crossed: Bool[Array, " L"]
    height: Float[Array, " L"]
    down: Bool[Array, " L"]
    position: Float[Array, "2 L"]


def find_meeting(task: Task, motion: Motion, ball: Incoming, params: BallParams) -> Meeting:
    """Moments at which balls are hit, or are nearest to the blade. Without derivatives."""
    joints, velocities = jax.lax.stop_gradient([jnp.moveaxis(x, 1, 0) for x in (motion.joints, motion.velocities)])
    pose = task.kinematics.pose(joints, velocities)  # (3, S + 1, L)
    start, end = jax.tree.map(lambda x: x[:, :-1], pose), jax.tree.map(lambda x: x[:, 1:], pose)
    before = jax.tree.map(lambda x: x[:, :-1], ball.ball)
    to = jnp.asarray(ball.ball.position[:, 1:])
    touched = ball.live[:-1] & flight.touched(params, before, to, 1.0 / task.config.sim_rate, (start, end))
    first = jnp.argmax(touched, 0)
    # A ball taken before its bounce is no hit; the same ball after the bounce is what should have been played.
    hit = jnp.take_along_axis(touched & ball.bounced[:-1], first[None], 0)[0]
    open_ = ball.live[:-1] & ball.bounced[:-1]
    away = to - end.position
    nearest = jnp.argmin(jnp.where(open_, dot(away, away), NEVER), 0)
    last = jnp.where(touched.any(0), first, jnp.minimum(ball.live.sum(0), touched.shape[0]) - 1)
    return Meeting(jnp.where(hit, first, nearest), last, open_.any(0), hit)


def simulate_strike(
    met: Meeting, ball: Incoming, params: BallParams, blade: tuple[PaddlePose, PaddlePose], timestep: float
) -> Strike:
    """The impacts. blade: its pose at the start and at the end of the substep, which takes ``timestep`` [s]."""

    def at(substep: Array) -> BallState:
        return jax.tree.map(lambda x: jnp.take_along_axis(x, substep[None, None], 1)[:, 0], ball.ball)

    before, after = blade
    struck, events = flight.step(params, at(met.substep), timestep, blade)
    missed, distance = _nearest(params, at(met.substep + 1), after, timestep)
    share = row(events.time / timestep)
    normal = before.normal * (1.0 - share) + after.normal * share
    offset = events.position - before.position * (1.0 - share) - after.position * share
    along = dot(offset, normal)
    off_centre = dot(offset, offset) - along * along
    return Strike(jnp.where(met.hit, off_centre, distance), where(met.hit, struck, missed))


def _nearest(
    params: BallParams, ball: BallState, blade: PaddlePose, timestep: float
) -> tuple[BallState, Float[Array, " L"]]:
    """A ball that is not hit as if it were, and its least squared distance [m^2] from the blade, near this moment."""
    away, closing = ball.position - blade.position, ball.velocity - blade.velocity
    since = jnp.clip(-dot(away, closing) / (dot(closing, closing) + SLOWEST), -timestep, timestep)
    away = away + row(since) * closing
    facing = blade.normal * row(jnp.where(dot(blade.normal, closing) < 0.0, 1.0, -1.0))
    speed, spin, normal, moving = (components(x) for x in (ball.velocity, ball.spin, facing, blade.velocity))
    velocity, spin = contact.impact(params.paddle, speed, spin, normal, params.flight.radius, moving)
    position = blade.position + row(since) * blade.velocity + facing * params.flight.radius
    return BallState(position, stack(velocity), stack(spin)), jnp.asarray(dot(away, away))


def find_landing(params: BallParams, ball: BallState) -> Landing:
    """The way of balls (3, L) that were hit."""
    air = replace(params.flight, integrator="midpoint")

    def step(carry: tuple[BallState, Landing], _: None) -> tuple[tuple[BallState, Landing], None]:
        now, found = carry
        then = flight.free_step(air, now, STEP)
        y0, y1 = now.position[1], then.position[1]
        crosses = (y0 < 0.0) & (y1 >= 0.0) & ~found.down
        share = jnp.clip(-y0 / jnp.maximum(y1 - y0, SLOWEST), 0.0, 1.0)
        height = now.position[2] + share * (then.position[2] - now.position[2])
        z0, z1 = (x.position[2] - params.flight.radius for x in (now, then))
        lands = (z0 > 0.0) & (z1 <= 0.0) & ~found.down
        share = jnp.clip(z0 / jnp.maximum(z0 - z1, SLOWEST), 0.0, 1.0)
        ground = now.position[:2] + row(share) * (then.position[:2] - now.position[:2])
        over = found.down | lands
        found = Landing(
            found.crossed | crosses,
            jnp.where(crosses, height, found.height),
            over,
            jnp.where(found.down, found.position, jnp.where(lands, ground, then.position[:2])),
        )
        return (where(over, now, then), found), None

    false = jnp.zeros(ball.position.shape[1:], bool)
    start = Landing(false, jnp.zeros_like(ball.position[0]), false, jnp.asarray(ball.position[:2]))
    (_, found), _ = jax.lax.scan(step, (ball, start), None, length=STEPS)
    return found
