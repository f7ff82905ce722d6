"""The human's strokes, told from the ball's track alone: one ball may keep its number for a rally, or for none.

A stroke has begun when the ball comes towards the robot, and before it did not: it turned round on the human's side,
it appeared there, or it is another ball. Numbers are only consulted where the track is interrupted, so that a tracker
that gives a number per rally, per stroke or per glimpse sees the same strokes.
"""

from __future__ import annotations

from collections import deque
from enum import Enum

import numpy as np

from ballmodel.constants import GRAVITY
from robot_io.control.kinks import flown
from robot_io.devices.ball_datagram import BallSample
from robot_io.history import History

COMING = -1.0  # [m/s] along y: a ball that comes towards the robot at least this fast is in play
LEAVING = 0.5  # [m/s] a ball that goes back
SPAN = 0.034  # [s] over which velocities are estimated: five samples at 125 Hz
TAIL = 3  # samples that tell a stroke
BENT = 0.025  # [m] of the second difference of y above which three samples are not of one flight: 3 deviations at 3 mm
GAP = 0.06  # [s] without a sight of the ball that interrupts a track
HUMAN_SIDE = 0.05  # [m] least y where a ball turns round at the human's paddle
FARTHEST, LOWEST = -0.3, -0.35  # [m] y and z of a ball beyond which it is too late to play
SAME_BALL = 0.12, 20.0  # [m], [m/s] by which a ball may be away from its last place
RESUMED = 0.35, 2.0  # [m], [m/s] by which a ball that was out of sight may be away from where it flew
LONGEST_GAP = 2.0  # [s] in which a ball out of sight can be the same one
FALLEN = -0.9  # [m] height below which a ball that was out of sight has fallen


class Seen(Enum):
    """Meaning of a sample for the ball that was followed before."""

    SAME = "same"
    OTHER = "other"
    STROKE = "stroke"


class Strokes:
    """The track of the ball since the human struck it; ``add`` once per accepted sample.

    track   samples since the last stroke, the policy's history of the ball
    number  of strokes so far
    began   [s] capture time of the newest stroke's first sample
    seen    [s] capture time of the newest sample
    continued  True when the ball of that stroke was in flight before: what the robot had played
    """

    def __init__(self) -> None:
        self.track = History(length=256, longest_hold=GAP)
        self.number = 0
        self.began, self.continued = -np.inf, False
        self.seen: float | None = None
        self._recent: deque[tuple[float, np.ndarray]] = deque(maxlen=TAIL + 2)  # uninterrupted
        self._coming = self._unbroken = False
        self._ball = -1

    def add(self, sample: BallSample) -> Seen:
        """Take a sample that shows the ball."""
        if sample.position is None:
            return Seen.SAME
        time, position = sample.captured, sample.position
        found = self._compared(time, position, sample.ball)
        self._ball, self.seen = sample.ball, time
        if found is Seen.OTHER:
            self._recent.clear()
            self._coming = self._unbroken = False
            self.track.clear()
        self.track.add(time, position)
        self._recent.append((time, position))
        if len(self._recent) < TAIL:
            return found
        tail = list(self._recent)[-TAIL:]
        speed = (tail[-1][1][1] - tail[0][1][1]) / (tail[-1][0] - tail[0][0])
        if self._coming:
            self._coming = speed < LEAVING
            return found
        turned = len(self._recent) > TAIL
        if not speed < COMING or _bent(tail) or position[2] < LOWEST:
            return found
        if position[1] < FARTHEST or (turned and tail[0][1][1] < HUMAN_SIDE):
            return found
        self._coming = True
        self.number += 1
        self.began = tail[0][0]
        self.continued, self._unbroken = self._unbroken, True
        self.track.clear()
        for then, where in tail:
            self.track.add(then, where)
        return Seen.STROKE

    def _predicted(self, time: float) -> np.ndarray | None:
        """Place (3,) [m] at ``time`` of the ball of the newest samples; None while it is not known."""
        if len(self._recent) < TAIL:
            return None
        (first, start), (last, place) = self._recent[-TAIL], self._recent[-1]
        velocity = (place - start) / (last - first)
        velocity[2] -= 0.5 * GRAVITY * (last - first)
        return flown(place, velocity, min(time - last, LONGEST_GAP))

    def _compared(self, time: float, position: np.ndarray, ball: int) -> Seen:
        """SAME or OTHER; an interrupted track is taken up again, with nothing known of the ball's velocity."""
        if not self._recent:
            return Seen.OTHER if self._ball != ball else Seen.SAME
        last, place = self._recent[-1]
        gone = time - last
        if gone <= GAP:
            near = float(np.linalg.norm(position - place)) < SAME_BALL[0] + SAME_BALL[1] * gone
            return Seen.SAME if near else Seen.OTHER
        expected = self._predicted(time)
        away = np.inf if expected is None else float(np.linalg.norm(position - expected))
        back = position[1] > place[1] + SAME_BALL[0]
        flies = (
            expected is not None
            and gone < LONGEST_GAP
            and expected[2] > FALLEN
            and away < RESUMED[0] + RESUMED[1] * gone
        )
        self._recent.clear()
        if self._coming:  # nobody can have struck it: it lies further on its way, if it is the same
            return Seen.OTHER if back or not (flies or ball == self._ball) else Seen.SAME
        return Seen.SAME if flies else Seen.OTHER


def _bent(tail: list[tuple[float, np.ndarray]]) -> bool:
    """True when the last three samples do not lie on one line in y, whatever the time between them."""
    (t0, p0), (t1, p1), (t2, p2) = tail
    expected = p0[1] + (p2[1] - p0[1]) * (t1 - t0) / (t2 - t0)
    return abs(float(p1[1] - expected)) > 0.5 * BENT


def in_play(track: History, seen: float | None, now: float) -> bool:
    """True when a ball is coming that the policy should take: over the human's half or the net, towards the robot."""
    if seen is None or now - seen > GAP:
        return False
    newest, slope = track.newest, track.slope(SPAN)
    if newest is None or slope is None:
        return False
    position = newest[1]
    return bool(slope[1] < COMING and position[1] > FARTHEST and position[2] > LOWEST)
