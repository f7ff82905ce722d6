"""Balls at play: strokes as they come, the episode that each of them begins, outcomes, rallies."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from robot_io.control.episode import Episode, EpisodeSummary
from robot_io.control.rally import Box, RallyCounter, RallyCounts, RallySummary
from robot_io.control.strokes import Seen, Strokes, in_play
from robot_io.devices.ball_datagram import BallSample
from robot_io.limits import LIMITS, JointLimits
from robot_io.log.messages import Event, Level, Record, episode_end, episode_start, json_text

MAX_STEPS = 200  # control ticks of an episode, as in training
REACTION = 0.4  # [s] in which nobody has seen a new ball and pressed a key
IDLE = 0.05  # share of the policy's velocity limits that a robot which "did not react" stays under


@dataclass
class Counts:
    """Since the start; for the operator's view."""

    ticks: int = 0
    balls: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    rallies: RallyCounts = field(default_factory=RallyCounts)


class Play:
    """Strokes, episodes and rallies of one session.

    log         takes records
    on_episode  called with every EpisodeSummary as soon as its outcome is known, on_rally with every RallySummary
    box         what the policy was trained for, None: nothing is out of distribution
    limits      of the robot
    """

    def __init__(
        self,
        log: Callable[[Record], None],
        on_episode: Callable[[EpisodeSummary], None] | None,
        on_rally: Callable[[RallySummary], None] | None,
        box: Box | None = None,
        limits: JointLimits = LIMITS,
    ) -> None:
        self._log, self.on_episode, self.on_rally = log, on_episode, on_rally
        self._rallies = RallyCounter(self._rally_over, box)
        self.strokes = Strokes()
        self.counts = Counts(rallies=self._rallies.counts)
        self.episode: Episode | None = None
        self._waiting: deque[Episode] = deque()  # policy's part over, outcome open
        self._tracks: dict[int, list[tuple[float, ...]]] = {}  # incoming samples by episode
        self._taken = 0  # number of the newest stroke that was played, or is not going to be
        self._slow = IDLE * np.array(limits.policy_velocity)
        self._now = 0.0

    @property
    def following(self) -> list[Episode]:
        """Episodes whose outcome is open."""
        return [e for e in (self.episode, *self._waiting) if e is not None]

    def follow(
        self, sample: BallSample, blade: Callable[[float], np.ndarray], now: float, armed: bool, at_start: bool
    ) -> None:
        """Take an accepted sample that shows the ball.

        blade     the blade's centre (3,) [m] by time
        armed     otherwise no rally is counted
        at_start  the robot has reached its start pose since it was armed
        """
        self._now = now
        found = self.strokes.add(sample)
        if found is not Seen.SAME:
            for episode in self.following:
                episode.superseded(now)
            self.settle(now)
        if found is Seen.STROKE:
            self._log(_stroke(now, self.strokes))
            if self._taken < self.strokes.number - 1:
                self._rallies.not_played(now)
            if armed:
                self._rallies.stroke(self.strokes.began, self.strokes.continued, dummy=not at_start)
            if not armed or not at_start:
                self.pass_over(now)
            return
        self._rallies.follow(sample)
        if self.episode is not None and not self.episode.over and sample.position is not None:
            self._tracks[self.episode.number].append((sample.captured, *sample.position))
        following = self.following
        if following:
            at = blade(sample.captured)
            for episode in following:
                episode.follow(replace(sample, ball=episode.ball), at, now)

    def due(self, now: float) -> bool:
        """True when the human has struck a ball that nobody plays yet, and that is still coming."""
        return self._taken < self.strokes.number and in_play(self.strokes.track, self.strokes.seen, now)

    def pass_over(self, now: float) -> None:
        """Leave the newest stroke's ball alone: it is not taken in mid-flight either."""
        if self._taken < self.strokes.number:
            self._taken = self.strokes.number
            self._rallies.not_played(now)

    def begin(self, ball: int, version: int, now: float) -> Episode:
        """The episode of the newest stroke, played by the policy of that version."""
        self._taken = self.strokes.number
        self.counts.balls += 1
        self.episode = Episode(self.counts.balls, ball, now, version)
        samples = self.strokes.track.samples()
        self.episode.struck(samples)
        self._tracks[self.counts.balls] = [(t, *x) for t, x in samples]
        self._log(episode_start(now, self.episode.number, ball=ball, stroke=self._taken, policy_version=version))
        return self.episode

    def moved(self, velocity: np.ndarray) -> None:
        """Take the measured velocity (8,) of a control tick."""
        if self.episode is not None and (np.abs(velocity) > self._slow).any():
            self.episode.idle = False

    def settle(self, now: float) -> None:
        """Take the policy off a ball that is over and report the outcomes that are known."""
        self._now = now
        if self.episode is not None:
            self.episode.check(now, MAX_STEPS)
            if self.episode.over:
                self._waiting.append(self.episode)
                self.episode = None
        while self._waiting:
            episode = self._waiting[0]
            episode.check(now, MAX_STEPS)
            if not episode.decided:
                break
            self._waiting.popleft()
            self._report(episode.summary(), now)
        self._rallies.check(now)

    def abort(self, cause: str, now: float) -> None:
        """The robot stops: balls and rally end."""
        for episode in self.following:
            episode.abort(cause, now)
        self.settle(now)
        self._rallies.abort(now)
        self._taken = self.strokes.number

    def discard(self, now: float) -> int:
        """Mark the ball in play as not to be used, or, until it has been in play for REACTION, the one before.

        Returns its number, 0 for none.
        """
        seen = [episode for episode in self.following if now - episode.started >= REACTION]
        for episode in seen:
            episode.discarded = True
        unseen = len(self.following) - len(seen)
        return seen[0].number if seen else self.counts.balls - unseen

    def track(self, number: int) -> np.ndarray:
        """(n, 4) t [s], x, y, z [m] of an episode's incoming ball until it was played; in ``on_episode`` only."""
        return np.array(self._tracks.get(number, [])).reshape(-1, 4)

    def _report(self, summary: EpisodeSummary, now: float) -> None:
        self.counts.outcomes[summary.outcome] += 1
        details = {k: v for k, v in asdict(summary).items() if k not in ("number", "outcome", "observed")}
        self._log(episode_end(now, summary.number, summary.outcome, {}, **details))
        try:
            if self.on_episode is not None:
                self.on_episode(summary)
        finally:
            self._tracks.pop(summary.number, None)
            self._rallies.played(summary)

    def _rally_over(self, summary: RallySummary) -> None:
        self._log(Event(self._now, Level.INFO, "rally", json_text(asdict(summary))))
        if self.on_rally is not None:
            self.on_rally(summary)


def _stroke(now: float, strokes: Strokes) -> Event:
    details = {"stroke": strokes.number, "began": strokes.began, "continued": strokes.continued}
    return Event(now, Level.INFO, "stroke", json_text(details))
