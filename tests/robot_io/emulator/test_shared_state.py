"""The joints' motion as arm and axes see it while the processes of the rig are not on time."""

from __future__ import annotations

import os
import select
import signal
import time
from types import SimpleNamespace

import numpy as np
import pytest

from robot_io.contract import ABB_JOINTS, N_JOINTS
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.udp import UdpSocket
from robot_io.emulator import shared_state
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.config import RigParams
from robot_io.emulator.processes import HOST, Rig
from robot_io.emulator.shared_state import PATIENCE, Motion, Shared
from robot_io.limits import LIMITS
from tests.support.lockstep_play import throws
from tests.support.paths import SCENE

STEP, CYCLE, SPEED = 0.002, 0.004, 3.0


class World:
    """A clock, and a world that publishes every 2 ms of it, all joints at ``SPEED``; asleep: until it wakes up.

    most: steps that it makes while another process sleeps once, few on a busy machine
    """

    def __init__(self, shared):
        self.shared, self.now, self.published, self.wakes, self.most = shared, 1.0, 1.0, 0.0, 1000
        self.pass_by(0.01)

    def pass_by(self, seconds):
        self.now, steps = self.now + seconds, 0
        while self.now >= self.wakes and self.published + STEP <= self.now and steps < self.most:
            self.published, steps = self.published + STEP, steps + 1
            each = np.full(N_JOINTS, SPEED)
            self.shared.publish(time=self.published, qpos=each * self.published, qvel=each)

    def monotonic(self):
        return self.now

    sleep = pass_by


@pytest.fixture
def world(monkeypatch):
    shared = Shared()
    world = World(shared)
    monkeypatch.setattr(shared_state, "clock", world)
    yield world
    shared.close()


def follow(world, motion, cycles, start):
    """Misses of the positions (n,) [rad] at the times of a device's cycles, each as soon as it can."""
    missed = []
    for n in range(1, cycles + 1):
        due = start + n * CYCLE
        world.pass_by(max(due - world.now, 0.0))
        position, velocity = motion.at(due)
        np.testing.assert_allclose(velocity, SPEED)
        missed.append(np.abs(position - SPEED * due).max())
    return np.array(missed)


def test_a_device_that_begins_before_the_world_waits_for_it(monkeypatch):
    """Its first cycles told joints at zero, and its feedback then jumped to where they are."""
    shared, now = Shared(), 1.0

    def sleep(seconds):
        nonlocal now
        now += seconds
        if not shared["version"][0] and now > 6.0:
            shared.publish(time=now, qpos=0.5, qvel=0.0)

    monkeypatch.setattr(shared_state, "clock", SimpleNamespace(monotonic=lambda: now, sleep=sleep))
    position, _ = Motion(shared).at(now)
    np.testing.assert_allclose(position, 0.5)
    nothing = Shared()
    with pytest.raises(TimeoutError, match="the world has not begun within 60 s"):
        Motion(nothing)
    shared.close(), nothing.close()


@pytest.mark.parametrize("seconds", (0.01, 0.05, 0.15))
def test_a_world_that_catches_up_is_no_jump(world, seconds):
    motion, start = Motion(world.shared), world.now
    world.wakes = world.now + 0.02 + seconds
    assert follow(world, motion, 80, start).max() < 1e-9


@pytest.mark.parametrize("seconds", (0.01, 0.05, 0.15))
def test_cycles_that_are_made_up_for_are_told_where_the_joints_were(world, seconds):
    motion, start = Motion(world.shared), world.now
    assert follow(world, motion, 10, start).max() < 1e-9
    world.pass_by(seconds)
    assert follow(world, motion, 60, start + 10 * CYCLE).max() < 1e-9


@pytest.mark.parametrize("looks", (1, 20))
def test_a_world_that_is_late_for_long_but_gets_on_is_no_jump(world, looks):
    """All stood still for 0.45 s; then the world makes one step in so many looks, and falls back further at first."""
    motion, start = Motion(world.shared), world.now
    assert follow(world, motion, 10, start).max() < 1e-9
    world.most, asleep = 0, world.now
    world.pass_by(0.45)
    sleep, slept = world.pass_by, 0

    def slowly(seconds):
        nonlocal slept
        slept += 1
        world.most = 1 if slept % looks == 0 else 0
        sleep(seconds)

    world.sleep = slowly
    assert follow(world, motion, 200, start + 10 * CYCLE).max() < 1e-9
    assert world.now - asleep > (1.0 if looks > 1 else 0.45)


def test_a_late_world_does_not_run_on_at_old_set_points(world):
    """It is 0.1 s late: each of its steps waits until arm and axes have had their cycle, if they ever do."""
    late, shared = 0.1, world.shared
    for lag, waits in ((0.004, False), (0.008, False), (0.02, True)):
        shared["driven"][:] = world.now - late, world.now - late - lag
        before = world.now
        shared.await_drives(before - late)
        assert (world.now > before) == waits
        assert not waits or world.now == pytest.approx(before + PATIENCE, abs=0.001)
    before = world.now
    shared.await_drives(before - 0.005)  # in time: the world goes on whatever the others do
    assert world.now == before


def test_a_world_that_was_stopped_is_not_waited_for_for_ever(world):
    motion = Motion(world.shared)
    world.wakes, stood, due = np.inf, SPEED * world.published, world.now + 0.02
    position, _ = motion.at(due)
    assert world.now == pytest.approx(due - 0.02 + PATIENCE, abs=0.002)
    np.testing.assert_allclose(position, stood, atol=SPEED * 0.0041)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("who", ("rig-world", "rig-arm"))
def test_a_stopped_process_of_the_rig_is_no_fast_joint(who):
    """The real rig: joint 1 sways while one of its processes stands still for 40 ms, every half second."""
    with Rig(SCENE, throws(), RigParams(arm=ArmParams(comm_timeout=1.0))) as rig:
        session, speeds, last, stopped = EgmSession(EgmConfig()), [], None, 0
        [pid] = [process.pid for process in rig._processes.values() if process.name == who]
        with UdpSocket(HOST, rig.robot.arm.port, "arm") as wire:
            rig.switch_on()
            start = None
            while start is None or time.monotonic() < start + 3.0:
                assert select.select([wire.fileno()], [], [], 2.0)[0], "no packet of the arm's controller"
                now = time.monotonic()
                if (
                    not any([session.receive(*packet, now) for packet in wire.drain()])
                    or not session.feedback.egm_running
                ):
                    continue
                seen = session.feedback
                if start is None:
                    start, home, last = now, seen.position, seen
                    np.testing.assert_allclose(home, rig.state()[0][list(ABB_JOINTS)], atol=0.01)
                wanted, speed = home.copy(), np.zeros(6)
                phase = 2.0 * np.pi * (now - start)
                wanted[0], speed[0] = home[0] + 0.4 * np.sin(phase), 0.8 * np.pi * np.cos(phase)
                wire.send(session.reply(wanted, speed, now), session.endpoint)
                if seen.time - last.time >= 0.04:
                    speeds.append((seen.position - last.position) / (seen.time - last.time))
                    last = seen
                if now > start + 0.5 * (stopped + 1):
                    stopped += 1
                    os.kill(pid, signal.SIGSTOP)
                    time.sleep(0.04)
                    os.kill(pid, signal.SIGCONT)
    fastest = np.abs(speeds).max(axis=0)
    assert stopped >= 5 and 2.0 < fastest[0] < 3.3 < LIMITS.velocity[ABB_JOINTS[0]]
