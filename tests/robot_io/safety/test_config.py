"""The arm behind its position correction: beyond its reference by gain x lag x way at most, and inside its range."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.contract import ABB_JOINTS
from robot_io.control.config import axis_range
from robot_io.devices.egm.messages import encode_sensor
from robot_io.emulator.arm import ArmController, ArmParams
from robot_io.limits import LIMITS
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.gate import GateState, SafetyConfig, SafetyGate

LOWER, UPPER, V_MAX = (np.array(getattr(LIMITS, name)) for name in ("lower", "upper", "velocity"))
CLIENT = ("127.0.0.1", 6510)
ARM = list(ABB_JOINTS)
SERVO = 0.008  # [s] lag of the drives
LATE = 30  # [ms] of the measurement


class Nowhere(RobotGeometry):
    """Nothing to collide with."""

    def first_too_close(self, q, margin, slack):
        return None

    def clear_beside(self, way, beside, margin):
        return True


def swung(joint, config):
    """From end to end at full speed, twice: the farthest outside the range [rad], and the gate."""
    gate = SafetyGate(config=config, geometry=Nowhere.load())
    arm = ArmController(CLIENT, ArmParams(comm_timeout=0.06, ramp_in=0.0))
    arm.motors_on()
    arm.start_rapid()
    arm.start_egm()
    q, speed, worst, sign = gate.geometry.home.copy(), np.zeros(6), -np.inf, 1.0
    q[joint] = 0.0
    past = [q.copy()] * 100  # one per ms
    gate.arm(q, 10.0, np.zeros(8))
    tick, velocity = 10.0, np.zeros(6)
    for n in range(1, 3500):
        now = 10.0 + n / 1000
        if n % 4 == 0:
            velocity, _ = arm.step(now, q[ARM], speed)
        speed = speed + (velocity - speed) * (1.0 - np.exp(-0.001 / SERVO))
        q[ARM] += 0.001 * speed
        past.append(q.copy())
        worst = max(worst, float(np.maximum(LOWER - q, q - UPPER)[joint]))
        if n % 40 in (0, 13, 27):
            if n > 200 and not gate.velocity.any() and n % 1000 < 40:
                sign = -sign
            measured, tick = past[-LATE], now
            gate.command(sign * np.eye(8)[joint] * V_MAX, measured, (measured - past[-LATE - 40]) / 0.04, now)
        if n % 4 == 1 and n > 4:
            position = (gate.start + gate.velocity * (now - tick))[ARM]
            arm.receive(encode_sensor(n, 4 * n, position, gate.velocity[ARM]), CLIENT, now)
    return worst, gate


@pytest.mark.parametrize("joint", [5, 6, 7])
def test_a_joint_swung_from_end_to_end_stays_inside_its_range(joint):
    worst, gate = swung(joint, SafetyConfig(speed_scale=1.0))
    assert -0.1 < worst < -0.005 and gate.state is GateState.ARMED, (worst, gate.faults)


def test_without_room_for_the_overshoot_joint_5_leaves_its_range():
    """So the drive overshoots, and the room is what keeps it in."""
    worst, gate = swung(6, SafetyConfig(speed_scale=1.0, overshoot=LIMITS.margin))
    assert worst > 0.002 and gate.faults[0].cause.value == "limit"


def test_the_drives_of_the_axes_keep_the_same_room():
    """Places that they were sent last are reached by themselves when the bridge stands still."""
    assert axis_range(1, SafetyConfig()) == (-0.47, 0.47)
    assert axis_range(0, SafetyConfig(overshoot=LIMITS.margin)) == (-0.99, 0.99)
