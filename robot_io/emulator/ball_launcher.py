"""Somebody who throws balls: waits until the robot stands at home and the ball is out of play, pauses, throws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_io.emulator.world import World

NEAR_HOME = 0.05  # [m], [rad]
STILL = 0.05  # [m/s], [rad/s]


@dataclass(frozen=True)
class Throws:
    """Balls to throw in turn: positions (3, n) [m], velocities (3, n) [m/s] and spins (3, n) [rad/s]."""

    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray

    def __post_init__(self) -> None:
        shape = self.position.shape
        if len(shape) != 2 or shape[0] != 3 or not shape[1] or {self.velocity.shape, self.spin.shape} != {shape}:
            raise ValueError(
                f"throws: position {shape}, velocity {self.velocity.shape}, spin {self.spin.shape}; each must be (3, n)"
            )


class Thrower:
    """Throws one ball after the other, from the start again when all are thrown.

    pause  [s] that robot and ball must have been still
    """

    def __init__(self, throws: Throws, pause: float = 0.6, first: int = 0) -> None:
        self._throws, self._pause, self._next = throws, pause, first
        self._quiet_since: float | None = None
        self.thrown = 0

    def update(self, world: World, now: float) -> bool:
        """Throws when it is time; True when it did."""
        at_home = (np.abs(world.qpos - world.home) < NEAR_HOME).all() and (np.abs(world.qvel) < STILL).all()
        if world.in_play or not at_home:
            self._quiet_since = None
            return False
        if self._quiet_since is None:
            self._quiet_since = now
        if now - self._quiet_since < self._pause:
            return False
        i = self._next % self._throws.position.shape[1]
        world.throw(self._throws.position[:, i], self._throws.velocity[:, i], self._throws.spin[:, i])
        self._next, self.thrown, self._quiet_since = i + 1, self.thrown + 1, None
        return True
