"""A run refuses calibrations that the contacts of an earlier session contradict."""

from __future__ import annotations

import json
import math

import pytest

from experiments.config import robot as robots
from experiments.deploy import contradictions
from experiments.errors import ConfigError
from robot_io.control.config import RobotConfig


def config(lag=0.034):
    content = {"name": "lab", "calibration": {"clock": {"drift": 4e-5, "lag": lag, "date": "2026-11-22"}}}
    return robots.fill(RobotConfig, content, "robot.yaml")


def session(folder, name, found, **contacts):
    summary = {"robot": found.name, "calibration": robots.plain(found.calibration), "contacts": contacts}
    (folder / name).write_text(json.dumps(summary))


def test_only_the_newest_session_with_the_same_calibration_counts(tmp_path):
    found, good = config(), {"count": 20, "lag": 0.035, "lag_deviation": 0.001, "spread": 0.006}
    contradictions.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "1.json", found, **good | {"lag": 0.045})
    with pytest.raises(
        ConfigError, match=r"robot.yaml: calibration.clock.lag is 0.034 s, in .*1.json 20 contacts .*0.045"
    ):
        contradictions.check(found, "robot.yaml", tmp_path)
    contradictions.check(config(0.044), "robot.yaml", tmp_path)  # calibrated again
    session(tmp_path, "2.json", found, **good)
    (tmp_path / "3.json").write_text("[")
    contradictions.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "4.json", found, **good | {"spread": 0.023})
    with pytest.raises(ConfigError, match=r"calibration.tracker.position .*spread by 23.0 mm"):
        contradictions.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "5.json", found, count=3, lag=math.nan, lag_deviation=math.nan, spread=math.nan)
    contradictions.check(found, "robot.yaml", tmp_path)
