"""The choice among seeds on a robot: what a policy is worth there, and that the robot's word decides."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from experiments.finetuning import loop
from experiments.runs import load_policy
from experiments.runs.run_dir import Run
from experiments.study.target_domain import selection_on_robot
from experiments.training import sweep
from experiments.training.sweep import Job
from tests.support.paths import ROOT

POLICY = ROOT / "experiments/shipped/policies/quickstart"
BALLS = 3


def score(trained, robot, balls, seed, console) -> float:
    assert robot == "lockstep" and balls == 50  # the paper's number, of which a test plays fewer
    return selection_on_robot.score(trained, robot, BALLS, seed, console)


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
    assert selection_on_robot.score(bad, "lockstep", BALLS, good.config.evaluation.seed + 1, Console()) == worth[1]
    jobs = [Job(good.config, Run(tmp_path / "seed0"), "test")]
    shutil.copytree(POLICY, jobs[0].run.folder)
    sweep.select(tmp_path, jobs, Console(file=io.StringIO()), "lockstep", score)
    selection = json.loads((tmp_path / "selection.json").read_text())
    assert selection["robot"] == "lockstep" and selection["scores"] == {"seed0": worth[0]}
