"""The first day of a robot: a right one is proven whole, and each of twenty hidden mistakes is found at its step."""

from __future__ import annotations

import math
import os
import re
from dataclasses import replace

import pytest
import yaml
from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import first_day
from experiments.deploy.commission import STEPS, Commissioning, NotProven, Record
from mjx_tt.robot import robots as simulated
from robot_io.contract import PAPER
from robot_io.control.config import RobotConfig
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.config import RigParams
from robot_io.emulator.hidden import HiddenErrors
from robot_io.emulator.network import NetworkFaults
from robot_io.emulator.processes import Rig
from tests.support.commissioning_rig import LockStepHands, LockStepSession, Person
from tests.support.lockstep_play import throws
from tests.support.paths import ROOT

RIG = RigParams(pause=0.05)
POLICY = ROOT / "experiments" / "shipped" / "policies" / "quickstart"


def hidden(**errors):
    return replace(RIG, hidden=HiddenErrors(**errors))


def arm(**params):
    return replace(RIG, arm=ArmParams(**{"comm_timeout": 0.06} | params))


def swap_axes(session):
    session.rig.emulators.reverse()


# By name: the rig, what is done to it, the person's other answers, the step that finds it, and words that name it.
MISTAKES = {
    "packets lost": (replace(RIG, arm_network=NetworkFaults(loss=0.05)), None, {}, "network", "of the arm are lost"),
    "firmware": (RIG, None, {"robotware": "5.61"}, "versions", "RobotWare 5.61"),
    "tool TCP zero": (RIG, None, {"tool": "0 0 0"}, "tool", "250 mm/s are kept at the TCP only"),
    "limits not set": (RIG, None, {"limits_gantry_y": "0 0"}, "limits", "gantry_y stops at"),
    "clock offset": (hidden(clock_offset=-0.03), None, {}, "clock", "off by"),
    "clock rate": (hidden(clock_drift=8e-4), None, {}, "clock", "ppm"),
    "tracker x mirrored": (hidden(camera_scale=(-1.0, 1.0, 1.0)), None, {}, "tracker", "x mirrored"),
    "tracker on the floor": (hidden(camera_position=(0.0, 0.0, -0.76)), None, {}, "tracker", "from the floor"),
    "tracker in mm": (hidden(camera_scale=(1000.0,) * 3), None, {}, "tracker", "millimetres"),
    "tracker turned": (hidden(camera_angles=(0.0, 0.0, math.pi / 2)), None, {}, "tracker", "turned by -90 degrees"),
    "tracker 0.1 m off": (hidden(camera_position=(0.1, 0.0, 0.0)), None, {}, "tracker", "-0.100 "),
    "base value halved": (hidden(base_velocity=1.0), None, {}, "base_values", "robot.yaml has 2"),
    "CommTimeout": (arm(comm_timeout=1.0), None, {}, "comm_timeout", "1.0"),
    "emergency stop": (hidden(stop_wired=False), None, {}, "emergency_stop", "leaves the power to arm and axes"),
    "homing offset": (hidden(axis_zero=(0.05, 0.0)), None, {}, "pose", "homing offset"),
    "axis sign": (hidden(axis_factor=(-1.0, 1.0), axis_zero=(-0.44, 0.0)), None, {}, "signs", "gantry_x.*other way"),
    "axis unit": (
        hidden(axis_factor=(1.0, 2.0), axis_zero=(0.0, -0.2)),
        None,
        {},
        "signs",
        r"gantry_y.*0\.[45]\d times",
    ),
    "joints swapped": (hidden(joint_order=(0, 1, 2, 5, 4, 3)), None, {}, "pose|signs", "joint"),
    "axes swapped": (hidden(), swap_axes, {}, "pose|signs", "axes' zero|swapped"),
    "latency": (replace(RIG, action_delay=0.1), None, {}, "latency", "allowed are 0.15 s"),
    "MaxSpeedDeviation": (arm(max_speed_deviation=math.radians(30)), None, {}, "speed", "MaxSpeedDeviation"),
    "PosCorrGain": (arm(pos_corr_gain=0.2), None, {}, "position_gain", "corrected at 0.2"),
    "stop distance": (replace(RIG, drive=replace(RIG.drive, acceleration=0.4)), None, {}, "stop", "gantry_x stops"),
}


CALLS = 4  # in real time
STALLED = r"stopped by (timing|stale_\w+)"  # by this machine, not by the robot


def commissioning(tmp_path, params=RIG, done=(), **answers):
    path = tmp_path / "robot.yaml"
    path.write_text("name: lab\n")
    record = Record.of(path)
    for step in done:
        record.add(step, "as before")
    session = LockStepSession(params)
    person = Person(LockStepHands(session.rig), **answers)
    made = Commissioning(session, person, RobotConfig(), record, PAPER, lambda: "the first ball was played")
    return made, session, person


@pytest.mark.parametrize("name", MISTAKES)
def test_a_hidden_mistake_is_found_at_its_step(tmp_path, name):
    """Steps before it are taken as proven, but for those that it goes through without being found there."""
    params, change, answers, step, named = MISTAKES[name]
    first = min(STEPS.index(each) for each in step.split("|"))
    done = STEPS[:first] if first > STEPS.index("bounces") else ()
    made, session, person = commissioning(tmp_path, params, done, **answers)
    if change is not None:
        change(session)
    with pytest.raises(NotProven, match=f"^({step}): .*{named}"):
        made.run()
    assert not {*Record.of(tmp_path / "robot.yaml").proven} & {*STEPS[first:], *step.split("|")} or "|" in step
    session.rig.run(1.0)
    assert session.rig.world.collisions == 0


@pytest.mark.slow
def test_a_right_robot_is_proven_whole_and_resumed(tmp_path):
    made, session, person = commissioning(tmp_path)
    made.run()
    record = yaml.safe_load((tmp_path / "robot.commissioning.yaml").read_text())
    assert list(record["proven"]) == STEPS and len(person.said) == len(STEPS)
    assert not session.rig.bridge.gate.faults and session.rig.world.collisions == 0
    again, _, person = commissioning(tmp_path)
    again.run()
    assert not person.done and all("proven 20" in line for line in person.said)
    (tmp_path / "robot.yaml").write_text("name: other\n")
    assert not Record.of(tmp_path / "robot.yaml").proven


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.skipif("COMMISSION_RIG" not in os.environ, reason="minutes on two quiet cores: COMMISSION_RIG=1 runs it")
@pytest.mark.parametrize("name", [None, "tracker x mirrored", "CommTimeout", "axis unit"])
def test_over_real_sockets_in_real_time(tmp_path, name):
    params, _, answers, step, named = MISTAKES[name] if name else (RIG, None, {}, "", "")
    path, console = tmp_path / "robot.yaml", Console(record=True, width=300)
    with Rig(str(simulated.paper().scene()), throws(), params) as rig:
        path.write_text(robots.to_yaml(rig.robot))
        for _ in range(CALLS):  # it goes on after the last proven step
            person = Person(rig, **answers)
            status = first_day.run(rig.robot, Record.of(path), person, tmp_path, console, POLICY, PAPER)
            if not re.search(STALLED, console.export_text(clear=False).splitlines()[-1]):
                break
    if name is None:
        assert status == 0 and list(Record.of(path).proven) == STEPS
    else:
        assert status == 1 and re.search(f"not proven: ({step}): .*{named}", console.export_text())
