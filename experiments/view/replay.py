"""A ball as it is shown: the motion of robot and ball over time, and what a viewer may want to know about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ballmodel.constants import BALL_RADIUS, TABLE_LENGTH, TABLE_WIDTH

RATE = 300.0  # [Hz] of the frames, so that slow motion is smooth
KICK = 0.4  # [m/s] change of velocity between two control ticks, beyond gravity's, that is taken for a contact
BOUNCE_HEIGHT = BALL_RADIUS + 0.05  # [m] of the ball's centre up to which a reversal is a bounce


@dataclass(frozen=True)
class Series:
    """Curves over time: time (n,) [s], values (n, k), a name for each of the k."""

    names: tuple[str, ...]
    time: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Replay:
    """One ball at one table.

    time     (T,) [s] from the start
    qpos     (T, 8) [m], [rad]
    balls    positions (T, 3) [m] by name, NaN where there is none: the first leaves a trail, the last shows its landing
    title    of whom it is
    outcome  "returned", ..., with speeds; shown from ``decided`` [s] on
    contact  [s] of the paddle's contact, NaN without one
    marks    (M, 3) [m] measured positions
    series   curves by heading
    terms    reward term by name: value, weight
    events   time [s] and text of what happens on the way
    """

    time: np.ndarray
    qpos: np.ndarray
    balls: dict[str, np.ndarray]
    title: str
    outcome: str = ""
    decided: float = 0.0
    contact: float = float("nan")
    marks: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    series: dict[str, Series] = field(default_factory=dict)
    terms: dict[str, tuple[float, float]] = field(default_factory=dict)
    events: tuple[tuple[float, str], ...] = ()

    @property
    def seconds(self) -> float:
        return float(self.time[-1])

    @property
    def trail(self) -> np.ndarray:
        """Path (T, 3) [m] of the first ball."""
        return next(iter(self.balls.values()))

    @cached_property
    def landing(self) -> np.ndarray:
        """Place (T, 2) [m] where the last ball will come down next, NaN where it will not."""
        return next_landing(list(self.balls.values())[-1])

    def frame(self, t: float) -> int:
        """Index of the frame at a time [s]."""
        return int(np.clip(np.searchsorted(self.time, t + 1e-9) - 1, 0, len(self.time) - 1))


def upsample(position: np.ndarray, velocity: np.ndarray, period: float, factor: int) -> np.ndarray:
    """A ball's path (n, 3) [m] at ``factor`` times the rate, (factor (n - 1) + 1, 3).

    Between ticks without a contact it is the cubic through positions and velocities; with one, the two straight lines
    along the velocities before and after it up to where they come closest.
    """
    share = np.arange(factor)[None, :, None] / factor
    p0, p1, v0, v1 = (x[:, None] for x in (position[:-1], position[1:], velocity[:-1], velocity[1:]))
    s2, s3 = share**2, share**3
    smooth = (2 * s3 - 3 * s2 + 1) * p0 + (s3 - 2 * s2 + share) * period * v0
    smooth = smooth + (3 * s2 - 2 * s3) * p1 + (s3 - s2) * period * v1
    jump = velocity[1:] - velocity[:-1] + np.array([0.0, 0.0, 9.81 * period])
    struck = np.linalg.norm(jump, axis=1) > KICK
    before, after = p0 + share * period * v0, p1 - (1.0 - share) * period * v1
    turn = np.argmin(np.linalg.norm(before - after, axis=2), axis=1)
    bent = np.where((np.arange(factor)[None] <= turn[:, None])[..., None], before, after)
    path = np.where(struck[:, None, None], bent, smooth)
    return np.concatenate([path.reshape(-1, 3), position[-1:]])


def next_landing(ball: np.ndarray) -> np.ndarray:
    """Place (T, 2) [m] where a ball (T, 3) comes down next: on the table, or to its height beside it; NaN after it."""
    with np.errstate(invalid="ignore"):
        falling, height = np.diff(ball[:, 2]) < 0.0, ball[1:, 2]
        over = (np.abs(ball[1:, 0]) < TABLE_WIDTH / 2) & (np.abs(ball[1:, 1]) < TABLE_LENGTH / 2)
        bounce = over & falling & np.append(~falling[1:], True) & (np.abs(height) < BOUNCE_HEIGHT)
        beside = ~over & (ball[:-1, 2] > BALL_RADIUS) & (height <= BALL_RADIUS)
    down = np.flatnonzero(bounce | beside) + 1
    place = np.append(np.searchsorted(down, np.arange(len(ball))), len(down))[:-1]
    return np.concatenate([ball[down, :2], np.full((1, 2), np.nan)])[place]
