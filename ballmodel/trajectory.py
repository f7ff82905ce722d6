"""Measured ball trajectories: validation, the free flight before the first bounce, resampling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ballmodel.constants import BALL_RADIUS

LARGEST_COORDINATE = 30.0  # [m] from the table's centre; beyond it the numbers are no metres
LONGEST = 60.0  # [s]; beyond it the time stamps are no seconds
BOUNCE_HEIGHT = 0.10  # [m] of the ball's lowest point above the table up to which a reversal is a bounce
BOUNCE_KICK = 0.5  # [m/s] least change of the vertical velocity at a bounce
BOUNCE_WINDOW = 5  # samples on each side that tell the vertical velocity


@dataclass(frozen=True)
class Trajectory:
    """One ball as it was measured, in the table frame.

    Raises ValueError, naming session and trajectory, for shapes that do not match, numbers that are not finite, time
    that does not increase, and numbers too large to be metres and seconds.
    """

    session: str
    name: str
    time: np.ndarray  # (n,) [s]
    position: np.ndarray  # (3, n) [m] ball centre

    def __post_init__(self) -> None:
        time, position = np.asarray(self.time, np.float64), np.asarray(self.position, np.float64)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "position", position)
        problem = _find_problem(time, position)
        if problem:
            raise ValueError(f"{self.label}: {problem}")

    @property
    def label(self) -> str:
        """Session and name, for messages."""
        return f"trajectory {self.session}/{self.name}" if self.session else f"trajectory {self.name}"

    def __len__(self) -> int:
        return self.time.size

    def part(self, start: int, stop: int) -> Trajectory:
        """Samples start to stop - 1."""
        return Trajectory(self.session, self.name, self.time[start:stop], self.position[:, start:stop])


def _find_problem(time: np.ndarray, position: np.ndarray) -> str:
    """What keeps the numbers from being a ball's; empty: nothing."""
    if time.ndim != 1 or time.size == 0 or position.shape != (3, time.size):
        return f"time (n,) and position (3, n) are wanted, got {time.shape} and {position.shape}"
    if not (np.all(np.isfinite(time)) and np.all(np.isfinite(position))):
        sample = int(np.argmax(~np.isfinite(time) | ~np.all(np.isfinite(position), axis=0)))
        return f"sample {sample} is not finite: t={time[sample]}, position={position[:, sample]}"
    if np.any(np.diff(time) <= 0.0):
        sample = int(np.argmax(np.diff(time) <= 0.0)) + 1
        return f"time must increase, sample {sample} has t={time[sample]} after t={time[sample - 1]}"
    farthest, length = np.abs(position).max(), time[-1] - time[0]
    if farthest > LARGEST_COORDINATE:
        return f"a coordinate of {farthest:g} is no place near a table; metres are wanted (are these millimetres?)"
    if length > LONGEST:
        return f"lasts {length:g}, one ball's flight in seconds is wanted (are these milliseconds?)"
    return ""


@dataclass(frozen=True)
class Dataset:
    """Trajectories read from one source."""

    trajectories: tuple[Trajectory, ...]
    source: str
    notes: tuple[str, ...] = ()  # what was done to the file's samples

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    @property
    def sessions(self) -> tuple[str, ...]:
        """Session names in the order of their first trajectory."""
        return tuple(dict.fromkeys(t.session for t in self.trajectories))


def first_bounce(trajectory: Trajectory) -> int | None:
    """Index of the lowest sample at the first bounce, or None where the ball does not bounce.

    A bounce is a sample, the lowest among its neighbours, where the vertical velocity changes from falling to rising
    while the ball is within BOUNCE_HEIGHT of the table: gravity alone only ever makes it fall faster. The velocities
    are slopes of straight lines through up to BOUNCE_WINDOW samples on each side. Their change must be at least
    BOUNCE_KICK and four times what the trajectory's own noise would give, so that noise does not fake a bounce.
    """
    time, z = trajectory.time, trajectory.position[2]
    # Third differences of a smooth flight are noise alone, with 1 + 9 + 9 + 1 times its variance; 0.6745: normal
    # quartile.
    noise = np.median(np.abs(np.diff(z, 3))) / (0.6745 * np.sqrt(20.0)) if z.size > 3 else 0.0

    def slope(samples: slice) -> tuple[float, float]:
        """Slope and the inverse of its variance per unit of noise."""
        t = time[samples] - time[samples].mean()
        return float(t @ z[samples] / (t @ t)), float(t @ t)

    for k in np.flatnonzero(z < BALL_RADIUS + BOUNCE_HEIGHT):
        before, after = slice(max(0, k + 1 - BOUNCE_WINDOW), k + 1), slice(k, k + BOUNCE_WINDOW)
        lowest = z[k] <= z[before.start : k + BOUNCE_WINDOW].min()
        if not lowest or k == before.start or k == len(trajectory) - 1:
            continue
        (falling, information_before), (rising, information_after) = slope(before), slope(after)
        least = max(BOUNCE_KICK, 4.0 * noise * np.sqrt(1.0 / information_before + 1.0 / information_after))
        if falling < 0.0 < rising and rising - falling >= least:
            return int(k)
    return None


def free_flight(trajectory: Trajectory) -> Trajectory:
    """The samples before the first bounce; the lowest sample, which may lie on either side of it, is left out."""
    bounce = first_bounce(trajectory)
    return trajectory if bounce is None else trajectory.part(0, bounce)
