"""Reasons why a rally ended: the rows of the paper's table end_of_rally_attribution, and which one a simulated rally
belongs to."""

from __future__ import annotations

from enum import IntEnum

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Int

from ballmodel import constants as c
from mjx_tt.env.task import HIT, MISSED, RETURNED
from mjx_tt.rally.ball_flights import Meeting, Sent

EDGE = 0.05  # [m] from an edge of the table within which a landing is "to the edge"
CORNER = 0.25  # [m] from a side line and from the end line within which a landing is "at the corner"


class End(IntEnum):
    """Reason why a rally ended: the rows of the paper's table end_of_rally_attribution in order, and what it lacks."""

    FIRST_NET = 0
    FIRST_OVER_TABLE = 1
    FIRST_OUT_OF_DISTRIBUTION = 2
    NO_REACTION = 3
    OUT_OF_DISTRIBUTION = 4
    HUMAN_BOUNCES = 5
    HUMAN_OVER_TABLE = 6
    HUMAN_EDGE = 7
    HUMAN_GRAZES_NET = 8
    SERVICE = 9
    ROBOT_GRAZES_NET = 10
    ROBOT_CORNER = 11
    ROBOT_MISSED = 12
    DUMMY_BY_HAND = 13
    DUMMY_WITH_PADDLE = 14
    ROBOT_OUT = 15
    NONE = 16


# End, the table's words, did the robot end the rally (None: the table does not say), is the rally filtered out.
ROWS = (
    (End.FIRST_NET, "Human hit the first ball to the net.", None, True),
    (End.FIRST_OVER_TABLE, "Human hit the first ball over the table.", None, True),
    (End.FIRST_OUT_OF_DISTRIBUTION, "Human hit the first ball out of distribution, robot did not return.", True, False),
    (End.NO_REACTION, "Human hit the first valid ball and the robot did not react.", None, True),
    (End.OUT_OF_DISTRIBUTION, "Human returning a ball out of distribution, robot did not return.", True, False),
    (
        End.HUMAN_BOUNCES,
        "Human returns a ball that bounces multiple times on the human side (robot has returned the ball).",
        False,
        False,
    ),
    (End.HUMAN_OVER_TABLE, "Human returning a ball over the table.", False, False),
    (End.HUMAN_EDGE, "Human returning a ball to the edge of the table, robot did not return.", True, False),
    (End.HUMAN_GRAZES_NET, "Human hit a ball that graces the net which robot did not contact.", None, True),
    (End.SERVICE, "Human hit a ping pong type service and the robot did not return.", None, True),
    (End.ROBOT_GRAZES_NET, "Robot returns a ball which graces the net, but the human cannot return.", False, False),
    (
        End.ROBOT_CORNER,
        "Robot returns a ball which lands at the corner of the table and the human cannot return.",
        False,
        False,
    ),
    (
        End.ROBOT_MISSED,
        "Rally ends due to the robot cannot contact the ball and/or the encoder diff is high (obvious behavior change "
        "from a previous rally, if applicable)",
        True,
        False,
    ),
    (
        End.DUMMY_BY_HAND,
        "Robot is in ABB home pose, not the episode start state. You throw a dummy ball by hand so that the robot "
        "moves to episode start state.",
        None,
        True,
    ),
    (
        End.DUMMY_WITH_PADDLE,
        "Robot is in ABB home pose, not the episode start state. You throw with a paddle so that the robot moves to "
        "episode start state.",
        None,
        True,
    ),
    (End.ROBOT_OUT, "Robot hit the ball, but not onto the human's half. (Not in the paper's table.)", True, False),
    (End.NONE, "The rally was broken off at the largest number of touches. (Not in the paper's table.)", None, False),
)


def ending(
    first: Bool[Array, " L"],
    sent: Sent,
    outcome: Int[Array, " L"],
    answered: Bool[Array, " L"],
    met: Meeting,
    idle: Bool[Array, " L"],
    inside: Bool[Array, " L"],
) -> Int[Array, " L"]:
    """The table's row with the reason why a rally ended; NONE where the player answered. outcome: of the task."""
    to_net = sent.net & ~sent.valid
    graze = sent.net & sent.valid
    edge = jnp.minimum(c.TABLE_WIDTH / 2 - jnp.abs(sent.landing[0]), sent.landing[1] + c.TABLE_LENGTH / 2) < EDGE
    side, line = c.TABLE_WIDTH / 2 - jnp.abs(met.incoming.landing[0]), c.TABLE_LENGTH / 2 - met.incoming.landing[1]
    corner = (side < CORNER) & (line < CORNER)
    by_human = jnp.where(met.net, End.ROBOT_GRAZES_NET, jnp.where(corner, End.ROBOT_CORNER, End.HUMAN_BOUNCES))
    by_robot = jnp.where(outcome == HIT, End.ROBOT_OUT, End.ROBOT_MISSED)
    cases = (  # the first that applies
        (outcome == RETURNED, by_human),
        (graze, End.HUMAN_GRAZES_NET),
        (first & to_net, End.FIRST_NET),
        (first & sent.own_side, End.SERVICE),
        (first & ~sent.valid, End.FIRST_OVER_TABLE),
        (first & idle & (outcome == MISSED), End.NO_REACTION),
        (first & ~inside, End.FIRST_OUT_OF_DISTRIBUTION),
        # Into the net: the table has no row of its own for it.
        (~sent.valid & sent.own_side & ~to_net, End.HUMAN_BOUNCES),
        (~sent.valid, End.HUMAN_OVER_TABLE),
        (~first & edge, End.HUMAN_EDGE),
        (~inside, End.OUT_OF_DISTRIBUTION),
    )
    end = by_robot
    for condition, row in reversed(cases):
        end = jnp.where(condition, row, end)
    return jnp.where(answered, End.NONE, end)
