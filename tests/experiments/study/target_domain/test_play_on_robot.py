"""A study's play on the emulated robot: rallies over several sessions, and the choice among seeds."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from experiments.deploy import play
from experiments.errors import RunError
from experiments.finetuning import loop
from experiments.runs import load_policy
from experiments.runs.run_dir import Run
from experiments.study.analysis import scoring
from experiments.study.target_domain import play_on_robot
from experiments.study.target_domain.play_on_robot import derive_seed, make_rally_step
from experiments.training import sweep
from experiments.training.sweep import Job
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts
from tests.support.paths import ROOT

POLICY = ROOT / "experiments/shipped/policies/quickstart"


class Sessions:
    """Stands in for the rig: plays rallies of growing length in sessions that end as they are told.

    plan: of each session (rallies that count, its end): an exit status, an exception, or None, killed without a report
    """

    def __init__(self, plan) -> None:
        self.plan, self.chances, self.asked, self.length = list(plan), [], [], 0

    def run(self, artefact, robot, folder, console, setup, rallies):
        assert setup.backend == "auto"  # the jitted policy, as mjx-tt run
        self.chances.append(setup.seed)
        self.asked.append(rallies)
        count, end = self.plan.pop(0)
        told = [self._rally("FIRST_NET", True)]  # each session has one that is filtered
        told += [self._rally("ROBOT_MISSED", False) for _ in range(min(count, rallies))]
        if end is not None:
            report = {"artefact_sha256": artefacts.load(artefact).digest, "rallies": {"list": told}}
            name = f"20260101-00000{len(self.chances)}"
            (folder / f"{name}.json").write_text(json.dumps(report))
            (folder / f"{name}.layout.json").write_text("{}")
        if not isinstance(end, int):
            raise end or RefusedError("killed")
        return end

    def _rally(self, end: str, filtered: bool) -> dict:
        self.length += 1
        return {"length": self.length, "end": end, "filtered": filtered}


@pytest.fixture
def run(tmp_path):
    """A policy that is exported already, and the folder of its evaluation."""
    (tmp_path / "rallies").mkdir()
    return Path(shutil.copytree(POLICY, tmp_path / "run"))


def step_of(run, monkeypatch, plan, rallies=10):
    """The step of a zero-shot policy, and the sessions that it will have."""
    rig, folder = Sessions(plan), run.parent / "rallies"
    monkeypatch.setattr(play, "run", rig.run)
    monkeypatch.setattr(play_on_robot, "export_once", lambda trained, console: run)
    who = (0, "player3", "player3", "zero_shot")
    return make_rally_step(folder, who, lambda: run, (), rallies, Console(file=io.StringIO())), rig


def test_a_failed_evaluation_goes_on_with_what_it_played(run, monkeypatch):
    step, rig = step_of(run, monkeypatch, [(3, 1), (2, 1), (2, 1), (5, 0)])
    with pytest.raises(RunError, match="3 are missing.*goes on with those that were played"):
        step.run()
    assert rig.asked == [10, 7, 5]
    step.run()
    assert rig.asked[3:] == [3] and not rig.plan
    assert rig.chances == [derive_seed(step.name) + k for k in range(4)]
    counted = scoring.read(step.outputs[0])
    np.testing.assert_array_equal(counted.length, np.arange(1, 15))  # every rally once, in the order of play
    assert (~counted.filtered).sum() == 10


@pytest.mark.parametrize("end", [play.INTERRUPTED, OSError("the pipe broke"), None])
def test_a_session_that_is_stopped_or_raises_counts_if_it_has_a_report(run, monkeypatch, end):
    step, rig = step_of(run, monkeypatch, [(4, end), (9, 0), (1, 0)])
    with pytest.raises((KeyboardInterrupt, OSError, RefusedError)):
        step.run()
    if end is None:
        rig.plan = [(10, 0)]
    step.run()
    assert rig.asked == [10, 10 if end is None else 6]
    assert rig.chances == [derive_seed(step.name), derive_seed(step.name) + (end is not None)]
    assert (~scoring.read(step.outputs[0]).filtered).sum() == 10


def test_a_policy_that_was_trained_anew_is_evaluated_anew(run, monkeypatch):
    step, rig = step_of(run, monkeypatch, [(4, 1), (0, 0), (10, 0)])
    with pytest.raises(RunError):
        step.run()
    folder = run.parent / "rallies"
    for path in folder.glob("2*[0-9].json"):
        path.write_text(path.read_text().replace(artefacts.load(run).digest, "another"))
    step.run()
    assert rig.asked == [10, 6, 10]


BALLS = 3  # by which a test chooses


def score(trained, robot, balls, seed, console) -> float:
    assert robot == "lockstep" and balls == 50  # the paper's number, of which a test plays fewer
    return play_on_robot.score(trained, robot, BALLS, seed, console)


@pytest.mark.slow
def test_the_seed_that_plays_best_on_the_emulated_robot_is_chosen(tmp_path, monkeypatch):
    """The shipped policy against the same with its commands turned round; by hand from the robot's own words."""
    monkeypatch.setattr(loop, "LOCK_STEP_BALLS", 64)
    good = load_policy.load(POLICY)
    bad = replace(good, policy=replace(good.policy, theta=-good.policy.theta))
    robot = loop.lock_step_robot(loop.experiment_of(POLICY), seed=good.config.evaluation.seed + 1)
    worth = []
    for trained in (good, bad):
        played = [robot.play(trained.policy.astype(np.float32), n).summary for n in range(BALLS)]
        points = {"missed": 0, "hit": 1, "returned": 2}
        worth.append(sum(-2 if one.fault else points[one.outcome] for one in played) / BALLS)
    assert worth[0] > worth[1]
    assert play_on_robot.score(bad, "lockstep", BALLS, good.config.evaluation.seed + 1, Console()) == worth[1]
    jobs = [Job(good.config, Run(tmp_path / "seed0"), "test")]
    shutil.copytree(POLICY, jobs[0].run.folder)
    sweep.select(tmp_path, jobs, Console(file=io.StringIO()), "lockstep", score)
    selection = json.loads((tmp_path / "selection.json").read_text())
    assert selection["robot"] == "lockstep" and selection["scores"] == {"seed0": worth[0]}
