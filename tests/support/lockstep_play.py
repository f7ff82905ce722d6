"""Robot, bridge and hand-made policies in lock-step, for tests."""

from __future__ import annotations

from functools import cache

import numpy as np

from robot_io.contract import N_JOINTS
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.opponent import Throws
from robot_io.emulator.world import World, WorldParams
from tests.support.paths import SCENE


class Hold:
    """Leaves the paddle where it is, in the way of some balls."""

    def reset(self):
        self.steps = 0

    def step(self, observation):
        return np.zeros(N_JOINTS)


class Swing(Hold):
    """Moves all but two joints to and fro at ``share`` of the highest speeds."""

    def __init__(self, share=0.3):
        self.share = share

    def step(self, observation):
        self.steps += 1
        return self.share * (1 if self.steps // 14 % 2 == 0 else -1) * np.array([1, 0.3, 1, 0, 0.6, 1, -1, 1.0])


class Wild(Hold):
    """Random actions, a new one every few steps."""

    def __init__(self, seed=0):
        self.random = np.random.default_rng(seed)

    def step(self, observation):
        if self.steps % 8 == 0:
            self.action = self.random.uniform(-1, 1, N_JOINTS)
        self.steps += 1
        return self.action


def throws(n=64, seed=0, wide=0.25) -> Throws:
    """Balls towards the paddle at home, ``wide`` [m] of it to either side, mostly with one bounce."""
    random = np.random.default_rng(seed)
    position = np.stack([random.uniform(0.0, 0.4, n), np.full(n, 1.2), random.uniform(0.35, 0.6, n)])
    speed = random.uniform(4.5, 7.5, n)
    bounce = random.uniform(0.4, 0.75, n) + 1.2  # [m] of way to the bounce
    fall = bounce / speed * 1.08  # drag
    velocity = np.stack([random.uniform(-wide, wide, n) / 0.5, -speed, (0.02 - position[2]) / fall + 4.9 * fall])
    return Throws(position, velocity, np.zeros((3, n)))


@cache
def world() -> World:
    return World(SCENE, WorldParams())


def lockstep(policy=None, balls=None, **options) -> LockStep:
    """Before power-on; all share one world, so one at a time."""
    options.setdefault("params", RigParams(pause=0.05))
    return LockStep(SCENE, balls or throws(), policy or Hold(), world=world(), **options)


def playing(policy=None, **options) -> LockStep:
    """With a ball in play."""
    rig = lockstep(policy, **options)
    rig.start()
    rig.throwing = True
    if not rig.run(3.0, lambda: rig.bridge.state.value == "active"):
        raise AssertionError(f"no ball was played: {rig.bridge.state}, {rig.bridge.gate.faults}")
    return rig
