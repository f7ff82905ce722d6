"""The robot against an emulator that is as unkind as hardware may be: stiff drives that hold their set-point or the
measured place, delays off by 30 %, noise in every position, and a controller that runs on for 1 s without commands.

Nothing may touch before a fault has stopped the robot, and nothing jumps when it is freed. Contacts are MuJoCo's.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from robot_io.contract import ABB_JOINTS, FESTO_JOINTS, JOINT_UNITS
from robot_io.control.bridge import BridgeState
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS
from robot_io.safety.config import SafetyConfig
from tests.support.lockstep_play import Wild, lockstep

OFF = ((1.3, 0.7), (0.7, 1.3))  # the arm's and the axes' delay over what the gate believes
TIMEOUT = 1.0  # [s], CommTimeout as ABB ships it; the gate is told
SILENCE = tuple(0.05 if unit == "m" else TIMEOUT for unit in JOINT_UNITS)
NOISE = {"m": 1e-4, "rad": 2e-4}  # standard deviation of a measured position
FAST, PATIENCE = 0.5, 15.0  # share of its limit at which a joint is blocked, and [s] in which that falls to nothing
JUMP = 0.005  # [m] of blade's centre or carriage when what blocked a joint is taken away


class BangBang(Wild):
    """Full speed to and fro, most joints at once."""

    def step(self, observation):
        if self.steps == 0:
            self.action = np.sign(self.random.uniform(-1, 1, 8))
        elif self.steps % 18 == 0:
            self.action = -self.action * np.where(self.random.random(8) < 0.3, -1, 1)
        self.steps += 1
        return self.action


class Attack:
    """One robot under attack; ``contacts`` are those that no fault came before."""

    def __init__(self, seed: int, kind=Wild) -> None:
        self.random = np.random.default_rng(seed)
        arm, axes = OFF[seed % 2]
        standard = RigParams()
        params = replace(
            standard,
            pause=0.05,
            arm=replace(standard.arm, comm_timeout=TIMEOUT, dead_time=arm * standard.arm.dead_time),
            axis_dead_time=axes * standard.axis_dead_time,
            drive=replace(standard.drive, position_gain=20.0, holds_measured=seed // 2 % 2 == 1),
        )
        self.rig = rig = lockstep(kind(seed), params=params, safety=SafetyConfig(silence=SILENCE))
        for device, rows, unit in (
            (rig.arm, ABB_JOINTS, "rad"),
            *((emulator, (i,), "m") for i, emulator in zip(FESTO_JOINTS, rig.emulators, strict=True)),
        ):
            self._disturb(device, NOISE[unit], len(rows))
        self.contacts = self.faults = self.trips = 0
        self._collisions = 0
        rig.start()
        rig.throwing = True

    def _disturb(self, device, deviation, joints) -> None:
        step = device.step

        def noisy(now, position, velocity):
            noise = self.random.normal(0.0, deviation, joints)
            return step(now, position + (noise if joints > 1 else float(noise[0])), velocity)

        device.step = noisy

    @property
    def fault(self) -> bool:
        return self.rig.bridge.state is BridgeState.FAULT

    def run(self, seconds: float, until=lambda: False) -> bool:
        """Runs until a condition holds, a fault among them, and counts contacts."""

        def look():
            if self.rig.world.collisions > self._collisions:
                self.contacts += not self.rig.bridge.gate.faults and self.rig.arm.egm_is_running
                self._collisions = self.rig.world.collisions
            return until()

        return self.rig.run(seconds, look)

    def recover(self) -> None:
        """As the operator does after a fault, who tries again, and jogs the arm off the end of its range."""
        self.faults += 1
        self.trips += "moves at" in (self.rig.arm.cause or "")
        for attempt in range(3):
            self.run(0.5)
            try:
                self.rig.recover()
                break
            except RefusedError:
                if attempt == 2:
                    raise
                self.rig.world.jog()
        self._collisions = self.rig.world.collisions

    def play(self, seconds: float) -> None:
        """A policy at play for so long, however often it is stopped."""
        end = self.rig.now + seconds
        while self.rig.now < end:
            if self.run(end - self.rig.now, lambda: self.fault):
                self.recover()

    def moving(self, joint: int | None = None) -> bool:
        """Runs until a ball is played and a joint, or any, is as fast as it gets: the gate keeps some joints slow."""
        rows = slice(None) if joint is None else joint
        limit = FAST * np.array(LIMITS.velocity)

        def fast():
            wanted = limit * max(1.0 - (self.rig.now - begun) / PATIENCE, 0.05)
            return self.fault or (
                self.rig.bridge.state is BridgeState.ACTIVE and (np.abs(self.rig.world.qvel) > wanted)[rows].any()
            )

        for _ in range(5):
            begun = self.rig.now
            self.run(20.0, fast)
            if not self.fault:
                return True
            self.recover()
        return False

    def stall(self) -> None:
        """The bridge answers nobody for 5 to 250 ms in mid-play."""
        if self.moving():
            self.rig.bridge_alive = False
            self.run(float(self.random.uniform(0.005, 0.25)))
            self.rig.bridge_alive = True
            self.run(0.5)
            if self.fault:
                self.recover()

    def block(self, joint: int) -> tuple[bool, float]:
        """A joint meets an obstacle in mid-play: a fault, and how far it jumps [m] when that is gone 2 s later."""
        if not self.moving(joint):
            raise AssertionError("the joint never moves")
        world, advance = self.rig.world, self.rig.world.advance
        place, side = world.qpos[joint], np.sign(world.qvel[joint])

        def blocked(setpoint, duration):
            advance(setpoint, duration)
            if (world.qpos[joint] - place) * side > 0:
                world.hold(joint, place)

        world.advance = blocked
        found = self.run(4.0, lambda: self.fault)
        if found:
            self.run(2.0)
        del world.advance
        middle = self.rig.bridge.gate.geometry.middle
        before, furthest = middle("col_blade_axis", world.qpos), 0.0

        def far():
            nonlocal furthest
            furthest = max(furthest, float(np.linalg.norm(middle("col_blade_axis", world.qpos) - before)))
            return False

        if found:
            self.run(1.0, far)
            self.recover()
        return found, furthest


def attack(seeds, stalls: int, blocks: int, seconds: float) -> list[Attack]:
    """Stalls, blocked joints and seconds of play for each seed."""
    attacks = []
    for seed in seeds:
        one = Attack(seed)
        for _ in range(stalls):
            one.stall()
        blocked = [one.block((seed * blocks + i) % 8) for i in range(blocks)]
        # A joint that turns back by itself in time is no fault; most do not.
        assert sum(found for found, _ in blocked) >= blocks // 2, (seed, blocked)
        assert max((jump for _, jump in blocked), default=0.0) < JUMP, (seed, blocked)
        one.play(seconds)
        attacks.append(one)
        print(f"seed {seed}: {one.rig.now:.0f} s, {one.faults} faults, {one.trips} trips, {one.contacts} contacts")
    return attacks


def test_stalls_blocked_joints_and_a_random_policy_touch_nothing_before_a_fault():
    (one,) = attack([0], stalls=2, blocks=2, seconds=2.0)
    assert one.contacts == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_stalls_blocked_joints_and_minutes_of_play(seed):
    """Divided by seed: delays off either way, with both kinds of drive.

    A fiftieth by default. ADVERSARY=1: a thousand stalls, two hundred blocked joints and forty minutes, in about an
    hour of a core.
    """
    part = float(os.environ.get("ADVERSARY", "0.02"))
    (one,) = attack([seed], stalls=round(250 * part), blocks=round(50 * part), seconds=600.0 * part)
    assert one.contacts == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_full_speed_to_and_fro_leaves_the_drives_their_head_room(seed):
    one = Attack(seed, BangBang)
    one.play(120.0)
    assert one.contacts == 0 and one.trips <= 6  # 17 without head room
