"""The summary of a session, whatever the policy's artefact says of its evaluation."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from experiments.deploy import session_report
from experiments.deploy.session_report import PlayedSession
from robot_io.control.config import RobotConfig
from robot_io.control.episode import EpisodeSummary
from robot_io.policy import artefact
from tests.support.paths import ROOT

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
