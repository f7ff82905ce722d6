"""The operator's view of a control process, and the summary of a session."""

from __future__ import annotations

import os
import pty
import sys
from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from experiments.deploy import session_report
from experiments.deploy.operator_console import KEYS, EscapeFilter, Keyboard, View
from experiments.deploy.session_report import PlayedSession
from robot_io.control import messages
from robot_io.control.config import RobotConfig
from robot_io.control.episode import EpisodeSummary
from robot_io.errors import RefusedError
from robot_io.policy import artefact
from tests.support.paths import ROOT


def test_the_view_shows_state_faults_joints_and_counts():
    view = View(Console(file=StringIO(), force_terminal=True), "policy on robot")
    console = Console(record=True, width=300, file=StringIO())
    fault, joints = messages.FaultReport("estop", "the button is pressed"), [("rail", "m", 0.1, 0.0)]
    status = messages.Status(1.0, "fault", True, False, (fault,), {}, None, None, None, joints)
    status = replace(status, balls=3, outcomes={"returned": 2, "missed": 1}, axes_cycles=17, axes_late=4)
    status = replace(
        status, egm={"accepted": 1000, "rejected": {"stranger": 2}, "lost": 3}, tracker_counts={"accepted": 40}
    )
    status = replace(status, ball=(0.1, -0.2, 0.02), dry=True, stopped="not heard for 2 s")
    with view:
        view.take(messages.Refused(messages.Arm(), RefusedError("not now")))
        view.take(status)
        console.print(view._draw(status))
    text = console.export_text()
    for shown in (
        "ball +0.100 -0.200 +0.020 m in the table frame",
        "dry run",
        "FAULT estop: the button is pressed",
        "STOPPED: not heard for 2 s",
        "balls 3: 2 returned, 1 missed",
        "+0.100 m ",
        "EGM 1,000 taken, 2 refused, 3 lost; tracker 40 taken",
        "17 cycles, 4 late",
        "not now",
        *(key.text for key in KEYS.values()),
    ):
        assert shown in text, shown


@pytest.fixture
def terminal(monkeypatch):
    """A keyboard on a terminal of its own, and the end that types."""
    hand, end = pty.openpty()
    with os.fdopen(end) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with Keyboard() as keyboard:
            yield keyboard, lambda typed: os.write(hand, typed)
    os.close(hand)


@pytest.mark.parametrize(
    ("typed", "key"),
    [
        (b"+" * 90 + b" ", " "),  # held for three seconds while the program was busy
        (b"++q+++", "q"),
        (b"1+", "1"),  # of a joint that was chosen at that moment no step is taken
        (b"13", "3"),
        (b"a pasted line", " "),
        (b"a-pasted-line", "e"),
        (b"\x1b[A\x1b[1;5C\x1bOa\x1b[[a\x1b[3~", None),
        (b"\x1ba", None),  # Alt
        (b"\x1b[ap", "p"),
        (b"\x1b ", " "),  # nothing hides the stop
    ],
)
def test_one_key_counts_of_all_that_wait_and_a_stop_before_all(terminal, typed, key):
    keyboard, press = terminal
    press(typed)
    assert keyboard.pressed() == key
    assert keyboard.pressed() is None  # nothing is left over


def test_a_sequence_that_a_read_ends_in_is_dropped_wholly(terminal):
    keyboard, press = terminal
    for typed in (b"\x1b", b"[", b"1;", b"5", b"a"):
        press(typed)
        assert keyboard.pressed() is None
    press(b"a")
    assert keyboard.pressed() == "a"


def test_the_escape_key_itself_swallows_nothing_that_follows():
    keys = EscapeFilter()
    assert keys.keys("\x1b", 10.0) == ""
    assert keys.keys("q", 11.0) == "q"


IN_SIMULATION = {"return_rate": 0.9, "low": 0.8, "high": 0.95, "episodes": 100, "balls": {"name": "player3/M0"}}
ON_A_ROBOT = {"before": {"balls": 10, "return_rate": 0.4}, "after": {"balls": 10, "return_rate": 0.6}}


@pytest.mark.parametrize("evaluation", [IN_SIMULATION, ON_A_ROBOT, None], ids=["trained", "fine-tuned", "never"])
def test_a_session_of_every_policy_has_a_summary(evaluation, tmp_path):
    loaded = artefact.load(ROOT / "experiments/shipped/policies/quickstart")
    loaded = replace(loaded, manifest=loaded.manifest | {"provenance": {"evaluation": evaluation}})
    report = session_report.summary(loaded, RobotConfig(), PlayedSession(), None, {}, None) | {"faults": []}
    assert ("simulation" in report) == (evaluation is IN_SIMULATION) and report["episodes"] == 0
    faulted = PlayedSession([EpisodeSummary(1, 1, 0.0, 1.0, 9, "hit", 0.1, False, 0.0, (0.0, 0.0), "limit")])
    report = session_report.summary(loaded, RobotConfig(), faulted, None, {}, None) | {"faults": []}
    assert report["selection_reward"] == -2.0
    screen = Console(file=StringIO(), width=120)
    session_report.show(screen, report, tmp_path / "summary.json")
    assert ("in simulation" in screen.file.getvalue()) == (evaluation is IN_SIMULATION)
