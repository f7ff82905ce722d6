"""Phase 2 of an episode: the flight of a ball that the robot hit."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool

from ballmodel import flight
from ballmodel.flight import BallParams
from ballmodel.state import BallState, where
from mjx_tt.env.episode import Return
from mjx_tt.env.task import TaskConfig
from mjx_tt.lanes.loop import while_any
from mjx_tt.robot.scalar_algebra import optimization_barrier
from mjx_tt.sim.model import SimModel

FLOOR = -0.76  # [m]


def take_long_steps(params: BallParams) -> BallParams:
    """The same ball by a step of second order: alone in the air it needs no substeps.

    One step per control period moves its landing point by less than a millimetre.
    """
    return replace(params, flight=replace(params.flight, integrator="midpoint"))


def fly_return(config: TaskConfig, ball: BallState, hit: Bool[Array, "*batch"], model: SimModel) -> Return:
    """Phase 2: flies the balls that were hit until they come down."""

    def step(_: Array, state: tuple, params: BallParams, __: tuple) -> tuple:
        ball, live, outcome = state
        new, events = optimization_barrier(flight.step(params, ball, config.period))
        y0, y1 = ball.position[1], new.position[1]
        crossing = live & (y0 < 0.0) & (y1 >= 0.0)
        w = jnp.clip(-y0 / jnp.where(y1 > y0, y1 - y0, 1.0), 0.0, 1.0)
        height = ball.position[2] * (1.0 - w) + new.position[2] * w
        table = live & events.table
        down = live & ~events.table & (ball.position[2] > 0.0) & (new.position[2] <= 0.0)
        lost = live & (new.position[2] < FLOOR)
        w = jnp.clip(ball.position[2] / jnp.where(down, ball.position[2] - new.position[2], 1.0), 0.0, 1.0)
        ground = ball.position[:2] * (1.0 - w)[None] + new.position[:2] * w[None]
        landing = jnp.where(table, events.position[:2], jnp.where(down, ground, outcome.landing))
        outcome = Return(
            crossed=outcome.crossed | crossing,
            net_height=jnp.where(crossing, height, outcome.net_height),
            returned=outcome.returned | (table & (events.position[1] > 0.0)),
            landing=jnp.where(lost, new.position[:2], landing),
        )
        return where(live, new, ball), live & ~(table | down | lost), outcome

    start = (ball, hit, Return.nowhere(ball))
    lanes = config.lanes and hit.ndim == 1
    return while_any(lambda s: s[1], step, start, take_long_steps(model.ball), limit=config.max_steps, lanes=lanes)[2]
