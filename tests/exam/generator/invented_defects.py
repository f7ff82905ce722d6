"""Defects that are in no catalogue: each changes a World by an amount ``a`` and is no catalogue effect in disguise.

Every entry takes (world, amount, balls, rng) and returns the changed world. The amounts are scaled afterwards, so the
units in the comments only say what the number is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tests.exam.generator.sessions import Balls
from tests.exam.generator.world import World


@dataclass(frozen=True)
class Invented:
    """A defect: how it changes a world, an amount of about 10 mm, and in words where it acts."""

    apply: Callable[[World, float, Balls, np.random.Generator], World]
    amount: float
    words: str


def _bump(value, centre, width):
    return np.exp(-(((value - centre) / width) ** 2))


def _along(axis: int, value):
    """A vector field (3, ...) with one component."""
    zero = np.zeros_like(value)
    return np.stack([value if i == axis else zero for i in range(3)])


def _dead_spot(world, a, balls, rng):
    side = rng.choice([-1.0, 1.0])
    return replace(
        world, restitution_map=lambda x, y: -abs(a) * _bump(x, 0.25 * side, 0.25) * _bump(np.abs(y), 0.65, 0.3)
    )


def _air_jet(world, a, balls, rng):
    return replace(world, field=lambda p, v: _along(0, a * _bump(p[1], 0.45, 0.25)))


def _drag_crisis(world, a, balls, rng):
    def factor(v):
        speed = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
        return 1.0 - abs(a) / (1.0 + np.exp(-(speed - 5.2) / 0.1))

    return replace(world, drag_factor=factor)


def _session_restitution(world, a, balls, rng):
    offsets = rng.choice([-1.0, 1.0], 16) * rng.uniform(0.6, 1.4, 16)
    offsets[0], offsets[1] = abs(offsets[0]), -abs(offsets[1])
    return replace(world, restitution=world.restitution + a * offsets[balls.session])


def _spring(world, a, balls, rng):
    return replace(world, field=lambda p, v: _along(0, -a * p[0]))


def _table_joint(world, a, balls, rng):
    def surface(x, y):
        ridge = abs(a) * _bump(np.abs(y), 0.7, 0.12)
        slope = ridge * (-2.0 * (np.abs(y) - 0.7) / 0.12**2) * np.sign(y)
        return ridge, 0.0 * x, slope

    return replace(world, surface=surface)


def _net_draught(world, a, balls, rng):
    return replace(world, field=lambda p, v: _along(2, a * _bump(p[1], 0.0, 0.15)))


def _warming_table(world, a, balls, rng):
    drift = balls.clock / 300.0 - 0.7
    return replace(world, restitution=world.restitution + a * drift)


def _camera_handover(world, a, balls, rng):
    plane = rng.uniform(-0.2, 0.4)
    return replace(world, camera_shift=lambda p: _along(0, a / (1.0 + np.exp((p[1] - plane) / 0.01))))


def _crowned_table(world, a, balls, rng):
    return replace(world, surface=lambda x, y: (-a * x**2, -2.0 * a * x, 0.0 * y))


def _rising_wind(world, a, balls, rng):
    return replace(world, wind_x=world.wind_x + a * (balls.clock / 300.0 - 0.7))


def _updraught(world, a, balls, rng):
    return replace(world, field=lambda p, v: _along(2, a * (p[2] - 0.25) * 4.0))


def _warming_camera(world, a, balls, rng):
    return replace(world, camera_rotation_x=world.camera_rotation_x + a * (balls.clock / 300.0 - 0.7))


def _swirl(world, a, balls, rng):
    """Air that turns about a vertical axis through the table's centre."""
    return replace(world, field=lambda p, v: np.stack([-a * p[1], a * p[0], 0.0 * p[0]]))


INVENTED = {
    "dead_spot": Invented(_dead_spot, 0.03, "a soft spot on each half of the table"),
    "air_jet": Invented(_air_jet, 0.4, "a sideways jet over the human half"),
    "drag_crisis": Invented(_drag_crisis, 0.1, "less drag above 5.2 m/s"),
    "session_restitution": Invented(_session_restitution, 0.02, "another restitution in every session"),
    "spring": Invented(_spring, 0.3, "sideways acceleration proportional to x"),
    "table_joint": Invented(_table_joint, 0.003, "a ridge across each half"),
    "net_draught": Invented(_net_draught, 0.5, "a vertical draught above the net"),
    "warming_table": Invented(_warming_table, 0.03, "restitution that drifts within a session"),
    "camera_handover": Invented(_camera_handover, 0.01, "a jump of the measured x at a plane across the table"),
    "crowned_table": Invented(_crowned_table, 0.01, "a table curved across its width"),
    "rising_wind": Invented(_rising_wind, 0.3, "side wind that turns within a session"),
    "updraught": Invented(_updraught, 0.1, "vertical acceleration proportional to height"),
    "warming_camera": Invented(_warming_camera, 0.005, "a camera that tilts within a session"),
    "swirl": Invented(_swirl, 0.1, "air that turns about the table's centre"),
}
