"""A ball's track: free flight, and kinks, sudden changes of the velocity, some of which are bounces on the table."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from ballmodel.constants import (
    AIR_DENSITY,
    BALL_AREA,
    BALL_MASS,
    BALL_RADIUS,
    DRAG_COEFFICIENT,
    GRAVITY,
    TABLE_LENGTH,
    TABLE_WIDTH,
)

NEAR_TABLE = 0.12  # [m] height at which the lowest sample of a bounce can be: 125 Hz, two frames lost
UPWARD = 1.0  # [m/s] gained by the vertical speed in a bounce; a fit over three samples is good to 0.3 m/s
EDGE = 0.02  # [m] by which a bounce may seem to miss the table
HALF_WIDTH, HALF_LENGTH = TABLE_WIDTH / 2, TABLE_LENGTH / 2  # [m]
SIDE = 3  # samples before and after a moment in which a change of velocity is looked for
LONGEST_WINDOW = 0.12  # [s] of these samples together
DRAG = DRAG_COEFFICIENT * AIR_DENSITY * BALL_AREA / (2.0 * BALL_MASS)  # K_d [1/m]
FLIGHT_STEP = 0.005  # [s]
RESTITUTION = 0.9  # of tables, by and large


@dataclass(frozen=True)
class Seen:
    time: float
    position: np.ndarray
    distance: float  # [m] from the blade's centre


@dataclass(frozen=True)
class Kink:
    """Change of the velocity (3,) at ``seen``, from ``before`` to ``after``, gravity taken out."""

    seen: Seen
    before: np.ndarray
    after: np.ndarray
    lowest: bool  # of the samples around


def slope(samples: list[Seen]) -> np.ndarray:
    """Velocity (3,) [m/s] in the middle of at least two samples, by least squares; gravity does not bias it."""
    t = np.array([s.time for s in samples])
    t = t - t.mean()
    return t @ np.stack([s.position for s in samples]) / (t @ t)


def find_kink(recent: deque[Seen]) -> Kink | None:
    """The change of velocity at the middle sample; None while there are too few around it."""
    if len(recent) < 2 * SIDE + 1 or recent[-1].time - recent[0].time > LONGEST_WINDOW:
        return None
    samples = list(recent)
    first, middle, last = samples[:SIDE], samples[SIDE], samples[SIDE + 1 :]
    before, after = slope(first), slope(last)
    before[2] -= GRAVITY * (middle.time - np.mean([s.time for s in first]))
    after[2] += GRAVITY * (np.mean([s.time for s in last]) - middle.time)
    lowest = min(s.position[2] for s in samples) == middle.position[2]
    return Kink(middle, before, after, lowest)


def deflection(kink: Kink) -> float:
    return float(np.linalg.norm(kink.after - kink.before))


def bounce_place(kink: Kink, recent: deque[Seen]) -> np.ndarray | None:
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
    return place if over_table(place) else None


def over_table(place: np.ndarray) -> bool:
    return abs(place[0]) < HALF_WIDTH + EDGE and abs(place[1]) < HALF_LENGTH + EDGE


def landing(position: np.ndarray, velocity: np.ndarray, longest: float = 2.0) -> np.ndarray:
    """Place (2,) [m] where a ball of position (3,) [m] and velocity (3,) [m/s] comes down to the table's height."""
    for _ in range(round(longest / FLIGHT_STEP)):
        if position[2] <= BALL_RADIUS:
            break
        position, velocity = _step(position, velocity, FLIGHT_STEP)
    return position[:2]


def flown(position: np.ndarray, velocity: np.ndarray, seconds: float) -> np.ndarray:
    """Place (3,) [m] of a ball after ``seconds``, bounces on the table included."""
    while seconds > 0.0:
        position, velocity = _step(position, velocity, min(seconds, FLIGHT_STEP))
        seconds -= FLIGHT_STEP
        if position[2] < BALL_RADIUS and velocity[2] < 0.0 and over_table(position) and position[2] > -NEAR_TABLE:
            velocity = velocity * [1.0, 1.0, -RESTITUTION]
    return position


def _step(position: np.ndarray, velocity: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    air = -DRAG * float(np.linalg.norm(velocity)) * velocity - np.array([0.0, 0.0, GRAVITY])
    return position + seconds * (velocity + 0.5 * seconds * air), velocity + seconds * air
