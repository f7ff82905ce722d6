"""Balls of a measuring day, and what a camera log makes of them: who plays, where it starts, noise, drop-outs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tests.exam.generator.world import Flight, World, camera, filtered, fly, seen

INTERVAL = 1 / 125  # [s] between samples
FEWEST, MOST = 50, 75  # samples of a trajectory
SIGMA = 3e-3  # [m] of the noise on each coordinate
NET = 0.1525 + 0.02  # [m] height of the ball's centre over the net
FAR = 1.5  # [m] |y| at which a log ends: before any racket
HUMAN_SHARE = 0.7
CAMERA = np.array([0.0, -3.0, 2.0])  # [m] of the noise that grows with distance
NOISES = ("iid", "ar1", "range", "causal")
WRONG_NOISES = ("tails", "along", "levels")  # the measurement model's fault: nothing is wrong with the physics


@dataclass(frozen=True)
class Balls:
    """Starts of the balls in the order in which they were played."""

    start: np.ndarray  # (9, B) position, velocity, spin; the spins are zero until an effect gives them
    human: np.ndarray  # (B,) bool: flies towards -y; a return otherwise
    session: np.ndarray  # (B,) int
    clock: np.ndarray  # (B,) [s] time in the session
    samples: np.ndarray  # (B,) int, as many as the log holds at most

    def __len__(self) -> int:
        return self.human.size

    def take(self, index) -> Balls:
        return Balls(
            self.start[:, index], self.human[index], self.session[index], self.clock[index], self.samples[index]
        )


@dataclass(frozen=True)
class Log:
    """Record of the tracker; samples first, padded with NaN behind each ball's last."""

    time: np.ndarray  # (T, B) [s] in the session
    position: np.ndarray  # (3, T, B) [m]
    clean: np.ndarray  # (3, T, B) [m], true position as a camera without noise, jitter and filter shows it
    session: np.ndarray  # (B,)


def draw_starts(rng: np.random.Generator, count: int, human: bool) -> np.ndarray:
    """Starts (9, count) of balls that cross the net and bounce once on the other side, under the nominal world."""
    found = np.empty((9, 0))
    while found.shape[1] < count:
        n = 6 * count + 50
        y = rng.uniform(1.0, 1.8, n) if human else rng.uniform(1.3, 1.5, n)
        x, z = rng.uniform(-0.6, 0.6, n), rng.uniform(0.1, 0.5, n)
        speed, climb = rng.uniform(4.0, 7.0, n), rng.uniform(-0.15, 0.6, n)
        aim = np.arctan2(rng.uniform(-0.6, 0.6, n) - x, y + 0.9)
        velocity = speed * np.array([np.cos(climb) * np.sin(aim), -np.cos(climb) * np.cos(aim), np.sin(climb)])
        start = np.concatenate([[x, y, z], velocity, np.zeros((3, n))])
        flight = fly(World(), start, 0.7, step=1e-2)
        meets = np.isfinite(flight.bounce_time)
        spot = flight.bounce_state
        path = flight.first[:, :3]
        beyond = path[:, 1] < 0.0
        over_net = np.take_along_axis(path[:, 2], np.argmax(beyond, axis=0)[None], 0)[0]
        long_enough = np.minimum(flight.end_time, _reaches(flight, -FAR)) > FEWEST * INTERVAL + 0.01
        good = meets & np.any(beyond, axis=0) & (over_net > NET) & long_enough
        good &= (spot[1] < -0.1) & (spot[1] > -1.3) & (np.abs(spot[0]) < 0.7) & (flight.bounce_time < 0.42)
        found = np.concatenate([found, start[:, good]], axis=1)
    found = found[:, :count]
    return found if human else found * np.array([1, -1, 1, 1, -1, 1, 0, 0, 0])[:, None]


def _reaches(flight: Flight, y: float) -> np.ndarray:
    """Time (B,) at which the balls pass ``y`` downwards, on the grid."""
    time = np.arange(flight.first.shape[0]) * flight.step
    positions = flight.at(np.repeat(time[:, None], flight.first.shape[2], axis=1))[1]
    past = ~(positions > y)
    return np.where(np.any(past, axis=0), time[np.argmax(past, axis=0)], np.inf)


def draw_balls(rng: np.random.Generator, count: int | None = None) -> Balls:
    """A day of 200 to 500 balls (or ``count``) in four to eight sessions."""
    count = int(rng.integers(200, 501)) if count is None else count
    human = rng.permutation(np.arange(count) < round(HUMAN_SHARE * count))
    start = np.empty((9, count))
    start[:, human] = draw_starts(rng, int(human.sum()), True)
    start[:, ~human] = draw_starts(rng, int((~human).sum()), False)
    session = np.sort(rng.integers(0, int(rng.integers(4, 9)), count))
    pause = rng.uniform(4.0, 9.0, count)
    clock = np.concatenate([np.cumsum(pause[session == s]) for s in np.unique(session)])
    return Balls(start, human, session, clock, rng.integers(FEWEST, MOST + 1, count))


def measure(world: World, balls: Balls, noise: str, rng: np.random.Generator) -> Log:
    """The log of the balls in a world, under one of NOISES or WRONG_NOISES."""
    steps = np.arange(MOST)[:, None]
    stamp = np.repeat(steps * INTERVAL, len(balls), axis=1)  # since the ball's first sample
    true_time = stamp / world.clock_rate
    flight = fly(world, balls.start, float(true_time.max()) + 0.05)
    truth = flight.at(true_time)
    past = ~np.where(balls.human, truth[1] > -FAR, truth[1] < FAR)
    ended = np.cumsum(past | (steps >= balls.samples), axis=0) > 0
    position = seen(world, flight, stamp - world.jitter * rng.standard_normal(stamp.shape))
    speed = np.gradient(truth, INTERVAL, axis=1)
    added, kept = _noise(noise, rng, truth, speed, balls.session)
    measured = position + filtered(added, INTERVAL, world.smoothing)
    gone = ended | ~kept
    # A clean position and a measured one go together.
    gone |= ~np.all(np.isfinite(measured), axis=0)
    return Log(
        stamp + balls.clock,
        np.where(gone, np.nan, measured),
        np.where(gone, np.nan, camera(world, truth)),
        balls.session,
    )


def _noise(kind: str, rng, truth, speed, session):
    """Noise (3, T, B) and which samples the tracker kept, (T, B)."""
    shape = truth.shape
    white, kept = rng.standard_normal(shape), np.ones(shape[1:], bool)
    if kind == "iid":
        noise = SIGMA * white
    elif kind == "ar1":
        noise = SIGMA * _filtered(white, 0.7, stationary=True)
    elif kind == "causal":
        noise = SIGMA * _filtered(white, np.exp(-INTERVAL / 0.02), stationary=False)
    elif kind == "range":
        distance = np.sqrt(np.sum((np.nan_to_num(truth) - CAMERA[:, None, None]) ** 2, axis=0))
        noise = SIGMA * (distance / 3.8) ** 2 * white
        wild = rng.random(shape[1:]) < 0.01
        direction = rng.standard_normal(shape)
        direction /= np.sqrt(np.sum(direction**2, axis=0))
        noise = noise + wild * rng.uniform(0.05, 0.20, shape[1:]) * direction
        kept = _drop_outs(rng, shape[1:])
    elif kind == "tails":
        noise = SIGMA * rng.standard_t(3, shape) / np.sqrt(3.0)
    elif kind == "along":
        heading = speed / np.sqrt(np.sum(speed**2, axis=0))
        noise = SIGMA * (white + heading * rng.normal(0.0, np.sqrt(3.0), shape[1:]))
    elif kind == "levels":
        levels = rng.uniform(0.5, 2.0, session.max() + 1)
        noise = SIGMA * levels[session] * white
    else:
        raise ValueError(f"unknown noise {kind!r}; known are {', '.join((*NOISES, *WRONG_NOISES))}")
    return noise, kept


def _filtered(white: np.ndarray, pole: float, stationary: bool) -> np.ndarray:
    """First-order filter along the samples to a deviation of 1; from rest unless it is stationary."""
    gain = np.sqrt(1.0 - pole**2)
    out = white * gain
    if stationary:
        out[:, 0] = white[:, 0]
    for k in range(1, white.shape[1]):
        out[:, k] += pole * out[:, k - 1]
    return out


def _drop_outs(rng, shape) -> np.ndarray:
    """About a tenth of the samples lost: singly, in bursts, and as tails; never the first four."""
    kept = rng.random(shape) > 0.05
    steps = np.arange(shape[0])[:, None]
    burst, at = rng.integers(3, 9, shape[1]), rng.integers(8, 55, shape[1])
    kept &= ~((rng.random(shape[1]) < 0.35) & (steps >= at) & (steps < at + burst))
    kept &= ~((rng.random(shape[1]) < 0.15) & (steps >= rng.integers(42, 60, shape[1])))
    kept[:4] = True
    return kept


def shift(world: World, balls: Balls, rng: np.random.Generator, step: float = 4e-3) -> np.ndarray:
    """Distance (B,) [m] of the last sample from the nominal flight with the same start, without noise.

    The start is what a perfect tracker sees: the camera's image of the true start and its velocity on the camera's
    clock. Time-stamp errors come on top of it and count as they are. Of a filter the constant delay shows in no log;
    its shift is the largest distance from the unfiltered path at that delay, the corner cut at the bounce.
    """
    last = np.minimum(balls.samples - 1, 62) * INTERVAL
    flight = fly(world, balls.start, float(last.max() / np.min(world.clock_rate)) + 0.05, step)
    nudge = 1e-4
    stamps = np.stack([0.0 * last, 0.0 * last + nudge])
    image = camera(world, flight.at(stamps / world.clock_rate))
    velocity = (image[:, 1] - image[:, 0]) / nudge
    nominal = fly(World(), np.concatenate([image[:, 0], velocity, 0.0 * velocity]), float(last.max()) + 0.05, step)
    grid = np.arange(MOST)[:, None] * INTERVAL + 0.0 * last
    path = seen(world, flight, grid - world.jitter * rng.standard_normal(grid.shape))
    expected = nominal.at(grid)
    if world.smoothing > 0.0:
        late = seen(replace(world, smoothing=0.0), flight, grid - world.smoothing)
        distance = np.sqrt(np.sum((path - late) ** 2, axis=0))
        return np.nanmax(np.where(grid <= last + 1e-9, distance, 0.0), axis=0)
    valid = np.all(np.isfinite(path) & np.isfinite(expected), axis=0) & (grid <= last + 1e-9)
    final = np.where(valid, np.arange(MOST)[:, None], 0).max(axis=0)
    ball = np.arange(final.size)
    return np.sqrt(np.sum((path[:, final, ball] - expected[:, final, ball]) ** 2, axis=0))


def with_spin(balls: Balls, spin: np.ndarray) -> Balls:
    """The balls with spins (3, B) [rad/s]."""
    return replace(balls, start=np.concatenate([balls.start[:6], spin]))
