"""Robots with other joints than the paper's: the emulator's arm and axes, gate and bridge take them from one YAML."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_tt.robot import robots
from robot_io.control.interfaces import BridgeConfig
from robot_io.devices.egm.messages import EgmError, EgmRobot, decode_robot, encode_robot
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.safety.clearance import RobotGeometry
from robot_io.safety.config import SafetyConfig
from robot_io.safety.gate import SafetyGate
from tests.support.lockstep_play import throws

OTHERS = [name for name in robots.names() if name != robots.DEFAULT]


class Wild:
    """Random actions, a new one every few steps; keeps what it is shown."""

    def __init__(self, joints: int):
        self.random, self.joints, self.seen = np.random.default_rng(0), joints, []

    def reset(self):
        self.steps = 0

    def step(self, observation):
        if self.steps % 8 == 0:
            self.action = self.random.uniform(-1.0, 1.0, self.joints)
        self.steps += 1
        self.seen.append(observation.copy())
        return self.action


@pytest.fixture(scope="module", params=OTHERS)
def played(request):
    """A robot, its rig after three balls of a wild policy, that policy, and its joints at every control tick."""
    robot = robots.load_shipped(request.param)
    policy = Wild(robot.contract.n_joints)
    rig = LockStep(robot.scene(), throws(), policy, RigParams(pause=0.05), BridgeConfig(contract=robot.contract))
    rig.start()
    at_home, moved = rig.world.qpos.copy(), []
    step = rig.step

    def watched():
        step()
        moved.append(np.concatenate([rig.world.qpos, rig.bridge.gate.velocity]))

    rig.step = watched
    summaries = rig.play(3)
    return robot, rig, policy, at_home, np.array(moved), summaries


def test_it_comes_home_and_plays(played):
    robot, rig, policy, at_home, _, summaries = played
    np.testing.assert_allclose(at_home, robot.home, atol=0.03)
    assert len(summaries) == 3 and not any(summary.fault for summary in summaries), rig.bridge.gate.faults
    assert np.array(policy.seen).shape[1] == robot.contract.n_observation


def test_a_wild_policy_touches_nothing_and_keeps_the_limits(played):
    robot, rig, _, _, moved, _ = played
    n, limits = robot.contract.n_joints, robot.contract.limits
    position, command = moved[:, :n], moved[:, n:]
    assert rig.world.collisions == 0
    geometry = RobotGeometry.of(robot.contract)
    assert geometry.gaps(position[::5].T).min() > 0.0
    assert (np.abs(command) <= np.array(limits.velocity) * (1 + 1e-9)).all()
    assert (position > np.array(limits.lower)).all() and (position < np.array(limits.upper)).all()
    assert np.ptp(position, axis=0).min() > 0.01  # every joint moved


def test_the_policy_sees_the_joints_in_the_contracts_order(played):
    """Every component of what it saw lies where its own joint was."""
    robot, _, policy, _, moved, _ = played
    seen = np.array(policy.seen)[:, 3:]
    low, high = moved[:, : robot.contract.n_joints].min(axis=0), moved[:, : robot.contract.n_joints].max(axis=0)
    assert (seen > low - 0.02).all() and (seen < high + 0.02).all()
    assert (np.abs(seen - robot.home).max(axis=0) > 0.005).all()


def test_a_gate_of_two_robots_is_refused():
    fr3 = robots.load_shipped("fr3_pedestal").contract
    with pytest.raises(ValueError, match="must be one robot's"):
        SafetyGate(fr3.limits)
    with pytest.raises(ValueError, match="must be one robot's"):
        SafetyGate(fr3.limits, geometry=RobotGeometry.of(fr3))
    SafetyGate(fr3.limits, geometry=RobotGeometry.of(fr3), config=SafetyConfig.of(fr3))


def test_a_seventh_joint_travels_as_an_external_one():
    """As ABB's seven-axis arms send it; a message without it is none of such an arm."""
    position = np.linspace(-1.0, 1.0, 7)
    datagram = encode_robot(1, 4, position, position, True, True, True)
    np.testing.assert_allclose(decode_robot(datagram, 7).position, position, atol=1e-12)
    message = EgmRobot.FromString(datagram)
    assert len(message.feedBack.joints.joints) == 6 and len(message.feedBack.externalJoints.joints) == 1
    np.testing.assert_allclose(decode_robot(datagram).position, position[:6], atol=1e-12)
    six = encode_robot(1, 4, position[:6], position[:6], True, True, True)
    with pytest.raises(EgmError, match="externalJoints has 0 numbers, joints 7 to 7 of the arm are wanted there"):
        decode_robot(six, 7)
