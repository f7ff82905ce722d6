"""Rows of the paper's table by one ball each, told by the simulator and by the bridge."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel.state import BallState
from mjx_tt.env.episode import HIT, MISSED, RETURNED
from mjx_tt.rally.ball_flights import Meeting, Sent
from mjx_tt.rally.end_reasons import End, find_end
from mjx_tt.rally.human_player import Incoming
from robot_io.control import episode
from robot_io.control.rally import RallyCounter
from robot_io.rally_ends import FILTERED

LANDING, MIDDLE = (0.3, -0.9), (0.0, 0.7)  # [m] of the human's ball, of the robot's return
ENDING = jax.jit(find_end)
OUTCOMES = {MISSED: episode.MISSED, HIT: episode.HIT, RETURNED: episode.RETURNED}


@dataclass(frozen=True)
class Ball:
    """A human's ball and the robot's part of it."""

    first: bool = False
    net: bool = False
    fault: str | None = None  # of the human: none is a valid ball
    outcome: int = MISSED
    stopped: bool = False  # a fault of the robot
    idle: bool = False


CASES = {
    "a net ball that the robot hit, but did not return": (Ball(net=True, outcome=HIT), End.ROBOT_OUT),
    "the same as first ball": (Ball(first=True, net=True, outcome=HIT), End.ROBOT_OUT),
    "a net ball that the robot did not contact": (Ball(net=True), End.HUMAN_GRAZES_NET),
    "the same as first ball, not contacted": (Ball(first=True, net=True), End.HUMAN_GRAZES_NET),
    "a fault during a net ball": (Ball(net=True, stopped=True), End.ROBOT_MISSED),
    "a fault during a service": (Ball(first=True, fault=episode.OWN_SIDE, stopped=True), End.ROBOT_MISSED),
    "a service": (Ball(first=True, fault=episode.OWN_SIDE), End.SERVICE),
    "a fault during a first ball into the net": (
        Ball(first=True, net=True, fault=episode.NET, stopped=True),
        End.ROBOT_MISSED,
    ),
    "a first ball into the net": (Ball(first=True, net=True, fault=episode.NET), End.FIRST_NET),
    "a fault during a first ball over the table": (
        Ball(first=True, fault=episode.LONG, stopped=True),
        End.ROBOT_MISSED,
    ),
    "a first ball over the table": (Ball(first=True, fault=episode.LONG), End.FIRST_OVER_TABLE),
    "a fault of a robot that hardly moved": (Ball(first=True, idle=True, stopped=True), End.ROBOT_MISSED),
    "no reaction": (Ball(first=True, idle=True), End.NO_REACTION),
    "a ball that the robot missed": (Ball(), End.ROBOT_MISSED),
}


def simulated(ball: Ball) -> End:
    """The row by the simulator, in a compiled call of one lane."""

    def lane(value: bool) -> jax.Array:
        return jnp.full(1, value)

    def column(place: tuple[float, float]) -> jax.Array:
        return jnp.asarray(place)[:, None]

    point = jnp.zeros((3, 1))
    incoming = Incoming(BallState(point, point, point), column(MIDDLE), jnp.zeros(1))
    sent = Sent(lane(ball.net), lane(ball.fault == episode.OWN_SIDE), lane(ball.fault is None), column(LANDING))
    met = Meeting(incoming, lane(False), lane(False))
    end = ENDING(
        lane(ball.first),
        sent,
        lane(ball.outcome),
        lane(ball.stopped),
        lane(False),
        met,
        lane(ball.idle),
        lane(True),
    )
    return End(int(np.asarray(end)[0]))


def on_the_robot(ball: Ball) -> tuple[End, bool]:
    """The row by the bridge, and True where it filters the rally."""

    def summary(number: int, **changes) -> episode.EpisodeSummary:
        told = {"bounce": LANDING, "landing": MIDDLE, "outcome": episode.RETURNED} | changes
        return episode.EpisodeSummary(
            number, number, float(number), number + 0.5, 40, closest=0.1, crossed=False, net_height=0.2, **told
        )

    over = []
    counter = RallyCounter(over.append)
    counter.stroke(0.0, False)
    if not ball.first:
        counter.played(summary(1))
        counter.stroke(2.0, True)
    counter.played(
        summary(
            2,
            outcome=OUTCOMES[ball.outcome],
            fault="collision" if ball.stopped else None,
            human_fault=ball.fault,
            bounce=LANDING if ball.fault is None else None,
            net=ball.net,
            idle=ball.idle,
        )
    )
    (rally,) = over
    return End[rally.end], rally.filtered


@pytest.mark.parametrize("case", CASES)
def test_simulator_and_bridge_tell_the_same_row(case):
    ball, end = CASES[case]
    assert simulated(ball) == end
    assert on_the_robot(ball) == (end, end in FILTERED)
