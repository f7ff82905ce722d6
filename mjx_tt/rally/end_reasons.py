"""Attribution of many simulated rallies at once: ``robot_io.rally_ends`` on arrays."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from mjx_tt.env.episode import HIT, RETURNED
from mjx_tt.rally.ball_flights import Meeting, Sent
from robot_io.rally_ends import ROWS as ROWS
from robot_io.rally_ends import End as End
from robot_io.rally_ends import Evidence


def find_end(
    first: Bool[Array, " L"],
    sent: Sent,
    outcome: Int[Array, " L"],
    fault: Bool[Array, " L"],
    answered: Bool[Array, " L"],
    met: Meeting,
    idle: Bool[Array, " L"],
    inside: Bool[Array, " L"],
) -> Int[Array, " L"]:
    """The table's row with the reason why a rally ended; NONE where the player answered. outcome: of the task."""
    evidence = Evidence(
        first=first,
        net=sent.net,
        own_side=sent.own_side,
        valid=sent.valid,
        landing=sent.landing,
        hit=outcome >= HIT,
        returned=outcome == RETURNED,
        fault=fault,
        idle=idle,
        inside=inside,
        grazed=met.net,
        came_down=met.incoming.landing,
    )
    end = jnp.full(first.shape, End.ROBOT_MISSED)
    for condition, row in reversed(evidence.cases()):
        end = jnp.where(condition, row, end)
    return jnp.where(answered, End.NONE, end)
