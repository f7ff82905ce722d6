"""``mjx-tt calibrate`` for robots with other joints than the paper's, on rigs with hidden errors."""

from __future__ import annotations

import csv
from functools import cache

import mujoco
import numpy as np
import pytest

from experiments import cli
from experiments.config import robot as robots
from mjx_tt.robot import robots as simulated
from robot_io.calibrated import UNCALIBRATED
from robot_io.control.interfaces import BridgeConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.hidden import HiddenErrors
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.world import World
from tests.support.hidden_rig import touches
from tests.support.lockstep_play import throws

FR3, UR10E = "fr3_pedestal", "ur10e_rail"
ZEROS = {
    FR3: (0.012, -0.012, 0.012, -0.012, 0.012, -0.012, 0.012),
    UR10E: (0.012, -0.012, 0.012, -0.012, 0.012, -0.012),
}
BLADE = 0.076  # [m]
SPREAD = {FR3: [0.6, 0.5, 0.5, 0.5, 1.0, 0.7, 1.2], UR10E: [0.5, 0.6, 0.4, 0.5, 1.0, 0.7, 1.2]}


@cache
def standing(name):
    """A robot that comes with the program, and a world of its own."""
    robot = simulated.load_shipped(name)
    return robot, World(robot.scene(), contract=robot.contract)


def touched(name, count=40, seed=0):
    """Touches with the blade's end, a clamp beside it and one in front; both in the frame of its flange, along z."""
    robot, world = standing(name)
    centre = world.model.site("paddle").pos
    tips = centre + np.array([[0.0, 0.0, BLADE], [0.0, 0.08, 0.0], [0.05, -0.08, 0.0]])
    hidden = HiddenErrors(joint_zeros=ZEROS[name])
    return touches(hidden, count, seed=seed, rig=world, arm=robot.contract.arm, spread=SPREAD[name], tips=tips)


def write(path, names, rows):
    with open(path, "w", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerows([names, *rows])
    return path


TABLE, PADDLE = ([f"{what}_{axis}" for axis in "xyz"] for what in ("table", "paddle"))


class Hold:
    def __init__(self, joints):
        self.joints = joints

    def reset(self):
        pass

    def step(self, observation):
        return np.zeros(self.joints)


@pytest.fixture(params=[FR3, UR10E])
def calibrated(request, tmp_path, monkeypatch, capsys):
    """A robot's name and what was found and told, with one wrong touch among 40."""
    monkeypatch.chdir(tmp_path)
    robot, _ = standing(request.param)
    table, joints, paddle = touched(request.param)
    table[7] += [0.0, 0.04, 0.0]
    write("touches.csv", [*TABLE, *robot.contract.joints, *PADDLE], np.concatenate([table, joints, paddle], axis=1))
    axes = [{"zero": -1.0}] * len(robot.contract.carrying)
    (tmp_path / "robot.yaml").write_text(f"name: lab\naxes: {axes}\n")
    assert cli.main(["calibrate", "robot", "touches.csv", request.param, "--robot", "robot.yaml"]) == 0
    (tmp_path / "robot.yaml").write_text(f"name: lab\naxes: {axes}\ncalibration: calibration.yaml\n")
    return robot, robots.load_robot("robot.yaml", contract=robot.contract).calibration, capsys.readouterr().out


def test_hidden_zeros_are_found_said_and_kept_with_those_of_the_axes(calibrated):
    robot, found, told = calibrated
    assert "touches.csv: line 9: " in told and "39 of 40 points used" in told
    assert all(f"zero of {robot.contract.joints[i]}" in told for i in robot.contract.arm)
    assert len(found.robot.joint_zeros) == len(robot.contract.arm)
    assert found.robot.axes_zero == (-1.0,) * len(robot.contract.carrying) and found.robot.residual < 0.002
    np.testing.assert_allclose(found.robot.joint_zeros, ZEROS[robot.name], atol=0.003)


def test_the_bridge_then_knows_where_the_joints_and_the_blade_are(calibrated):
    robot, found, _ = calibrated
    params = RigParams(pause=0.05, hidden=HiddenErrors(joint_zeros=ZEROS[robot.name]))
    _, world = standing(robot.name)
    missed = {}
    for calibration in (UNCALIBRATED, found):
        config = BridgeConfig(contract=robot.contract, base=calibration.robot.base)
        policy = Hold(robot.contract.n_joints)
        rig = LockStep(robot.scene(), throws(), policy, params, config, world=world, calibration=calibration, first=0)
        rig.run(1.5)
        rig.start()
        rig.run(1.0)
        known, true = rig.bridge.measured, rig.world.qpos
        blade = rig.bridge.gate.geometry.middle(rig.bridge.gate.geometry.tip, known)
        missed[calibration is found] = np.abs(known - true).max(), np.linalg.norm(blade - site(rig.world, true))
    assert missed[False][0] > 0.01 and missed[False][1] > 0.005
    assert missed[True][0] < 0.004 and missed[True][1] < 0.003


def site(world, qpos):
    """The blade's centre (3,) [m] by MuJoCo."""
    data = mujoco.MjData(world.model)
    data.qpos[world._q] = qpos
    mujoco.mj_kinematics(world.model, data)
    return data.site("paddle").xpos
