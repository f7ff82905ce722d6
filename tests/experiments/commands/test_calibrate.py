"""``mjx-tt calibrate``: from measured points to a robot.yaml that the bridge applies, on rigs with hidden errors."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest

from experiments import cli
from experiments.config import robot as robots
from experiments.errors import ConfigError
from mjx_tt.robot import robots as simulated
from robot_io import log
from robot_io.calibrated import UNCALIBRATED, Calibration, RobotCalibration
from robot_io.contract import JOINT_NAMES
from robot_io.control.interfaces import BridgeConfig
from robot_io.devices.tracker import TrackerConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.hidden import HiddenErrors
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.tracker import TrackerParams
from robot_io.emulator.world import World
from tests.support.contact_log import made_up
from tests.support.hidden_rig import HIDDEN, grid, touches
from tests.support.lockstep_play import lockstep, throws

FR3, UR10E = "fr3_pedestal", "ur10e_rail"
ZEROS = {
    FR3: (0.012, -0.012, 0.012, -0.012, 0.012, -0.012, 0.012),
    UR10E: (0.012, -0.012, 0.012, -0.012, 0.012, -0.012),
}
BLADE = 0.076  # [m]
SPREAD = {FR3: [0.6, 0.5, 0.5, 0.5, 1.0, 0.7, 1.2], UR10E: [0.5, 0.6, 0.4, 0.5, 1.0, 0.7, 1.2]}
TABLE, BALL, PADDLE = ([f"{what}_{axis}" for axis in "xyz"] for what in ("table", "ball", "paddle"))


def write(path, names, *columns):
    with open(path, "w", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerows([names, *np.concatenate(columns, axis=1)])


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Two CSVs, each with a wrong point."""
    monkeypatch.chdir(tmp_path)
    table, seen = grid()
    seen[3] += [0.05, 0.0, 0.0]
    write("ball.csv", TABLE + BALL, table, seen)
    table, joints, paddle = touches()
    table[7] += [0.0, 0.04, 0.0]
    write("touches.csv", [*TABLE, *JOINT_NAMES, *PADDLE], table, joints, paddle)
    return tmp_path


def test_what_was_hidden_is_found_written_and_applied(measured, capsys):
    (measured / "robot.yaml").write_text("name: lab\ncalibration: calibration.yaml\n")
    assert cli.main(["calibrate", "tracker", "ball.csv"]) == 0
    assert cli.main(["calibrate", "robot", "touches.csv", "--robot", "robot.yaml"]) == 0
    told = capsys.readouterr().out
    assert "ball.csv: line 5: 49." in told and "14 of 15 points used" in told
    assert "touches.csv: line 9: " in told and "39 of 40 points used" in told and "zero of joint_6" in told
    found = robots.load_robot("robot.yaml").calibration
    assert found.tracker.date == found.robot.date and found.tracker.points == 14
    np.testing.assert_allclose(found.robot.joint_zeros, HIDDEN.joint_zeros, atol=0.002)

    hidden = replace(HIDDEN, clock_offset=-321.0)
    params = RigParams(pause=0.05, tracker=TrackerParams(noise=0.0, latency=0.016), hidden=hidden)
    told_clock = TrackerConfig(clock_offset=None, latency=0.016)
    rig = lockstep(params=params, tracker=told_clock, calibration=found)
    rig.run(1.5)
    rig.start()
    rig.throwing, track, compared = True, {}, set()
    while rig.now < 6.0:
        rig.step()
        track[round(rig.now / 0.001)] = rig.world.ball
        seen = rig.bridge.tracker.newest
        if seen.position is not None and (true := track.get(8 * (number := round(seen.captured / 0.008)))) is not None:
            assert abs(seen.captured - 0.008 * number) < 0.001  # frames are taken every 8 ms
            assert np.linalg.norm(seen.position - true) < 0.002
            compared.add(number)
    assert rig.thrower.thrown >= 1 and len(compared) > 300
    np.testing.assert_allclose(rig.bridge.measured, rig.world.qpos, atol=0.005)  # 2 mrad, and 29 ms of motion


def test_a_calibration_that_run_would_refuse_is_named_and_not_written(measured, capsys):
    table, joints, paddle = touches(replace(HIDDEN, joint_zeros=(0.055, *HIDDEN.joint_zeros[1:])))
    write("far.csv", [*TABLE, *JOINT_NAMES, *PADDLE], table, joints, paddle)
    before = "tracker: {points: 7, date: '2026-11-22'}"
    (measured / "calibration.yaml").write_text(before)
    assert cli.main(["calibrate", "robot", "far.csv"]) == 1
    told = capsys.readouterr().err
    assert "calibration.yaml: robot.joint_zeros" in told and "from -0.05 to 0.05 rad" in told
    assert (measured / "calibration.yaml").read_text() == before


def test_the_clock_is_found_with_the_base_that_a_session_was_logged_with(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made, then = made_up(0.031, gap=0.012), Calibration(robot=RobotCalibration((0.0, 0.012, 0.0), date="2026-11-22"))
    with log.FileRecorder(tmp_path, "1", {}, {"calibration.yaml": robots.to_yaml(then)}) as recorder:
        records = [log.Joints(t, q, np.zeros(8)) for t, q in zip(made.joints.time, made.joints.position.T, strict=True)]
        ball = made.ball
        for captured, place, number in zip(ball.capture_time, ball.position.T, ball.id, strict=True):
            records.append(log.Ball(captured, captured, place, int(number)))
        for seconds, drift in ((60, -4e-5), (0, 0.0)):  # at the end the tracker fell silent
            report = {"offset": -3.2, "at": 100.0, "drift": drift, "residual": 1e-5, "seconds": seconds}
            records.append(log.Event(99.0 - seconds, log.Level.INFO, "clock", json.dumps(report)))
        recorder.put(*sorted(records, key=lambda record: record.log_time))
    assert cli.main(["calibrate", "clock", "1.mcap"]) == 0
    assert "drift -40.00 ppm" in capsys.readouterr().out
    found = robots.load_calibration("calibration.yaml").clock
    assert found.drift == -4e-5 and found.lag == pytest.approx(0.031, abs=0.003)


def test_calibrations_that_contradict_are_refused_by_file_and_key(tmp_path):
    path, calibration = tmp_path / "robot.yaml", tmp_path / "found.yaml"
    path.write_text("calibration: found.yaml\naxes: [{zero: -1.0}, {zero: -0.5}]")
    calibration.write_text("robot: {axes_zero: [-1.0, -0.4], joint_zeros: [0.01, 0, 0, 0, 0, 0], date: '2026-11-22'}")
    with pytest.raises(ConfigError, match=r"calibration.robot.axes_zero: expected .*calibrate the robot again"):
        robots.load_robot(path)
    assert robots.load_robot(path, calibrated=False).axes[1].zero == -0.5  # for another calibration
    calibration.write_text("tracker: {residual: 0.012, date: '2026-11-22'}")
    with pytest.raises(ConfigError, match=r"found.yaml: tracker.residual: expected .* from 0 to 0.005 m, got 0.012"):
        robots.load_robot(path)
    calibration.write_text("clock: {drift: 4.0e-5}")
    with pytest.raises(ConfigError, match=r"found.yaml: clock.date: expected .*; clock was changed"):
        robots.load_robot(path)


# -- robots with other joints than the paper's ------------------------------------------------------------------------


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
    write("touches.csv", [*TABLE, *robot.contract.joints, *PADDLE], table, joints, paddle)
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
