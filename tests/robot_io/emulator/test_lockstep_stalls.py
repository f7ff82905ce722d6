"""Random stalls of bridge, tracker, axes and arm while balls are played, in lock-step.

``python -m tests.robot_io.emulator.test_lockstep_stalls 1000 [seed]`` plays as many as wanted and prints the counts.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np
import pytest

from robot_io.contract import JOINT_UNITS, LIMITS
from robot_io.control.bridge import BridgeState
from robot_io.errors import RefusedError
from robot_io.safety.faults import Cause
from tests.support.lockstep_play import Swing, lockstep, playing

KINDS = ("bridge", "tracker", "axes", "arm")
SHORTEST, LONGEST = 0.05, 5.0  # [s]
AWAY = np.array([0.02 if unit == "m" else np.radians(3.0) for unit in JOINT_UNITS])
LOWER, UPPER = np.array(LIMITS.lower), np.array(LIMITS.upper)


class Watched:
    """A rig at play, and the farthest that its joints were ever outside their ranges [m], [rad]."""

    def __init__(self, seed):
        self.rig, self.outside, self._ticks = playing(Swing(0.4 + 0.1 * (seed % 5))), 0.0, 0

    def run(self, seconds, until=lambda: False):
        def look():
            self._ticks += 1
            if self._ticks % 4 == 0:
                q = self.rig.world.qpos
                self.outside = max(self.outside, float(np.maximum(LOWER - q, q - UPPER).max()))
            return until()

        return self.rig.run(seconds, look)


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


def played(count, seed=0):
    """Counts of what happened in so many stalls, and the largest deviations."""
    random, found, worst = np.random.default_rng(seed), Counter(), {"away": 0.0, "outside": 0.0}
    watched = Watched(seed)
    for _ in range(count):
        rig, kind = watched.rig, KINDS[random.integers(len(KINDS))]
        seconds = float(np.exp(random.uniform(np.log(SHORTEST), np.log(LONGEST))))
        watched.run(random.uniform(0.0, 0.6))
        try:
            stall(watched, kind, seconds)
            watched.run(1.0)
        except Exception as error:  # what the bar counts
            found[f"exception {type(error).__name__}"] += 1
            watched = Watched(seed)
            continue
        found["stalls"] += 1
        found["collisions"] += rig.world.collisions > 0
        faults = rig.bridge.gate.faults
        found["internal"] += any(fault.cause is Cause.INTERNAL for fault in faults)
        if rig.bridge.state is BridgeState.FAULT:
            found["faults"] += 1
            found[f"fault {faults[0].cause.value}"] += 1
            away = np.abs(rig.bridge.gate.reference - rig.world.qpos) / AWAY
            worst["away"] = max(worst["away"], float(away.max()))
            found["away"] += bool((away > 1.0).any())
            try:
                rig.recover()
                found["recovered"] += watched.run(6.0, lambda rig=rig: rig.bridge.state is BridgeState.ACTIVE)
            except RefusedError as error:
                found[f"refused: {error}"] += 1
                watched = Watched(seed)
        worst["outside"] = max(worst["outside"], watched.outside)
        rig.summaries.clear()
    return found, worst


@pytest.mark.slow
def test_random_stalls_stop_the_robot_where_it_is_and_recovery_works():
    found, worst = played(24)
    assert found["stalls"] == 24 and found["faults"] >= 8, found
    assert not found["internal"] and not found["collisions"] and not found["away"], (found, worst)
    assert found["recovered"] == found["faults"], found
    assert worst["outside"] <= 0.0


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
    counts, largest = played(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    for what, number in counts.most_common():
        print(f"{number:6d}  {what}")
    print(f"reference away from the arm at most {largest['away']:.2f} of what is allowed")
    print(f"joints outside their ranges by at most {largest['outside']:.4f}")
