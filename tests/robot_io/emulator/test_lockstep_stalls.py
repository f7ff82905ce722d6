"""Random stalls of bridge, tracker, axes and arm while balls are played, in lock-step.

``python -m tests.robot_io.emulator.test_lockstep_stalls 1000 [seed]`` plays as many as wanted and prints the counts.
"""

from __future__ import annotations

import sys
from collections import Counter, deque
from functools import partial

import numpy as np
import pytest

from robot_io.contract import JOINT_UNITS
from robot_io.control.bridge import BridgeState
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS
from robot_io.safety.clearance import BLADE
from robot_io.safety.config import SafetyConfig
from robot_io.safety.faults import Cause
from tests.support.lockstep_play import Swing, lockstep, playing

KINDS = ("bridge", "tracker", "axes", "arm")
SHORTEST, LONGEST = 0.05, 5.0  # [s]
AWAY = np.array([0.02 if unit == "m" else np.radians(3.0) for unit in JOINT_UNITS])
T = 1 / 75
LOWER, UPPER = np.array(LIMITS.lower), np.array(LIMITS.upper)


class Watched:
    """A rig at play; the farthest that its joints were outside their ranges [m], [rad], and the blade's extremes."""

    def __init__(self, seed):
        self.rig = playing(Swing(0.4 + 0.1 * (seed % 5)))
        self.worst = {"outside": 0.0, "speed": 0.0, "acceleration": 0.0}
        self._next = 0.0
        self._blade: deque[np.ndarray] = deque(maxlen=3)

    def run(self, seconds, until=lambda: False):
        rig, worst = self.rig, self.worst

        def look():
            if rig.now >= self._next:
                self._next = rig.now + T - 1e-6
                q = rig.world.qpos
                worst["outside"] = max(worst["outside"], float(np.maximum(LOWER - q, q - UPPER).max()))
                self._blade.append(rig.bridge.gate.geometry.middle(BLADE, q))
                if len(self._blade) == 3:
                    velocity = np.diff(self._blade, axis=0) / T
                    worst["speed"] = max(worst["speed"], float(np.linalg.norm(velocity[1])))
                    acceleration = float(np.linalg.norm(velocity[1] - velocity[0])) / T
                    worst["acceleration"] = max(worst["acceleration"], acceleration)
            return until()

        return rig.run(seconds, look)

    def recover(self):
        """By the operator's keys; True when balls are played again."""
        self._blade.clear()  # a jog is a jump here
        self.rig.recover()
        return self.run(12.0, lambda: self.rig.bridge.state is BridgeState.ACTIVE)


def stall(watched, kind, seconds):
    """Stops one of them for a while."""
    rig = watched.rig
    if kind == "bridge":
        rig.bridge_alive = False
    elif kind == "arm":
        rig.arm_connected = False
    elif kind == "axes":
        for emulator in rig.emulators:
            emulator.disconnect()
    else:
        rig.cameras.drop_out(rig.now + seconds)
    watched.run(seconds)
    rig.bridge_alive = rig.arm_connected = True
    for emulator in rig.emulators:
        emulator.reconnect()


def played(count, seed=0, say=lambda text: None):
    """Counts of what happened in so many stalls, and the largest deviations."""
    random, found = np.random.default_rng(seed), Counter()
    worst = Counter({"away [m]": 0.0, "away [rad]": 0.0})
    watched = Watched(seed)
    for number in range(count):
        rig, kind = watched.rig, KINDS[random.integers(len(KINDS))]
        seconds = float(np.exp(random.uniform(np.log(SHORTEST), np.log(LONGEST))))
        watched.run(random.uniform(0.0, 0.6))
        before = rig.world.collisions
        try:
            stall(watched, kind, seconds)
            watched.run(1.0)
        except Exception as error:  # what the bar counts
            found[f"exception {type(error).__name__}"] += 1
            say(f"{number} {kind} {seconds:.2f} s: {type(error).__name__}: {error}")
            watched = Watched(seed)
            continue
        found["stalls"] += 1
        found[f"stalls of {kind}"] += 1
        found["collisions"] += rig.world.collisions > before
        faults = rig.bridge.gate.faults
        found["internal"] += any(fault.cause is Cause.INTERNAL for fault in faults)
        if rig.bridge.state is BridgeState.FAULT:
            found["faults"] += 1
            found[f"fault {faults[0].cause.value} of {kind}"] += 1
            away = np.abs(rig.bridge.gate.reference - rig.world.qpos)
            worst["away [m]"] = max(worst["away [m]"], float(away[:2].max()))
            worst["away [rad]"] = max(worst["away [rad]"], float(away[2:].max()))
            found["away"] += bool((away > AWAY).any())
            try:
                recovered = watched.recover()
                found["recovered"] += recovered
                if not recovered:
                    say(f"{number} {kind} {seconds:.2f} s, {faults[0]}: {rig.bridge.state}, {rig.bridge.gate.faults}")
                    watched = Watched(seed)
            except RefusedError as error:
                found["refused"] += 1
                say(f"{number} {kind} {seconds:.2f} s, {faults[0]}: {error}")
                watched = Watched(seed)
        for name, value in watched.worst.items():
            worst[name] = max(worst[name], value)
        rig.summaries.clear()
        if number % 10 == 9:
            say(f"{number + 1}: {dict(found)} {dict(worst)}")
    return found, worst


@pytest.mark.slow
def test_random_stalls_stop_the_robot_where_it_is_and_recovery_works():
    found, worst = played(24)
    assert found["stalls"] == 24 and found["faults"] >= 8, found
    assert not found["internal"] and not found["collisions"] and not found["away"], (found, worst)
    assert found["recovered"] == found["faults"], found
    assert worst["outside"] <= 0.0
    assert worst["speed"] < SafetyConfig().blade_speed


def fast(rig, monkeypatch):
    """Velocities (8,) that the devices are told from now on; the arm is so fast that braking takes several ticks.

    Where one tick stops it, nothing shows from which velocity it was braked.
    """
    bridge, told, reply = rig.bridge, [], rig.bridge.arm_session.reply

    def noted(position, velocity, now):
        told.append(np.concatenate([bridge.gate.velocity[:2], velocity]))
        return reply(position, velocity, now)

    monkeypatch.setattr(bridge.arm_session, "reply", noted)
    assert rig.run(3.0, lambda: bool(told) and np.abs(told[-1][2:]).max() > 4.0)
    return told


@pytest.mark.parametrize("seconds", [0.045, 0.07, 0.095, 0.3])
@pytest.mark.parametrize("streams", [True, False])
def test_a_bridge_that_stood_still_makes_nothing_faster_again(seconds, streams, monkeypatch):
    """With the shipped RAPID's time-out EGM survives 0.1 s: what is sent then reaches an arm that moves."""
    rig = playing(Swing(0.5), params=RigParams(pause=0.05, arm=ArmParams(comm_timeout=0.1, stream_always=streams)))
    bridge, told = rig.bridge, fast(rig, monkeypatch)
    rig.bridge_alive = False
    rig.run(seconds)
    told.clear()
    rig.bridge_alive = True
    rig.run(1.0)
    assert len(told) > 50 or not streams  # without a stream EGM, which ended after 0.1 s, is silent
    assert len(told) > 10 or seconds > 0.1
    speeds = np.abs(told)
    assert bridge.state is BridgeState.FAULT and (np.diff(speeds, axis=0) <= 1e-9).all()
    assert bridge.gate.at_rest and not rig.world.collisions
    rig.recover()
    assert bridge.state is BridgeState.READY


def test_an_error_that_lasted_for_some_ticks_makes_nothing_faster_again(monkeypatch):
    rig = playing(Swing(0.5))
    bridge, told, watch = rig.bridge, fast(rig, monkeypatch), rig.bridge.gate._watch

    def broken(*arguments):
        raise ZeroDivisionError("a mistake of ours")

    told.clear()
    monkeypatch.setattr(bridge.gate, "_watch", broken)
    rig.run(10 * T)
    monkeypatch.setattr(bridge.gate, "_watch", watch)
    rig.run(1.0)
    arm = np.abs(told)[:, 2:]
    assert len(told) > 200 and (np.diff(arm, axis=0) <= 1e-9).all() and not arm[-1].any()
    assert bridge.gate.faults[0].cause is Cause.INTERNAL and bridge.gate.at_rest


def test_a_pulled_cable_of_the_arm_is_a_fault_and_mended():
    rig = lockstep()
    rig.start()
    rig.arm_connected = False
    rig.run(0.5)
    assert rig.bridge.state is BridgeState.FAULT
    rig.arm_connected = True
    rig.recover()
    assert rig.bridge.state is BridgeState.READY


if __name__ == "__main__":
    counts, largest = played(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0, partial(print, flush=True))
    for what, number in [*counts.most_common(), *largest.items()]:
        print(f"{number:10.6g}  {what}")
