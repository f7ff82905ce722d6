"""Rallies, counted from the human's strokes and the outcomes of their balls as the simulator counts them.

The length of a rally is the number of paddle touches of human and robot, the human's first ball included. A stroke goes
on with a rally when the robot had returned the ball and it was in flight: not bounced twice, not fallen. How a rally
ended is the row of the paper's table (``robot_io.rally_ends``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ballmodel.constants import TABLE_LENGTH
from robot_io.control.episode import MISSED, RETURNED, EpisodeSummary
from robot_io.control.kinks import SIDE, bounce_place, find_kink
from robot_io.control.kinks import Seen as Place
from robot_io.devices.ball_datagram import BallSample
from robot_io.rally_ends import BY_ROBOT, FILTERED, TEXTS, End, Evidence

ANSWER_TIME = 1.5  # [s] after a return's bounce within which it is answered, if it is
GRACE = 0.1  # [s] after a ball has died in which a stroke before that may still be told
FLOOR = -0.70  # [m] height of a ball on the floor
GONE = 4.5  # [m] along y: past every player
INSIDE = (0.05, 0.4, 0.05)  # [m], [m/s], [m] by which a measured stroke and its landing may miss the distribution


@dataclass(frozen=True)
class Box:
    """Bounds of the balls that a policy was trained for: position, velocity and landing point, (8,) each."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def holds(self, position: tuple[float, ...], velocity: tuple[float, ...], landing: tuple[float, ...]) -> bool:
        """True for a stroke that lies inside, as well as it was measured."""
        values = np.array([*position, *velocity, *landing])
        slack = np.repeat(INSIDE, (3, 3, 2))
        return bool(((values >= self.low - slack) & (values <= self.high + slack)).all())


@dataclass(frozen=True)
class RallySummary:
    """One rally from its first ball to its end.

    number           in the session
    started, ended   [s]
    length           paddle touches of human and robot
    end              row of the paper's table, by its name in ``End``; text: its words
    by_robot         True where the robot ended it, None where the table does not say
    filtered         it does not count
    episodes         numbers of the balls that the robot played
    """

    number: int
    started: float
    ended: float
    length: int
    end: str
    text: str
    by_robot: bool | None
    filtered: bool
    episodes: tuple[int, ...]


@dataclass
class _Rally:
    started: float
    touches: int = 1
    dummy: bool = False
    episodes: list[int] = field(default_factory=list)
    returned: EpisodeSummary | None = None  # the robot's return that waits for its answer
    over_at: float = np.inf  # [s] when the ball of that return has died


@dataclass
class RallyCounts:
    """Rallies that count, for the operator's view; touches: of the rally in play."""

    rallies: int = 0
    touched: int = 0  # of all of them together
    longest: int = 0
    touches: int = 0
    last: str = ""


class RallyCounter:
    """Follows strokes and outcomes; ``on_rally`` is called with every rally that has ended."""

    def __init__(self, on_rally: Callable[[RallySummary], None], box: Box | None = None) -> None:
        self._on_rally, self._box = on_rally, box
        self.counts = RallyCounts()
        self._rally: _Rally | None = None
        self._number = 0
        self._recent: deque[Place] = deque(maxlen=2 * SIDE + 1)  # of the return's ball

    def stroke(self, began: float, continued: bool, dummy: bool = False) -> None:
        """The human struck a ball at ``began`` [s]; continued: the ball that was in flight before.

        dummy: the robot was not at its start pose yet, so that the ball only shows that it moves there.
        """
        rally = self._rally
        if rally is not None and rally.returned is not None and continued and began <= rally.over_at:
            rally.touches += 1
            rally.returned, rally.over_at = None, np.inf
        else:
            self._close(began, End.HUMAN_BOUNCES)
            self._rally = _Rally(began, dummy=dummy)
        self._recent.clear()
        self._show()

    def played(self, summary: EpisodeSummary) -> None:
        """The outcome of the ball of the newest stroke."""
        rally = self._rally
        if rally is None:
            return
        rally.episodes.append(summary.number)
        first = rally.touches == 1
        rally.touches += summary.outcome != MISSED
        if summary.outcome == RETURNED and summary.fault is None:
            rally.returned, rally.over_at = summary, summary.ended + ANSWER_TIME
        else:
            self._close(summary.ended, self._evidence(summary, first).end())
        self._show()

    def not_played(self, now: float, aborted: bool = False) -> None:
        """Nobody played the newest stroke's ball: the robot took no balls, or was stopped."""
        rally = self._rally
        if rally is not None and rally.returned is None:
            self._close(now, End.ROBOT_MISSED if aborted or rally.touches > 1 else End.NO_REACTION)

    def follow(self, sample: BallSample) -> None:
        """Take an accepted sample of the ball, to see a return die."""
        rally = self._rally
        if rally is None or rally.returned is None or sample.position is None:
            return
        self._recent.append(Place(sample.captured, sample.position, 0.0))
        _, y, z = sample.position
        kink = find_kink(self._recent)
        if kink is not None and bounce_place(kink, self._recent) is not None:  # the second bounce
            rally.over_at = min(rally.over_at, kink.seen.time)
        elif z < FLOOR or abs(y) > GONE:
            rally.over_at = min(rally.over_at, sample.captured)

    def check(self, now: float) -> None:
        """End a rally whose return is not answered."""
        rally = self._rally
        if rally is not None and rally.returned is not None and now > rally.over_at + GRACE:
            self._close(rally.over_at, End.HUMAN_BOUNCES)

    def abort(self, now: float) -> None:
        """The robot stops: a rally in play ends."""
        self._close(now, End.ROBOT_MISSED)

    def _evidence(self, summary: EpisodeSummary, first: bool) -> Evidence:
        landing = summary.bounce or (0.0, -TABLE_LENGTH / 2)
        known = bool(summary.position) and summary.bounce is not None
        inside = not (self._box and known) or self._box.holds(summary.position, summary.velocity, landing)
        true = np.bool_
        return Evidence(
            first=true(first),
            net=true(summary.net),
            own_side=true(summary.human_fault == "own side"),
            valid=true(summary.human_fault is None and summary.bounce is not None),
            landing=np.array(landing),
            hit=true(summary.outcome != MISSED),
            returned=true(summary.outcome == RETURNED),
            fault=true(summary.fault is not None),
            idle=true(summary.idle),
            inside=true(inside),
            grazed=true(summary.grazed),
            came_down=np.array(summary.landing),
        )

    def _close(self, now: float, end: End) -> None:
        rally, self._rally = self._rally, None
        if rally is None:
            return
        if rally.dummy:
            end = End.DUMMY_WITH_PADDLE
        elif rally.returned is not None:
            end = self._evidence(rally.returned, False).end()
        self._number += 1
        counts, filtered = self.counts, end in FILTERED
        counts.touches, counts.last = 0, f"{rally.touches} touches: {TEXTS[end]}"
        if not filtered:
            counts.rallies += 1
            counts.touched += rally.touches
            counts.longest = max(counts.longest, rally.touches)
        self._on_rally(
            RallySummary(
                self._number,
                rally.started,
                now,
                rally.touches,
                end.name,
                TEXTS[end],
                BY_ROBOT[end],
                filtered,
                tuple(rally.episodes),
            )
        )

    def _show(self) -> None:
        self.counts.touches = self._rally.touches if self._rally else 0
