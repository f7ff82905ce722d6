"""The files for the arm's controller agree with what the bridge and the emulated arm expect."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from experiments.config.robot import COMMISSIONING
from robot_io.contract import ABB_JOINTS
from robot_io.devices.egm.session import DEFAULT_PORT, EgmConfig
from robot_io.emulator.arm import ArmParams
from robot_io.limits import LIMITS
from tests.support.lockstep_play import world

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "abb"
MODULE, MOTION, PROTOCOL = (
    (FOLDER / name).read_text("ascii") for name in ("TableTennis.mod", "MOC.cfg", "transmission_protocol.txt")
)


def number(text: str, key: str) -> float:
    (value,) = set(re.findall(rf"{re.escape(key)} *:?=? *(-?[\d.]+)", text))
    return float(value)


def test_the_module_agrees_with_the_bridge_and_the_emulated_arm():
    assert number(MODULE, r"\SampleRate") / 1000 == EgmConfig().period == ArmParams().cycle
    assert number(MODULE, r"\LpFilter") == number(MOTION, "-ext_motion_filter_bandwidth") == ArmParams().low_pass
    gain = number(MODULE, r"\PosCorrGain") * number(MOTION, "-ext_motion_Kp")
    assert gain == pytest.approx(ArmParams().pos_corr_gain)
    assert int(number(PROTOCOL, "Remote Port")) == DEFAULT_PORT
    assert EgmConfig().timeout < number(MODULE, "communication_timeout") <= 0.1


def test_as_delivered_it_is_slow_and_never_moves_by_itself():
    fastest = COMMISSIONING * np.degrees(max(LIMITS.velocity[i] for i in ABB_JOINTS))  # of a robot.yaml without a scale
    assert fastest < number(MODULE, "max_speed_deviation") < 1.2 * fastest
    code = re.sub(r"!.*", "", MODULE)
    assert "RAMP_DOWN" not in code and "NoWaitCond" not in code
    assert re.findall(r"Move\w+ \w+", code) == ["MoveAbsJ here"] and "here := CJointT()" in code
    assert "-do_not_restart_after_motors_off" in MOTION


def test_the_robot_is_armed_after_the_ramp():
    ramp = number(MODULE, r"\RampInTime")
    assert ramp == ArmParams().ramp_in and ramp + 0.4 < EgmConfig().ramp_in


def test_the_tools_tcp_is_the_farthest_point_of_the_blade():
    model = world().model
    far = model.site("paddle").pos[0] + model.geom("rig_paddle").size[0]
    found = re.search(r"tooldata paddle := \[TRUE, \[\[([^\]]+)\]", MODULE)
    assert found and list(map(float, found[1].split(","))) == pytest.approx([0.0, 0.0, 1e3 * far], abs=0.5)
