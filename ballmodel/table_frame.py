"""Signs by which measured balls tell a frame: how they fall, where they bounce, where they pass the net.

Positions are (3, n) [m], the ball's centre. A frame that is mirrored across the table (x), or moved by less than its
edges show, leaves no sign: a ball held at known places tells those.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ballmodel.constants import BALL_RADIUS, NET_HEIGHT, TABLE_HEIGHT, TABLE_LENGTH, TABLE_WIDTH

GRAVITY_RANGE = (5.0, 15.0)  # [m/s^2] that a fall in metres and seconds may show
SPAN = 0.06  # [s] between the three samples that give an acceleration
DRAG = 0.12  # [1/m] of a ball, low rather than high
MARGIN = 0.08  # [m] beside the table within which a bounce is one on it
LEVEL = 0.10  # [m] of height within which a bounce is at the table's, or the floor's
LOW = NET_HEIGHT - 0.03  # [m] below which no ball passes the net's place


@dataclass(frozen=True)
class Signs:
    """Bounces (3, b) and paths, each (3, k), of balls in some frame [m]."""

    bounces: np.ndarray
    paths: tuple[np.ndarray, ...]

    def off(self, level: float = LEVEL, margin: float = MARGIN) -> np.ndarray:
        """Bounces (b,) that lie neither on the table nor on the floor, by more than level or margin [m]."""
        x, y, z = self.bounces
        over_table = (np.abs(x) < TABLE_WIDTH / 2 + margin) & (np.abs(y) < TABLE_LENGTH / 2 + margin)
        inside = (np.abs(x) < TABLE_WIDTH / 2 - margin) & (np.abs(y) < TABLE_LENGTH / 2 - margin)
        on_table = over_table & (np.abs(z - BALL_RADIUS) < level)
        played = on_table.sum() >= 0.3 * x.size  # without bounces on the table there is no floor beside it
        on_floor = played & ~inside & (np.abs(z - BALL_RADIUS + TABLE_HEIGHT) < level)
        return ~(on_table | on_floor)

    def low(self) -> int:
        """Passages below the net's edge."""
        return sum(int(np.sum(np.maximum(*h) < LOW)) for h in self._heights())

    def passages(self) -> int:
        """Passages of the net's place."""
        return sum(h[0].size for h in self._heights())

    def _heights(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Heights before and after each path's passages of the net's place."""
        for p in self.paths:
            k = np.flatnonzero(p[1, :-1] * p[1, 1:] < 0.0)
            here = k[np.abs(p[0, k]) < TABLE_WIDTH / 2]
            yield p[2, here], p[2, here + 1]


def describe_fall(bend: np.ndarray, fall: np.ndarray) -> str:
    """What is wrong where balls do not fall along -z; empty: nothing.

    bend  (3,) [m/s^2] their acceleration; fall: the same, their drag taken off
    """
    down = int(np.argmax(np.abs(fall)))
    if not GRAVITY_RANGE[0] < np.abs(fall[down]) < GRAVITY_RANGE[1]:
        return (
            f"balls accelerate by ({', '.join(f'{a:.3g}' for a in bend)}) in x, y, z; a fall of 9.8 m/s^2 "
            "along -z is wanted (wrong unit of length or time, or no free flights?)"
        )
    if down != 2:
        return f"balls fall along {'xyz'[down]}, z must point up (swapped axes?)"
    return "balls fall towards +z, z must point up" if fall[2] > 0.0 else ""


def acceleration(time: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median second derivative (3,) [m/s^2] of at least 5 samples, as it is and with the drag of its speed taken off.

    time (n,) [s], position (3, n).
    """
    step = float(np.median(np.diff(time)))
    velocity, bend = differentiate_twice(time, position, int(np.clip(round(SPAN / step), 2, (len(time) - 1) // 2)))
    fall = bend + DRAG * np.linalg.norm(velocity, axis=0) * velocity
    return np.median(bend, axis=1), np.median(fall, axis=1)


def differentiate_twice(time: np.ndarray, values: np.ndarray, w: int) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives (..., n - 2 w) of values (..., n), each by three samples that are w apart."""
    slope = (values[..., w:] - values[..., :-w]) / (time[w:] - time[:-w])
    early, late = slope[..., :-w], slope[..., w:]
    return 0.5 * (early + late), 2.0 * (late - early) / (time[2 * w :] - time[: -2 * w])
