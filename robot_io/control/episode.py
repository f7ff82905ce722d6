"""A ball in play, told from the tracker's samples: is it coming, was it hit, where did it land.

The robot's counterpart of the simulator's episode (``mjx_tt.env.task``), with the same meaning of every outcome.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ballmodel.constants import GRAVITY, NET_HEIGHT
from robot_io.control.kinks import (
    DRAG,
    HALF_LENGTH,
    NEAR_TABLE,
    SIDE,
    Kink,
    Seen,
    bounce_place,
    deflection,
    find_kink,
    landing,
    over_table,
    slope,
)
from robot_io.control.strokes import COMING, GAP, LEAVING
from robot_io.devices.ball_datagram import BallSample
from robot_io.safety.faults import NOT_THE_POLICYS

REACH = 0.35  # [m] between ball and blade when the ball turns round, else it did not touch the blade
BEHIND, BELOW = -2.9, -0.6  # [m] y and z beyond which an incoming ball is out of reach, as in the simulation
AT_TABLE = 0.06  # [m] height at which one sample alone tells a bounce: no blade comes as low
DEFLECTED = 2.5  # [m/s] change of velocity by something else than gravity and drag
NET_REACH, NET_TOP = 0.15, 0.25  # [m] from the net's plane and above the table, where a deflection is the net's
CORD = 0.06  # [m] above the net's edge to which the net can deflect the centre of a ball
UNSEEN = 0.25  # [s] without a sight of the ball after which it is out of play
LONGEST_RETURN = 2.5  # [s] after the hit by which the outcome is decided
FARTHEST = 3.0  # [m] of ball and blade, also where the blade's place is not known
LAUNCH = 8  # samples from which the human's stroke is estimated

NET, OWN_SIDE, LONG, LOST = "net", "own side", "long", "lost"  # faults of the human
MISSED, HIT, RETURNED = "missed", "hit", "returned"
STOPPED = "stopped"  # the operator's stop, in place of a fault's cause
_REPEATED = {STOPPED, *(cause.value for cause in NOT_THE_POLICYS)}


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
    fault       cause of the fault that ended it, STOPPED, or None
    discarded   thrown away by the operator
    policy_version  of the policy that played it, as its owner counts
    human_fault NET, OWN_SIDE, LONG or LOST (out of sight before it came down): no valid ball; None: a valid one
    position    (3,) [m] and velocity (3,) [m/s] of the human's stroke, from its first samples
    bounce      (2,) [m] where it came down on the robot's half, or None
    net         it touched the net on its way to the robot; grazed: on its way back
    idle        the robot did not react
    observed    (2 n,) sums of the policy's n observed numbers over its steps, then of their squares
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
    human_fault: str | None = None
    position: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    bounce: tuple[float, ...] | None = None
    net: bool = False
    grazed: bool = False
    idle: bool = False
    observed: tuple[float, ...] = ()

    @property
    def unfit(self) -> bool:
        """It says nothing about the policy, and is to be played again: discarded, stopped, no valid ball of the human,
        or ended by a fault of tracker, network, computer or operator."""
        return self.discarded or self.human_fault is not None or self.fault in _REPEATED


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
    human_fault: str | None = None
    bounce: tuple[float, float] | None = None
    net: bool = False
    grazed: bool = False
    idle: bool = True  # until the robot moves
    observed: np.ndarray | float = 0.0  # (2, n) sums of what the policy saw and of its squares
    _launch: list[Seen] = field(default_factory=list)
    _recent: deque[Seen] = field(default_factory=lambda: deque(maxlen=2 * SIDE + 1))
    _turned: float = -np.inf  # time of the first sample after the hit
    _seen: float = -np.inf

    def struck(self, samples: list[tuple[float, np.ndarray]]) -> None:
        """Take the samples (times [s], positions (3,) [m]) from the human's stroke until now."""
        self._launch = [Seen(time, position, FARTHEST) for time, position in samples[:LAUNCH]]

    def saw(self, observation: np.ndarray) -> None:
        """Count a step of the policy with what it saw, (n,)."""
        self.steps += 1
        self.observed = self.observed + np.array([observation, np.square(observation)], float)

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
        seen = Seen(sample.captured, sample.position, distance)
        self._recent.append(seen)
        if len(self._launch) < LAUNCH and not (self.over or self.bounced or self.net):
            self._launch.append(seen)
        if not self.over:
            self._incoming(last, seen, now)
        elif last is not None:
            self._outgoing(last, seen, now)

    def _incoming(self, last: Seen | None, seen: Seen, now: float) -> None:
        kink, near = find_kink(self._recent), min(s.distance for s in self._recent) < REACH
        place = None if kink is None else bounce_place(kink, self._recent)
        if self._turns(last, seen) and near:
            self._touched(seen, now)
            return
        if place is not None:
            if self.bounced or place[1] > 0.0:  # twice on the robot's side, or on the human's
                self._lose(None if self.bounced else OWN_SIDE, now)
                return
            self.bounced, self.bounce = True, (float(place[0]), float(place[1]))
            self.closest = min(s.distance for s in list(self._recent)[SIDE:])
        elif kink is not None and _deflected(kink):
            _, y, z = kink.seen.position
            if not self.bounced and abs(y) < NET_REACH and z < NET_TOP:
                self.net = True
                if kink.after[1] > COMING:  # a cord ball that still comes is played
                    self._lose(NET, now)
                    return
            if kink.seen.distance < REACH:  # off the blade, but not turned round
                self._touched(seen, now)
                return
        if self.bounced:
            self.closest = min(self.closest, seen.distance)
        if seen.position[1] < BEHIND or seen.position[2] < BELOW:
            self._lose(None if self.bounced else LONG, now)

    def _turns(self, last: Seen | None, seen: Seen) -> bool:
        """True when the ball leaves the robot: the newest difference shows it at once, the fit excludes noise."""
        if last is None or seen.position[1] > 0.2 or len(self._recent) < SIDE:
            return False
        newest = (seen.position[1] - last.position[1]) / (seen.time - last.time)
        return newest > LEAVING and slope(list(self._recent)[-5:])[1] > COMING

    def _touched(self, seen: Seen, now: float) -> None:
        self.over, self._turned = True, seen.time
        lowest = min(self._recent, key=lambda s: s.position[2])
        if not self.bounced and lowest is not seen and lowest.position[2] < AT_TABLE and over_table(lowest.position):
            self.bounced, self.closest = True, 0.0  # just before
            self.bounce = (float(lowest.position[0]), float(lowest.position[1]))
        self.hit = self.bounced
        if self.hit:
            self.closest = min(self.closest, *(s.distance for s in list(self._recent)[-SIDE:]))
        else:
            # A volley: the point is lost, and whose fault it was says where the ball would have come down.
            there = None if self.net else self._would_land()
            self._lose(LONG if there is not None and not over_table(there) else None, now)

    def _outgoing(self, last: Seen, seen: Seen, now: float) -> None:
        before, position = last.position, seen.position
        if before[1] < 0.0 <= position[1]:
            share = -before[1] / (position[1] - before[1])
            self.crossed = True
            self.net_height = float(before[2] + share * (position[2] - before[2]))
        kink = find_kink(self._recent)
        place = None if kink is None or kink.seen.time <= self._turned else bounce_place(kink, self._recent)
        self.grazed |= kink is not None and place is None and _at_net(kink) and deflection(kink) > DEFLECTED
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
            self._out_of_sight(now)

    def abort(self, fault: str | None, now: float) -> None:
        """Ends the episode at once; what was decided before stays."""
        if not self.decided:
            self.fault = fault
            self._decide(now)

    def superseded(self, now: float) -> None:
        """Decide at once: another ball is in play, or the human struck this one again."""
        if not self.decided:
            self._out_of_sight(now)

    def _out_of_sight(self, now: float) -> None:
        """Decide for a ball that is not seen any more: a return came down where it was flying to."""
        samples = list(self._recent)
        gaps = [i for i in range(1, len(samples)) if samples[i].time - samples[i - 1].time > GAP]
        samples = samples[: gaps[0] if gaps else None][-SIDE:]  # after a gap it may have been struck already
        if self.hit and self.crossed and len(samples) == SIDE and samples[0].time > self._turned:
            velocity = slope(samples)
            velocity[2] -= 0.5 * GRAVITY * (samples[-1].time - samples[0].time)
            place = landing(samples[-1].position, velocity)
            self.landing = (float(place[0]), float(place[1]))
            self.returned = over_table(place) and place[1] > 0.0
        self._lose(None if self.bounced or self.over else LOST, now)

    def _lose(self, human_fault: str | None, now: float) -> None:
        self.human_fault = human_fault
        self._decide(now)

    def _would_land(self) -> np.ndarray | None:
        """Place (2,) [m] where the human's ball would have come down, from its first samples, with drag."""
        start = self._stroke()
        if start is None:
            return None
        return landing(*start)

    def _stroke(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Position (3,) [m] and velocity (3,) [m/s] at the first sample; None with under three samples."""
        samples = self._launch
        if len(samples) < SIDE:
            return None
        velocity = slope(samples)  # in the middle
        half = 0.5 * (samples[-1].time - samples[0].time)
        velocity = velocity + half * (DRAG * float(np.linalg.norm(velocity)) * velocity)
        velocity[2] += GRAVITY * half
        return samples[0].position, velocity

    def _decide(self, now: float) -> None:
        self.over, self.decided, self.ended = True, True, now

    def summary(self) -> EpisodeSummary:
        """Raises nothing; meaningful once ``decided``."""
        outcome = RETURNED if self.returned else HIT if self.hit else MISSED
        position, velocity = self._stroke() or (np.zeros(0), np.zeros(0))
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
            self.human_fault if self.fault is None else None,
            tuple(position.tolist()),
            tuple(velocity.tolist()),
            self.bounce,
            self.net,
            self.grazed,
            self.idle,
            tuple(np.ravel(self.observed).tolist()) if self.steps else (),
        )


def _deflected(kink: Kink) -> bool:
    """True for a change by something else than gravity, drag and the table, which takes little of the speed along y."""
    slowed = kink.after[1] - kink.before[1] > DEFLECTED
    return bool(deflection(kink) > DEFLECTED and (kink.seen.position[2] > NEAR_TABLE or slowed))


def _at_net(kink: Kink) -> bool:
    return bool(abs(kink.seen.position[1]) < NET_REACH and kink.seen.position[2] < NET_HEIGHT + CORD)
