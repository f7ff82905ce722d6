"""A run refuses calibrations that the contacts of an earlier session contradict."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

from experiments.config import robot as robots
from experiments.config.finetuning import FineTuning
from experiments.deploy import calibration_check, play
from experiments.deploy.control_session import load_installed
from experiments.errors import ConfigError
from experiments.finetuning import on_robot as tuning
from experiments.options import ROBOT
from experiments.runs import run_dir
from mjx_tt.robot.robots import paper
from robot_io.calibration import contacts
from robot_io.contract import PAPER
from robot_io.control.config import RobotConfig
from robot_io.log.messages import LogError


def config(lag=0.034):
    content = {"name": "lab", "calibration": {"clock": {"drift": 4e-5, "lag": lag, "date": "2026-11-22"}}}
    return robots.fill(RobotConfig, content, "robot.yaml")


def session(folder, name, found, **contacts):
    summary = {"robot": found.name, "calibration": robots.plain(found.calibration), "contacts": contacts}
    run_dir.write_json(folder / name, summary)


def test_only_the_newest_session_with_the_same_calibration_counts(tmp_path):
    found, good = config(), {"count": 20, "lag": 0.035, "lag_deviation": 0.001, "spread": 0.006}
    calibration_check.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "1.json", found, **good | {"lag": 0.045})
    with pytest.raises(
        ConfigError, match=r"robot.yaml: calibration.clock.lag is 0.034 s, in .*1.json 20 contacts .*0.045"
    ):
        calibration_check.check(found, "robot.yaml", tmp_path)
    calibration_check.check(config(0.044), "robot.yaml", tmp_path)  # calibrated again
    session(tmp_path, "2.json", found, **good)
    (tmp_path / "3.json").write_text("[")
    calibration_check.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "4.json", found, **good | {"spread": 0.023})
    with pytest.raises(ConfigError, match=r"calibration.tracker.position .*spread by 23.0 mm"):
        calibration_check.check(found, "robot.yaml", tmp_path)
    session(tmp_path, "5.json", found, count=3, lag=None, lag_deviation=None, spread=None)
    calibration_check.check(found, "robot.yaml", tmp_path)


def summary():
    keys = ("artefact", "egm", "axes_cycles", "log")
    return dict.fromkeys(keys) | {"robot": "lab", "episodes": 0, "timings": {}, "faults": []}


@pytest.mark.parametrize(
    "seen", [contacts.Contacts(3, math.nan, math.nan, math.nan), KeyboardInterrupt(), LogError("x")]
)
def test_a_session_keeps_its_summary_whatever_its_contacts_tell(tmp_path, monkeypatch, seen):
    def measure(*_):
        if isinstance(seen, BaseException):
            raise seen
        return seen

    log_file, path, console = tmp_path / "1.mcap", tmp_path / "1.json", Console(record=True)
    log_file.touch()
    monkeypatch.setattr(calibration_check.log, "read", lambda _: None)
    monkeypatch.setattr(calibration_check.contacts, "measure", measure)
    play._finish(summary(), config(), log_file, path, console)
    written = json.loads(path.read_text())
    assert written["calibration"]["clock"]["lag"] == 0.034
    if isinstance(seen, BaseException):
        assert "contacts" not in written and "not measured: " + type(seen).__name__ in console.export_text()
    else:
        assert written["contacts"] == {"count": 3, "lag": None, "lag_deviation": None, "spread": None}
    calibration_check.check(config(), "robot.yaml", tmp_path)


def test_fine_tuning_refuses_what_a_session_contradicts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, folder = config(), tmp_path / "runs" / "robot"
    (tmp_path / "robot.yaml").write_text(robots.to_yaml(found))
    folder.mkdir(parents=True)
    session(folder, "1.json", found, count=20, lag=0.045, lag_deviation=0.001, spread=0.006)
    run = run_dir.Run(tmp_path / "run")
    with pytest.raises(ConfigError, match=r"robot.yaml: calibration.clock.lag .*1.json"):
        monkeypatch.setattr(
            tuning.loop, "experiment_of", lambda *_: SimpleNamespace(task=SimpleNamespace(robot=paper()))
        )
        tuning.finetune("nowhere", FineTuning(), run, "robot.yaml", Console(), ROBOT)


@pytest.mark.parametrize(
    ("controller", "scale", "date", "refused"),
    [
        ("192.168.125.1", 0.25, "", True),
        ("192.168.125.1", 0.1, "", False),
        ("192.168.125.1", 0.25, "2026-11-28", False),
        ("127.0.0.1", 1.0, "", False),  # the rig: nothing real moves
    ],
)
def test_a_robot_whose_trackers_frame_no_known_point_has_shown_stays_slow(tmp_path, controller, scale, date, refused):
    """Balls cannot show that x is mirrored."""
    path = tmp_path / "robot.yaml"
    content = {"arm": {"controller": controller}, "safety": {"speed_scale": scale}}
    path.write_text(yaml.safe_dump(content | ({"calibration": {"tracker": {"date": date}}} if date else {})))
    if refused:
        with pytest.raises(ConfigError, match=r"calibration.tracker: expected one at safety.speed_scale 0.25"):
            load_installed(str(path), tmp_path, PAPER, tmp_path)
    else:
        assert load_installed(str(path), tmp_path, PAPER, tmp_path)[0].safety.speed_scale == scale
