"""A ball in play, told from the tracker's samples: is it coming, was it hit, where did it land.

The robot's counterpart of the simulator's episode (``mjx_tt.env.task``), with the same meaning of every outcome.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ballmodel.constants import GRAVITY, TABLE_LENGTH, TABLE_WIDTH
from robot_io.devices.tracker import BallSample, Tracker

COMING = -1.0  # [m/s] along y: a ball that comes towards the robot at least this fast is in play
LEAVING = 0.5  # [m/s] a ball that leaves it this fast was hit
SPAN = 0.034  # [s] over which velocities are estimated: five samples at 125 Hz
REACH = 0.35  # [m] between ball and blade when the ball turns round, else it did not touch the blade
BEHIND, BELOW = -2.9, -0.6  # [m] y and z beyond which an incoming ball is out of reach, as in the simulation
NEAR_TABLE = 0.12  # [m] height at which the lowest sample of a bounce can be: 125 Hz, two frames lost
AT_TABLE = 0.06  # [m] height at which one sample alone tells a bounce: no blade comes as low
UPWARD = 1.0  # [m/s] gained by the vertical speed in a bounce; a fit over three samples is good to 0.3 m/s
DEFLECTED = 2.5  # [m/s] change of velocity by something else than gravity and drag
EDGE = 0.02  # [m] by which a bounce may seem to miss the table
NET_REACH, NET_TOP = 0.15, 0.25  # [m] from the net's plane and above the table, where a deflection is the net's
UNSEEN = 0.25  # [s] without a sight of the ball after which it is out of play
LONGEST_RETURN = 2.5  # [s] after the hit by which the outcome is decided
HALF_WIDTH, HALF_LENGTH = TABLE_WIDTH / 2, TABLE_LENGTH / 2  # [m]
FARTHEST = 3.0  # [m] of ball and blade, also where the blade's place is not known
SIDE = 3  # samples before and after a moment in which a change of velocity is looked for
LONGEST_WINDOW = 0.12  # [s] of these samples together

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
    policy_version  of the policy that played it, as its owner counts
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
    policy_version: int = 0


def in_play(tracker: Tracker, now: float) -> bool:
    """True when a ball is coming that the policy should take: over the human's half or the net, towards the robot."""
    if tracker.seen is None or now - tracker.seen > 0.06:
        return False
    newest, slope = tracker.track.newest, tracker.track.slope(SPAN)
    if newest is None or slope is None:
        return False
    position = newest[1]
    return slope[1] < COMING and position[1] > -0.3 and position[2] > -0.35


@dataclass(frozen=True)
class _Seen:
    time: float
    position: np.ndarray
    distance: float  # [m] from the blade's centre


@dataclass(frozen=True)
class _Kink:
    """Change of the velocity (3,) at ``seen``, from ``before`` to ``after``, gravity taken out."""

    seen: _Seen
    before: np.ndarray
    after: np.ndarray
    lowest: bool  # of the samples around


@dataclass
class Episode:
    """Follows one ball. ``follow`` once per accepted sample, ``check`` once per tick.

    Bounces are told from the change of the velocity and so three samples late; a hit at once.
    """

    number: int
    ball: int
    started: float
    policy_version: int = 0
    steps: int = 0
    bounced: bool = False
    hit: bool = False
    over: bool = False  # the policy's part
    decided: bool = False  # the outcome
    returned: bool = False
    crossed: bool = False
    closest: float = FARTHEST
    net_height: float = 0.0
    landing: tuple[float, float] = (0.0, -HALF_LENGTH)
    fault: str | None = None
    discarded: bool = False
    ended: float = 0.0
    _recent: deque[_Seen] = field(default_factory=lambda: deque(maxlen=2 * SIDE + 1))
    _turned: float = -np.inf  # time of the first sample after the hit
    _seen: float = -np.inf

    def follow(self, sample: BallSample, blade: np.ndarray, now: float) -> None:
        """Take an accepted sample with the blade's centre (3,) [m] at its capture, infinite where it is not known."""
        if self.decided or sample.position is None:
            return
        if sample.ball != self.ball:
            self._decide(now)
            return
        self._seen = sample.captured
        last = self._recent[-1] if self._recent else None
        distance = min(float(np.linalg.norm(sample.position - blade)), FARTHEST)
        seen = _Seen(sample.captured, sample.position, distance)
        self._recent.append(seen)
        if not self.over:
            self._incoming(last, seen, now)
        elif last is not None:
            self._outgoing(last, seen, now)

    def _incoming(self, last: _Seen | None, seen: _Seen, now: float) -> None:
        kink, near = _kink(self._recent), min(s.distance for s in self._recent) < REACH
        place = None if kink is None else _bounce(kink, self._recent)
        if self._turns(last, seen) and near:
            self._touched(seen, now)
            return
        if place is not None:
            if self.bounced or place[1] > 0.0:  # twice on the robot's side, or on the human's
                self._decide(now)
                return
            self.bounced = True
            self.closest = min(s.distance for s in list(self._recent)[SIDE:])
        elif kink is not None and _deflection(kink) > DEFLECTED and kink.seen.position[2] > NEAR_TABLE:
            x, y, z = kink.seen.position
            if abs(y) < NET_REACH and z < NET_TOP:
                self._decide(now)
                return
            if kink.seen.distance < REACH:  # off the blade, but not turned round
                self._touched(seen, now)
                return
        if self.bounced:
            self.closest = min(self.closest, seen.distance)
        if seen.position[1] < BEHIND or seen.position[2] < BELOW:
            self._decide(now)

    def _turns(self, last: _Seen | None, seen: _Seen) -> bool:
        """True when the ball leaves the robot: the newest difference shows it at once, the fit excludes noise."""
        if last is None or seen.position[1] > 0.2 or len(self._recent) < SIDE:
            return False
        newest = (seen.position[1] - last.position[1]) / (seen.time - last.time)
        return newest > LEAVING and _slope(list(self._recent)[-5:])[1] > COMING

    def _touched(self, seen: _Seen, now: float) -> None:
        self.over, self._turned = True, seen.time
        lowest = min(self._recent, key=lambda s: s.position[2])
        if not self.bounced and lowest is not seen and lowest.position[2] < AT_TABLE and _over_table(lowest.position):
            self.bounced, self.closest = True, 0.0  # just before
        self.hit = self.bounced
        if self.hit:
            self.closest = min(self.closest, *(s.distance for s in list(self._recent)[-SIDE:]))
        else:
            self._decide(now)  # a volley: the point is lost

    def _outgoing(self, last: _Seen, seen: _Seen, now: float) -> None:
        before, position = last.position, seen.position
        if before[1] < 0.0 <= position[1]:
            share = -before[1] / (position[1] - before[1])
            self.crossed = True
            self.net_height = float(before[2] + share * (position[2] - before[2]))
        kink = _kink(self._recent)
        place = None if kink is None or kink.seen.time <= self._turned else _bounce(kink, self._recent)
        if place is not None:
            self.landing = (float(place[0]), float(place[1]))
            self.returned = self.hit and self.crossed and place[1] > 0.0
            self._decide(now)
        elif before[2] > -0.03 >= position[2]:
            self.landing = (float(position[0]), float(position[1]))
            self._decide(now)
        elif seen.time - self._turned > LONGEST_RETURN:
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
        """Ends the episode at once; what was decided before stays."""
        if not self.decided:
            self.fault = fault
            self._decide(now)

    def _decide(self, now: float) -> None:
        self.over, self.decided, self.ended = True, True, now

    def summary(self) -> EpisodeSummary:
        """Raises nothing; meaningful once ``decided``."""
        outcome = RETURNED if self.returned else HIT if self.hit else MISSED
        return EpisodeSummary(
            self.number,
            self.ball,
            self.started,
            self.ended,
            self.steps,
            outcome,
            self.closest,
            self.crossed,
            self.net_height,
            self.landing,
            self.fault,
            self.discarded,
            self.policy_version,
        )


def _slope(samples: list[_Seen]) -> np.ndarray:
    """Velocity (3,) [m/s] in the middle of at least two samples, by least squares; gravity does not bias it."""
    t = np.array([s.time for s in samples])
    t = t - t.mean()
    return t @ np.stack([s.position for s in samples]) / (t @ t)


def _kink(recent: deque[_Seen]) -> _Kink | None:
    """The change of velocity at the middle sample; None while there are too few around it."""
    if len(recent) < 2 * SIDE + 1 or recent[-1].time - recent[0].time > LONGEST_WINDOW:
        return None
    samples = list(recent)
    first, middle, last = samples[:SIDE], samples[SIDE], samples[SIDE + 1 :]
    before, after = _slope(first), _slope(last)
    before[2] -= GRAVITY * (middle.time - np.mean([s.time for s in first]))
    after[2] += GRAVITY * (np.mean([s.time for s in last]) - middle.time)
    lowest = min(s.position[2] for s in samples) == middle.position[2]
    return _Kink(middle, before, after, lowest)


def _deflection(kink: _Kink) -> float:
    return float(np.linalg.norm(kink.after - kink.before))


def _bounce(kink: _Kink, recent: deque[_Seen]) -> np.ndarray | None:
    """Place (2,) [m] where the ball touched the table; None where the kink is no bounce on it."""
    if not kink.lowest or kink.seen.position[2] > NEAR_TABLE or kink.after[2] - kink.before[2] < UPWARD:
        return None
    # Between its neighbours, where the parabolas before and after meet: both bend alike, so their chords do.
    samples = list(recent)
    sides = []
    for part, speed in ((samples[:SIDE], kink.before[2]), (samples[SIDE + 1 :], kink.after[2])):
        t = np.array([s.time for s in part]) - kink.seen.time
        z = np.array([s.position[2] for s in part])
        sides.append(float(np.mean(z + 0.5 * GRAVITY * t * t - speed * t)))
    low, high = samples[SIDE - 1].time, samples[SIDE + 1].time
    moment = kink.seen.time + (sides[0] - sides[1]) / (kink.after[2] - kink.before[2])
    moment = min(max(moment, low), high)
    times = [s.time for s in samples]
    place = np.array([np.interp(moment, times, [s.position[i] for s in samples]) for i in range(2)])
    return place if _over_table(place) else None


def _over_table(place: np.ndarray) -> bool:
    return abs(place[0]) < HALF_WIDTH + EDGE and abs(place[1]) < HALF_LENGTH + EDGE
