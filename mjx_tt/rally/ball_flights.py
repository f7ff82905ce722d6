"""A rally besides the robot's part of a ball: balls without the robot, and the robot without a ball.

Batch axis last; (L,) unless noted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ballmodel import constants as c
from ballmodel import flight
from ballmodel.flight import BallParams
from ballmodel.state import BallState, where
from mjx_tt.env.return_flight import FLOOR, take_long_steps
from mjx_tt.lanes.loop import while_any
from mjx_tt.pytrees import pytree
from mjx_tt.rally.human_player import OVER_TABLE, Incoming
from robot_io.limits import LIMITS, JointLimits

LONGEST = 2.5  # [s] that a ball is followed
HOME_SPEED, HOME_BRAKING = 0.5, 0.3  # shares of the limits on the way home, the defaults of robot_io.control.bridge
HOME_DELAY = 0.1  # [s] to brake after the hit (estimate)
READY = 0.06  # [s] between the bounce and the earliest contact (estimate)


@pytree
class Sent:
    """Outcome of the players' balls if nobody plays them."""

    net: Bool[Array, " L"]  # touches it
    own_side: Bool[Array, " L"]  # bounces on the human's half
    valid: Bool[Array, " L"]  # comes down on the robot's half, from above and without a bounce before
    landing: Float[Array, "2 L"]  # [m] there


@pytree
class Meeting:
    """The robot's returns as they come to the players."""

    incoming: Incoming
    reached: Bool[Array, " L"]  # could be hit before it bounced again or fell to the floor
    net: Bool[Array, " L"]  # touched it on the way


def _count_ticks(period: float) -> int:
    """Control periods that a ball is followed."""
    return math.ceil(LONGEST / period)


def fly_serve(params: BallParams, ball: BallState, period: float) -> Sent:
    """Flies balls (3, L) until they come down, in steps of ``period`` [s]."""
    params, false = take_long_steps(params), jnp.zeros(ball.position.shape[1:], bool)
    start = Sent(false, false, false, jnp.zeros((2, *false.shape)))

    def step(_: Array, state: tuple, params: BallParams, __: tuple) -> tuple:
        ball, live, found = state
        new, events = flight.step(params, ball, period)
        own = live & events.table & (events.position[1] > 0.0)
        valid = live & events.table & (events.position[1] <= 0.0) & (events.position[2] > 0.0)
        found = Sent(
            net=found.net | (live & events.net),
            own_side=found.own_side | own,
            valid=found.valid | valid,
            landing=jnp.where(valid, events.position[:2], found.landing),
        )
        live = live & ~valid & ~own & (new.position[2] > FLOOR)
        return where(live, new, ball), live, found

    return while_any(lambda s: s[1], step, (ball, ~false, start), params, limit=_count_ticks(period))[2]


def fly_to_player(
    params: BallParams,
    ball: BallState,
    returned: Bool[Array, " L"],
    plane: Float[Array, " L"],
    height: Float[Array, " L"],
    period: float,
) -> Meeting:
    """Flies the robot's returns (3, L) to the player: to the wished plane y or height z [m], whichever comes first.

    returned: which balls to fly. The contact is looked for once per ``period`` [s].
    """
    params, zero = take_long_steps(params), jnp.zeros_like(ball.position[0])
    start = Meeting(Incoming(ball, jnp.zeros_like(ball.position[:2]), zero), zero > 1.0, zero > 1.0)

    def step(tick: Array, state: tuple, by_lane: tuple, _: tuple) -> tuple:
        ball, live, since, met = state
        params, plane, height = by_lane
        new, events = flight.step(params, ball, period)
        net = met.net | (live & events.net)
        bounced = since > 0.0
        bounce = live & events.table & (events.position[1] > 0.0) & ~bounced
        again = live & events.table & bounced
        landing = jnp.where(bounce, events.position[:2], met.incoming.landing)
        since = jnp.where(bounced, since + period, jnp.where(bounce, period - events.time + 1e-6, 0.0))
        # A ball over the table is taken before it bounces again.
        over = (new.position[1] < c.TABLE_LENGTH / 2) & (jnp.abs(new.position[0]) < c.TABLE_WIDTH / 2)
        lowest = jnp.where(over, jnp.maximum(height, OVER_TABLE), height)
        fallen = (new.position[2] <= lowest) & (new.velocity[2] < 0.0)
        contact = live & bounced & (since > READY) & ~again & ((new.position[1] >= plane) | fallen)
        lost = live & ~contact & (again | (new.position[2] < FLOOR))
        live = live & ~contact & ~lost
        seconds = jnp.where(live | contact, (tick + 1).astype(jnp.float32) * period, met.incoming.seconds)
        incoming = Incoming(where(contact, new, met.incoming.ball), landing, seconds)
        return where(live, new, ball), live, since, Meeting(incoming, met.reached | contact, net)

    by_lane = (params, plane, height)
    return while_any(lambda s: s[1], step, (ball, returned, zero, start), by_lane, limit=_count_ticks(period))[3]


def drive_home(
    home: Sequence | np.ndarray,
    qpos: Float[Array, "joints L"],
    seconds: Float[Array, " L"],
    limits: JointLimits = LIMITS,
) -> Float[Array, "joints L"]:
    """Joint positions (n, L) ``seconds`` (L,) after the hit, on the way home (n,) as the bridge drives it."""
    speed, braking = HOME_SPEED * make_column(limits.policy_velocity), HOME_BRAKING * make_column(limits.acceleration)
    error, driven = make_column(home) - qpos, jnp.maximum(seconds - HOME_DELAY, 0.0)[None]
    distance = jnp.abs(error)
    # At full speed until the braking distance, then along the parabola b / 2 (T - t)^2 that is left.
    stop = jnp.minimum(speed**2 / (2.0 * braking), distance)
    cruise = (distance - stop) / speed
    braked = jnp.maximum(jnp.sqrt(2.0 * stop / braking) - (driven - cruise), 0.0)
    moved = jnp.where(driven < cruise, speed * driven, distance - 0.5 * braking * braked**2)
    return qpos + jnp.sign(error) * jnp.clip(moved, 0.0, distance)


def make_column(values: Sequence | np.ndarray) -> Float[Array, "joints 1"]:
    """Numbers of the joints as (n, 1)."""
    return jnp.asarray(np.asarray(values, np.float32))[:, None]
