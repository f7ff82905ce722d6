"""Flights of balls for pictures: what people throw and the robot returns, by the project's ball model."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel import flight, registry
from ballmodel.flight import ball_params
from ballmodel.sampling import sample_pool
from robot_io.vision.camera import Camera, look_at

RATE = 1000.0  # [Hz] of the tracks
LENGTH = 1.0  # [s]
HELD_OUT = 10  # every tenth flight is for evaluation only
FOCAL, VIDEO_FOCAL = (750.0, 1500.0), (400.0, 1300.0)  # [px]


def fly_balls(count: int, seed: int) -> np.ndarray:
    """Tracks (count, n, 3) [m] at ``RATE``: a third goes to the person, the others come from one; with spin.

    The players' balls are drawn in equal parts. Spin is normal with 60 rad/s about the horizontal axes.
    """
    params, names = ball_params(), registry.names()
    share = -(-count // len(names))
    pools = [
        sample_pool(jax.random.key(seed + k), registry.load(name), params, share).state for k, name in enumerate(names)
    ]
    rng = np.random.default_rng(seed)
    order = rng.permutation(share * len(names))[:count]
    state = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1)[..., order], *pools)
    spin = jnp.asarray(rng.normal(0, 60, (3, count)) * [[1.0], [0.3], [0.6]], state.position.dtype)
    state = replace(state, spin=spin)

    def advance(ball, _):  # type: ignore[no-untyped-def]
        return flight.step(params, ball, 1.0 / RATE)[0], ball.position

    _, places = jax.jit(lambda ball: jax.lax.scan(advance, ball, None, round(LENGTH * RATE)))(state)
    tracks = np.asarray(places, np.float64).transpose(2, 0, 1)
    tracks[rng.random(count) < 1 / 3] *= [-1.0, -1.0, 1.0]
    return tracks


def split_flights(tracks: np.ndarray, held_out: bool) -> np.ndarray:
    """Those for evaluation, or those for training."""
    return tracks[(np.arange(len(tracks)) % HELD_OUT == 0) == held_out]


def draw_camera(rng: np.random.Generator, video: bool) -> Camera:
    """A camera somewhere beside the table that looks at it, with a lens as the paper's or as of ordinary video."""
    centre = np.array([rng.choice([-1, 1]) * rng.uniform(1.2, 3.2), rng.uniform(-2.2, 1.2), rng.uniform(0.6, 2.6)])
    target = rng.uniform([-0.3, -0.5, -0.2], [0.3, 0.7, 0.3])
    return look_at("drawn", tuple(centre), tuple(target), rng.uniform(*(VIDEO_FOCAL if video else FOCAL)))
