"""Reasons why a rally ended: the rows of the paper's table end_of_rally_attribution, and which one a rally belongs to.

Counted alike by the simulator, on arrays of rallies, and by the bridge, one rally at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from ballmodel import constants as c

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
FILTERED = frozenset(end for end, _, _, filtered in ROWS if filtered)  # these rallies do not count
TEXTS = {end: text for end, text, _, _ in ROWS}
BY_ROBOT = {end: by_robot for end, _, by_robot, _ in ROWS}


@dataclass(frozen=True)
class Evidence:
    """Observations from which an end is told: NumPy scalars for one rally, arrays of NumPy or JAX for many.

    first          the ball started the rally
    net, own_side  the human's ball touched the net, bounced on the human's half
    valid          it came down on the robot's half, from above and without a bounce before
    landing        (2, ...) [m] there
    hit, returned  by the robot: touched after the bounce, landed on the human's half
    fault          the robot stopped itself
    idle           the robot did not react
    inside         the ball was one of the distribution that the policy was trained for
    grazed         the robot's return touched the net
    came_down      (2, ...) [m] where the robot's return landed
    """

    first: Any
    net: Any
    own_side: Any
    valid: Any
    landing: Any
    hit: Any
    returned: Any
    fault: Any
    idle: Any
    inside: Any
    grazed: Any
    came_down: Any

    def cases(self) -> tuple[tuple[Any, End], ...]:
        """Conditions and their rows, of which the first that holds counts; without one the row is ROBOT_MISSED."""
        first, sent, valid, returned = self.first, self.landing, self.valid, self.returned
        edge = (c.TABLE_WIDTH / 2 - abs(sent[0]) < EDGE) | (sent[1] + c.TABLE_LENGTH / 2 < EDGE)
        corner = (c.TABLE_WIDTH / 2 - abs(self.came_down[0]) < CORNER) & (
            c.TABLE_LENGTH / 2 - self.came_down[1] < CORNER
        )
        return (
            (self.fault, End.ROBOT_MISSED),  # whatever became of the ball
            (returned & self.grazed, End.ROBOT_GRAZES_NET),
            (returned & corner, End.ROBOT_CORNER),
            (returned, End.HUMAN_BOUNCES),
            (self.net & valid & ~self.hit, End.HUMAN_GRAZES_NET),
            (first & self.net & ~valid, End.FIRST_NET),
            (first & self.own_side, End.SERVICE),
            (first & ~valid, End.FIRST_OVER_TABLE),
            (first & self.idle & ~self.hit, End.NO_REACTION),
            (first & ~self.inside, End.FIRST_OUT_OF_DISTRIBUTION),
            # Into the net: the table has no row of its own for it.
            (~valid & self.own_side & ~self.net, End.HUMAN_BOUNCES),
            (~valid, End.HUMAN_OVER_TABLE),
            (~first & edge, End.HUMAN_EDGE),
            (~self.inside, End.OUT_OF_DISTRIBUTION),
            (self.hit, End.ROBOT_OUT),
        )

    def end(self) -> End:
        """The row of one rally."""
        return next((row for condition, row in self.cases() if condition), End.ROBOT_MISSED)
