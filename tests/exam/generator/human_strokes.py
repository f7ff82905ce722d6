"""Strokes of people: measured starts with their estimated spins, flown by the second physics.

Starts are those of the rallies released with D'Ambrosio et al., "Achieving Human Level Competitive Robot Table Tennis",
ICRA 2025 (CC-BY-4.0, (c) 2025 Google LLC), read where they lie and never copied. Their spins are the authors' estimate
(median 55 rad/s), probably below the true ones.
"""

from __future__ import annotations

import json
from functools import cache

import numpy as np

from tests.exam.generator.sessions import FAR, FEWEST, INTERVAL, MOST, NET, Balls
from tests.exam.generator.world import World, fly
from tests.support.paths import MEASURED

DATA = MEASURED / "deepmind_ball_states" / "rallies.json"
FIELDS = [f"{kind}_{axis}" for kind in ("pos", "vel", "w_vel") for axis in "xyz"]


@cache
def states() -> np.ndarray:
    """(9, n) position [m], velocity [m/s], spin [rad/s] right after hits towards -y, from beyond the net.

    Raises FileNotFoundError where the data is absent.
    """
    rows = np.array([[row[field] for field in FIELDS] for row in json.loads(DATA.read_text())]).T
    return rows[:, (rows[4] < 0.0) & (rows[1] > 0.6) & (rows[2] > 0.05)]


def draw_human(rng: np.random.Generator, count: int | None, world: World, scale: float = 1.0) -> Balls:
    """Balls of people that cross the net and bounce once on the other side in a world; 200 to 500, or ``count``.

    scale: factor of the spins.
    """
    count = int(rng.integers(200, 501)) if count is None else count
    start = states()
    start = start[:, rng.permutation(start.shape[1])[: 2 * count + 50]].copy()
    start[6:] *= scale
    flight = fly(world, start, MOST * INTERVAL + 0.1, step=4e-3)
    path = flight.first[:, :3]
    beyond = path[:, 1] < 0.0
    over_net = np.take_along_axis(path[:, 2], np.argmax(beyond, axis=0)[None], 0)[0]
    time = np.arange(flight.first.shape[0])[:, None] * flight.step + np.zeros(start.shape[1])
    far = ~(flight.at(time)[1] > -FAR)
    leaves = np.where(far.any(axis=0), np.argmax(far, axis=0) * flight.step, np.inf)
    spot = flight.bounce_state
    good = np.isfinite(flight.bounce_time) & beyond.any(axis=0) & (over_net > NET)
    good &= (spot[1] < -0.1) & (spot[1] > -1.35) & (np.abs(spot[0]) < 0.75)
    good &= np.minimum(flight.end_time, leaves) > FEWEST * INTERVAL + 0.01
    start = start[:, good][:, :count]
    if start.shape[1] < count:
        raise ValueError(f"{start.shape[1]} strokes of {count} are left that land once on the other side")
    session = np.sort(rng.integers(0, 5, count))
    clock = np.concatenate([np.cumsum(rng.uniform(4.0, 9.0, int((session == s).sum()))) for s in np.unique(session)])
    return Balls(start, np.ones(count, bool), session, clock, rng.integers(FEWEST, MOST + 1, count))
