"""The measured speed of the arm behind packets that bunch up, and behind clocks of the controller that lie."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.contract import ABB_JOINTS
from robot_io.control.observation import joints
from robot_io.emulator.lockstep import CONTROLLER
from robot_io.limits import LIMITS
from robot_io.safety.faults import Cause
from tests.robot_io.devices.test_egm import packet
from tests.support.lockstep_play import lockstep

CYCLE = 0.004
JOINT_1 = ABB_JOINTS[0]
FASTEST = 1.5 * LIMITS.velocity[JOINT_1]  # [rad/s] above which it is a fault


def receive(sent, arrivals, positions, clock):
    """Packets of joint 1 through a bridge's own session: its speed [rad/s] and its faults after each of them.

    sent, arrivals  (n,) [s]; clock: stamp [s] of a packet that is sent at that time
    """
    bridge = lockstep().bridge
    speeds, faults = [], []
    for time, arrival, position in zip(sent, arrivals, positions, strict=True):
        measured = np.zeros(6)
        measured[0] = position
        if bridge.arm_session.receive(packet(round(time / CYCLE), clock(time), measured), CONTROLLER, arrival):
            bridge.arm_received(arrival)
            bridge.axes_received(np.zeros(2), arrival)
        speeds.append(joints(bridge.feedback)[1][JOINT_1])
        bridge.gate.command(np.zeros(8), *joints(bridge.feedback), arrival)
        faults.append(Cause.LIMIT in bridge.gate.present)
    return np.array(speeds), np.array(faults)


def bunched(sent, late, begin):
    """Arrivals of packets where the one sent at ``begin`` and those after it wait for ``late`` [s] together."""
    waits = (sent >= begin) & (sent < begin + late)
    return np.where(waits, begin + late + 2e-4 * np.cumsum(waits), sent) + 1e-4


@pytest.mark.parametrize("late", (0.012, 0.02, 0.036, 0.048))
def test_packets_that_bunched_up_are_no_fast_joint(late):
    sent = 5.0 + CYCLE * np.arange(500)
    steady = 3.1  # [rad/s], as fast as joint 1 was in play
    position = -1.3 + steady * np.maximum(sent - 6.35, 0.0)
    speeds, faults = receive(sent, bunched(sent, late, 6.5), position, lambda t: t)
    known = sent > 6.4
    np.testing.assert_allclose(speeds[known], steady, rtol=0.02)
    assert not faults.any()


CLOCKS = {
    "right": lambda t: t,
    "stands still": lambda t: 5.0,
    "stands still from now on": lambda t: min(t, 7.0),
    "ticks every 24 ms": lambda t: t // 0.024 * 0.024,
    "twice as fast": lambda t: 2.0 * t,
    "twice as fast from now on": lambda t: t + max(t - 7.0, 0.0),
    "a tenth too fast from now on": lambda t: t + 0.1 * max(t - 7.0, 0.0),
    "half as fast": lambda t: 0.5 * t,
    "jumps ahead": lambda t: t + 0.5 * (t > 7.0),
    "jumps ahead again and again": lambda t: t + 0.03 * max((t - 7.0) // 0.04, 0.0),
    "jumps back": lambda t: t - 2.0 * (t > 7.0),
}


@pytest.mark.parametrize("name", CLOCKS)
@pytest.mark.parametrize("late", (0.0, 0.02))
def test_a_fast_joint_is_a_fault_whatever_the_controllers_clock_does(name, late):
    """From 1 rad/s to twice its allowed speed at 7 s: the fault comes as soon as by arrivals alone."""
    sent = 5.0 + CYCLE * np.arange(530)
    position = -2.0 + np.clip(sent - 6.5, 0.0, 0.5) + 2.0 * FASTEST * np.maximum(sent - 7.0, 0.0)
    arrivals = bunched(sent, late, 7.02) if late else sent + 1e-4
    by_arrivals, _ = receive(sent, arrivals, position, lambda t: 5.0)
    _, faults = receive(sent, arrivals, position, CLOCKS[name])
    first = np.flatnonzero(faults & (sent > 7.0))[0]
    assert arrivals[first] <= 7.0 + 0.04 + late
    if name not in ("half as fast", "stands still from now on"):  # that err to the safe side
        assert not faults[:first].any()
    expected = np.flatnonzero(np.abs(by_arrivals) > FASTEST)
    assert arrivals[first] <= arrivals[expected[expected > 500 - 1][0]] + 3 * CYCLE


def test_a_gap_hides_no_motion():
    """After a silence the speed over it counts until there are samples enough, not zero."""
    sent = 5.0 + CYCLE * np.arange(300)
    heard = (sent < 6.0) | (sent > 6.045)
    speeds, _ = receive(sent[heard], sent[heard] + 1e-4, sent[heard] - 5.5, lambda t: t)
    after = sent[heard] > 6.0
    assert after.any() and (np.abs(speeds[after] - 1.0) < 0.3).all()
