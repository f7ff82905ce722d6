"""What a ball in play does, told from the tracker's samples: is it coming, was it hit, where did it land.

The robot's counterpart of the simulator's episode (``mjx_tt.task``), with the same meaning of every outcome.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot_io.tracker import BallSample, Tracker

COMING = -1.0  # [m/s] along y: a ball that comes towards the robot at least this fast is in play
LEAVING = 0.5  # [m/s] a ball that leaves it this fast was hit
SPAN = 0.034  # [s] over which velocities are estimated: five samples at 125 Hz
REACH = 0.35  # [m] between ball and blade when the ball turns round, else it did not touch the blade
BEHIND, BELOW = -2.9, -0.6  # [m] y and z beyond which an incoming ball is out of reach, as in the simulation
BOUNCE_HEIGHT = 0.10  # [m] below which a turn of the vertical speed over the table is a bounce
BALL_RADIUS = 0.020
HALF_WIDTH, HALF_LENGTH = 0.7625, 1.37  # [m] of the table
UNSEEN = 0.25  # [s] without a sight of the ball after which it is out of play
LONGEST_RETURN = 2.5  # [s] after the hit by which the outcome is decided

MISSED, HIT, RETURNED = "missed", "hit", "returned"


@dataclass(frozen=True)
class EpisodeSummary:
    """One ball, from its detection to its outcome; what the reward terms are computed from.

    number      of the episode in its session
    ball        of the ball as the tracker counts
    started     [s] when the policy began, ended [s] when the outcome was known
    steps       control ticks under the policy
    outcome     MISSED, HIT (touched after its bounce) or RETURNED
    closest     [m] least distance of ball and blade centre after the bounce
    crossed     over the net; net_height [m] of its centre there
    landing     (2,) [m] where the outgoing ball came down to the table's height
    fault       cause of the fault that ended it, or None
    discarded   thrown away by the operator
    """

    number: int
    ball: int
    started: float
    ended: float
    steps: int
    outcome: str
    closest: float
    crossed: bool
    net_height: float
    landing: tuple[float, float]
    fault: str | None = None
    discarded: bool = False


def in_play(tracker: Tracker, now: float) -> bool:
    """Whether a ball is coming that the policy should take: over the human's half or the net, towards the robot."""
    if tracker.seen is None or now - tracker.seen > 0.06:
        return False
    newest, slope = tracker.track.newest, tracker.track.slope(SPAN)
    if newest is None or slope is None:
        return False
    position = newest[1]
    return slope[1] < COMING and position[1] > -0.3 and position[2] > -0.35


@dataclass
class Episode:
    """Follows one ball. ``follow`` once per accepted sample, ``check`` once per tick."""

    number: int
    ball: int
    started: float
    steps: int = 0
    bounced: bool = False
    hit: bool = False
    over: bool = False  # the policy's part
    decided: bool = False  # the outcome
    returned: bool = False
    crossed: bool = False
    closest: float = 3.0
    net_height: float = 0.0
    landing: tuple[float, float] = (0.0, -HALF_LENGTH)
    fault: str | None = None
    discarded: bool = False
    ended: float = 0.0
    _last: tuple[float, np.ndarray] | None = None
    _vertical: float = 0.0
    _hit_time: float = 0.0
    _seen: float = field(default=-np.inf)

    def follow(self, sample: BallSample, tracker: Tracker, blade: np.ndarray, now: float) -> None:
        """Takes an accepted sample with the blade's centre (3,) [m] at its capture."""
        if self.decided or sample.position is None:
            return
        if sample.ball != self.ball:
            self._decide(now)
            return
        self._seen = sample.captured
        position, last = sample.position, self._last
        slope = tracker.track.slope(SPAN)
        distance = float(np.linalg.norm(position - blade))
        if not self.over:
            self._incoming(sample.captured, position, slope, distance, now)
        else:
            self._outgoing(sample.captured, position, last, slope, now)
        self._last = (sample.captured, position)
        self._vertical = 0.0 if slope is None else float(slope[2])

    def _incoming(self, time, position, slope, distance: float, now: float) -> None:
        if slope is None:
            return
        y, z = position[1], position[2]
        if self._vertical < 0 < slope[2] and y < 0 and z < BOUNCE_HEIGHT + 0.1 and abs(position[0]) < HALF_WIDTH + 0.05:
            self.bounced = True
        if self.bounced:
            self.closest = min(self.closest, distance)
        newest = None if self._last is None else (position[1] - self._last[1][1]) / max(time - self._last[0], 1e-6)
        # The newest difference sees the turn at once, the fitted slope confirms that it is no noise.
        if newest is not None and newest > LEAVING and slope[1] > COMING and y < 0.2 and self.closest < REACH:
            self.hit, self.over, self._hit_time = self.bounced, True, time
        elif y < BEHIND or z < BELOW:
            self.over = True
            self._decide(now)

    def _outgoing(self, time, position, last, slope, now: float) -> None:
        if last is not None:
            before, previous = last
            if previous[1] < 0.0 <= position[1]:
                share = -previous[1] / (position[1] - previous[1])
                self.crossed = True
                self.net_height = float(previous[2] + share * (position[2] - previous[2]))
            over_table = abs(position[0]) < HALF_WIDTH + 0.02 and abs(position[1]) < HALF_LENGTH + 0.02
            if slope is not None and self._vertical < 0 < slope[2] and position[2] < BOUNCE_HEIGHT + 0.1 and over_table:
                self.landing = (float(position[0]), float(position[1]))
                self.returned = self.hit and self.crossed and position[1] > 0.0
                self._decide(now)
            elif previous[2] > -0.03 >= position[2]:
                self.landing = (float(position[0]), float(position[1]))
                self._decide(now)
        if time - self._hit_time > LONGEST_RETURN:
            self._decide(now)

    def check(self, now: float, max_steps: int) -> None:
        """Ends what has lasted too long or has gone out of sight."""
        if self.decided:
            return
        if not self.over and self.steps >= max_steps:
            self.over = True
        if now - max(self._seen, self.started) > UNSEEN:
            self._decide(now)

    def abort(self, fault: str | None, now: float) -> None:
        """Ends the episode at once."""
        self.fault = fault
        self._decide(now)

    def _decide(self, now: float) -> None:
        self.over, self.decided, self.ended = True, True, now

    def summary(self) -> EpisodeSummary:
        """Raises nothing; meaningful once ``decided``."""
        outcome = RETURNED if self.returned else HIT if self.hit else MISSED
        return EpisodeSummary(
            self.number, self.ball, self.started, self.ended, self.steps, outcome, self.closest, self.crossed,
            self.net_height, self.landing, self.fault, self.discarded,
        )  # fmt: skip
