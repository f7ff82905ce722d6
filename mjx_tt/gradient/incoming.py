"""The incoming ball by itself: until the blade touches it nothing that the robot does changes it.

So its flights need no derivatives, and all of them are known before the robot moves.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from ballmodel import flight
from ballmodel.state import BallState, where
from mjx_tt.env.episode import EpisodeConstants, Episodes
from mjx_tt.env.task import Task
from mjx_tt.pytrees import pytree
from mjx_tt.sim.sensors import Filters


@pytree
class Incoming:
    """Balls that nobody plays, at the S + 1 ends of S substeps; L episodes.

    ball     position [m], velocity [m/s], spin [rad/s], each (3, S + 1, L); after its end a ball stays where it is
    bounced  it came down on the robot's side
    live     it can still be played
    seen     what has come from the tracker by each control step: position, with jitter also velocity
    """

    ball: BallState
    bounced: Bool[Array, "S+1 L"]
    live: Bool[Array, "S+1 L"]
    seen: Float[Array, "T captured L"]


def fly_incoming(task: Task, episodes: Episodes, constants: EpisodeConstants, ticks: int) -> Incoming:
    """The balls of episodes (L,) through ``ticks`` control periods."""
    params, tracker, n, timestep = episodes.model.ball, episodes.model.sensing, task.substeps, task.timestep
    nothing = jnp.zeros((task.contract.n_joints, *episodes.seed.shape), episodes.ball.position.dtype)

    def captured(i: int, ball: BallState, filters: Filters) -> Array:
        whole = task.capture(episodes, constants, i, ball, filters, nothing)
        return jnp.concatenate([whole[:3], whole[3 + nothing.shape[0] :]])

    def substep(ball: BallState, bounced: Array, live: Array, filters: Filters) -> tuple:
        moved, events = flight.step(params, ball, timestep)
        before, ball = ball, where(live, moved, ball)
        filters = filters.step(tracker, before, ball, live & events.table, timestep - events.time, timestep)
        over = task.is_over(ball, events, bounced)
        bounced = bounced | (live & events.table & (events.position[1] < 0.0))
        return ball, bounced, live & ~over, filters

    def period(carry: tuple, _: None) -> tuple[tuple, tuple]:
        seen, passed = captured(0, carry[0], carry[3]), []
        for i in range(n):
            carry = substep(*carry)
            seen = seen + captured(i + 1, carry[0], carry[3])
            passed.append(carry[:3])
        return carry, (jax.tree.map(lambda *x: jnp.stack(x), *passed), seen)

    false = jnp.zeros(episodes.seed.shape, bool)
    first = (episodes.ball, false, ~false)
    filters = Filters.settle(tracker, episodes.ball.position, timestep)
    _, (passed, seen) = jax.lax.scan(period, (*first, filters), None, length=ticks)
    whole = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y.reshape(-1, *y.shape[2:])]), first, passed)
    ball, bounced, live = whole
    at_rest = jnp.concatenate([episodes.ball.position, episodes.ball.velocity])[: seen.shape[1]]
    return Incoming(
        jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), ball), bounced, live, _delay_captures(seen, at_rest, constants)
    )


def _delay_captures(captured: Array, first: Array, constants: EpisodeConstants) -> Array:
    """Captures (T, c, L), one in each control period, that have arrived at each control step; before, ``first``."""
    tick = jnp.arange(captured.shape[0])[:, None] - constants.ball.periods[None]
    arrived = jnp.take_along_axis(captured, jnp.maximum(tick, 0)[:, None], 0)
    return jnp.where((tick < 0)[:, None], first[None], arrived)
