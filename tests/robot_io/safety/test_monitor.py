"""Measured speeds against limits that a speed scale has lowered."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.control.bridge import BridgeState
from robot_io.control.observation import joints
from robot_io.limits import LIMITS
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SafetyConfig
from robot_io.safety.faults import Cause
from robot_io.safety.gate import SafetyGate
from robot_io.safety.monitor import UNSCALED
from tests.support.lockstep_play import Swing, Wild, lockstep

T = 1 / 75
JOINT_1 = 2


def faults_at(scale, speed):
    """Causes after five ticks in which joint 1 stands by its position and is measured at a speed [rad/s]."""
    geometry = RobotGeometry.load()
    gate = SafetyGate(geometry=geometry, config=SafetyConfig(speed_scale=scale))
    gate.arm(geometry.home, 100.0, np.zeros(8))
    velocity = np.zeros(8)
    velocity[JOINT_1] = speed
    for i in range(5):
        gate.command(np.zeros(8), geometry.home, velocity, 100.0 + T * i)
    return [fault.cause for fault in gate.faults]


@pytest.mark.parametrize("scale", [0.001, 0.1, 0.5, 1.0])
def test_a_joint_much_faster_than_its_scaled_limit_is_a_fault(scale):
    """By half of the limit, and by what noise and position corrections may add; never by more than without a scale."""
    fastest = 1.5 * LIMITS.velocity[JOINT_1]
    allowed = min(fastest, scale * fastest + UNSCALED["rad"])
    assert faults_at(scale, 0.99 * allowed) == [] and faults_at(scale, 1.01 * allowed) == [Cause.LIMIT]


def test_an_arm_at_fourteen_times_its_scaled_speed_is_a_fault():
    assert faults_at(0.1, 6.0) == [Cause.LIMIT]


@pytest.mark.parametrize("scale", [0.1, 1.0])
@pytest.mark.parametrize("policy", [Swing(1.0), Wild(1)], ids=["swing", "wild"])
def test_play_at_the_full_scaled_speed_is_no_fault(scale, policy):
    """On the emulated robot, whose joints push each other and whose position corrections no scale lowers."""
    rig, fastest = lockstep(policy, safety=SafetyConfig(speed_scale=scale)), np.zeros(8)
    rig.start()
    rig.throwing = True

    def fault():
        np.maximum(fastest, np.abs(joints(rig.bridge.feedback)[1]), out=fastest)
        return rig.bridge.state is BridgeState.FAULT

    assert not rig.run(8.0, fault), rig.bridge.gate.faults
    assert (fastest > 0.5 * scale * np.array(LIMITS.velocity))[2:].any()
