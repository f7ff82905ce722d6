"""The tracker's frame against what every ball shows: how it falls, where it bounces, where it passes the net.

Before the robot is armed somebody throws a few balls from the player's end, so that each bounces on the robot's half.
All later balls must agree. What bounces cannot show is x mirrored, or moved by less than the table's edges tell: a ball
held at known places decides that, once (``mjx-tt robot commission``).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ballmodel.constants import BALL_RADIUS, GRAVITY, TABLE_HEIGHT
from ballmodel.table_frame import Signs, acceleration, describe_fall
from robot_io.devices.ball_datagram import BallSample

NEEDED = 3  # balls that bounce where they must before the robot is armed
KEPT = 8  # balls that count
LEVEL, MARGIN = 0.05, 0.06  # [m] by which a bounce may miss the table's height, and its edges
SIDE = 4  # samples on either side of a kink that tell its velocities
KINK = 1.5  # [m/s] of a velocity's change that ends a free flight: 6 deviations at 3 mm
LONGEST_GAP = 0.06  # [s] between two samples of one track
LONGEST = 250  # samples of a track that is looked at as a whole
FLIGHT = 0.15  # [s] of the shortest free flight that tells a fall
ROUGH = 0.01, 0.02  # [m], and share of its way, root mean square, by which a free flight may miss a parabola
WRONG = "the tracker's frame is not the table's"
FLOWN = 0.4  # [m] of the way before the first bounce that tells where a ball comes from


@dataclass(frozen=True)
class Seen:
    """Signs of one ball. bounces (3, b), path (3, k), way (3,) [m] to the first bounce; falls: [m/s^2] of flights."""

    bounces: np.ndarray
    path: np.ndarray
    way: np.ndarray
    falls: tuple[tuple[np.ndarray, np.ndarray], ...]


class FrameCheck:
    """Takes the tracker's accepted samples of one session.

    needed   balls that must have shown the frame before the robot is armed
    problem  how the balls contradict the frame, as a sentence; None: they do not
    shown    balls so far that bounced where they must
    """

    def __init__(self, needed: int = NEEDED) -> None:
        self.needed = needed
        self.restart()

    def restart(self) -> None:
        """Forget every ball."""
        self.problem: str | None = None
        self.shown = 0
        self._balls: deque[Seen] = deque(maxlen=KEPT)
        self._track: list[tuple[float, np.ndarray]] = []

    @property
    def wanted(self) -> str | None:
        """What has to happen before the robot is armed; None: nothing."""
        if self.shown >= self.needed:
            return None
        bounced = [seen.bounces[:, -1] for seen in self._balls if seen.bounces.size]
        last = " (the last one bounced at {:+.2f} {:+.2f} {:+.2f} m)".format(*bounced[-1]) if bounced else ""
        return (
            f"{self.shown} of {self.needed} balls have shown the tracker's frame{last}: throw them one by one from the "
            "player's end, so that each bounces on the robot's half"
        )

    def add(self, sample: BallSample) -> bool:
        """Take a sample; True when it ended a track that was looked at."""
        track = self._track
        gone = sample.position is None or (track and sample.captured - track[-1][0] > LONGEST_GAP)
        looked = bool(gone or len(track) >= LONGEST) and len(track) > 2 * SIDE
        if gone or looked:
            self._track = []
        if looked:
            self._look(np.array([t for t, _ in track]), np.array([p for _, p in track]).T)
        if sample.position is not None:
            self._track.append((sample.captured, sample.position))
        return looked

    def _look(self, time: np.ndarray, position: np.ndarray) -> None:
        seen = signs_of(time, position)
        if not (seen.bounces.size or seen.falls):
            return  # held or carried
        self._balls.append(seen)
        self.problem = self._judge()
        _, y, z = seen.bounces
        fits = ~Signs(seen.bounces, ()).off(LEVEL, MARGIN) & (y < MARGIN) & (np.abs(z - BALL_RADIUS) < LEVEL)
        self.shown += bool(fits.any() and _comes(seen.way))

    def _judge(self) -> str | None:
        """The contradiction that at least half of three or more balls show."""
        known = self.shown >= NEEDED  # then units and directions are, and spin or strokes are no sign of others
        falls = [fall for seen in self._balls for fall in seen.falls]
        if not known and len(falls) >= NEEDED:
            bend, fall = (np.median(part, axis=0) for part in zip(*falls, strict=True))
            if wrong := describe_fall(bend, fall):
                return f"{WRONG}: {wrong}"
        bounced = [seen for seen in self._balls if seen.bounces.size]
        if len(bounced) < NEEDED:
            return None
        signs = Signs(np.concatenate([s.bounces for s in bounced], axis=1), tuple(s.path for s in bounced))
        off, (x, y, z) = signs.off(LEVEL, MARGIN), np.median(signs.bounces, axis=1)
        place = f"{WRONG}: the median bounce is at x = {x:.2f}, y = {y:.2f}, z = {z:.3f} m"
        if 2 * off.sum() >= off.size:
            above = z - BALL_RADIUS
            if abs(above - TABLE_HEIGHT) < 2 * LEVEL:
                return f"{place}; is z measured from the floor?"
            if abs(above) > LEVEL:
                return f"{place}, {above:+.2f} m from where a ball on the table is: is it moved, or tilted?"
            return f"{place}; half of the bounces are beside the table: is it moved or turned?"
        if 2 * signs.low() > max(signs.passages(), NEEDED):
            return f"{WRONG}: {signs.low()} balls pass below the net's edge"
        ways = np.array([s.way for s in bounced if np.hypot(*s.way[:2]) > FLOWN])
        if known or self.shown or len(ways) < NEEDED:
            return None
        along, across = np.median(ways[:, 1]), np.median(np.abs(ways[:, 0]))
        if across > abs(along):
            return f"{WRONG}: balls fly along x; is it turned by 90 degrees about z?"
        if along > 0.0:
            return f"{WRONG}: balls come from the robot's end; is it turned by 180 degrees about z, or y mirrored?"
        return None


def _comes(way: np.ndarray) -> bool:
    """True for a ball that flew from the player's end towards the robot's."""
    return bool(way[1] < -FLOWN and abs(way[0]) < abs(way[1]))


def signs_of(time: np.ndarray, position: np.ndarray) -> Seen:
    """Signs of a track, time (n,) [s] and position (3, n) [m], of at least 2 ``SIDE`` + 1 samples."""
    n = len(time)
    middle = np.arange(SIDE, n - SIDE)
    lines = [_lines(time, position, middle, first) for first in (-SIDE, 1)]
    (before, place), (after, there) = lines
    change = after - before
    size = np.linalg.norm(change, axis=0)
    kinks = [i for i in range(size.size) if size[i] > KINK and size[i] == size[max(i - SIDE, 0) : i + SIDE + 1].max()]
    bounces, edges = [], [0]
    for i in kinks:
        sideways = float(np.hypot(change[0, i], change[1, i]))
        if before[2, i] < 0.0 < after[2, i] and sideways < 0.7 * change[2, i]:
            late = np.clip((place[2, i] - there[2, i]) / change[2, i], -0.02, 0.02)
            at = 0.5 * (place[:, i] + before[:, i] * late + there[:, i] + after[:, i] * late)
            bounces.append(at - np.array([0.0, 0.0, 0.5 * GRAVITY * late**2]))
        edges.append(int(middle[i]))
    edges.append(n)
    falls = [
        acceleration(time[a + 1 : b], position[:, a + 1 : b])
        for a, b in zip(edges, edges[1:], strict=False)
        if b - a > 2 * SIDE and _free(time[a + 1 : b], position[:, a + 1 : b])
    ]
    first = edges[1] - 1
    return Seen(np.array(bounces).reshape(-1, 3).T, position, position[:, first] - position[:, 0], tuple(falls))


def _lines(time: np.ndarray, position: np.ndarray, middle: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and place (3, m) at the middle samples by lines through ``SIDE`` samples from ``first`` after each on,
    gravity along z taken out."""
    rows = middle[:, None] + first + np.arange(SIDE)
    t = time[rows] - time[middle][:, None]
    p = position[:, rows] + 0.5 * GRAVITY * np.array([0.0, 0.0, 1.0])[:, None, None] * t**2
    centre, level = t.mean(1), p.mean(2)
    away = t - centre[:, None]
    slope = (p * away).sum(2) / (away**2).sum(1)
    return slope, level - slope * centre


def _free(time: np.ndarray, position: np.ndarray) -> bool:
    """True for a free flight: a parabola, up to drag, that is no ball at rest."""
    if time[-1] - time[0] < FLIGHT:
        return False
    t = time - time.mean()
    basis = np.stack([np.ones_like(t), t, t * t, t**3], axis=1)
    found, *_ = np.linalg.lstsq(basis, position.T, rcond=None)
    rough = float(np.sqrt(((basis @ found - position.T) ** 2).sum(1).mean()))
    way = float(np.ptp(position, axis=1).max())
    speed, bend = np.linalg.norm(found[1]), np.linalg.norm(found[2])
    return bool(rough < ROUGH[0] + ROUGH[1] * way and speed > 1.0 and bend > 2.0)
