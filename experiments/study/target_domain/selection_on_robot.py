"""The paper's choice among seeds on a robot: so many balls with each policy, scored by the sparse reward."""

from __future__ import annotations

import json

import numpy as np
from rich.console import Console

from experiments import sparse_reward
from experiments.deploy import play
from experiments.errors import RunError
from experiments.finetuning import loop
from experiments.options import LOCK_STEP, RobotOptions
from experiments.runs.load_policy import TrainedPolicy
from experiments.study.target_domain.evaluation_on_robot import export_once
from experiments.study.workflow import Waiting

LOGS = "selection"  # folder of a run


def score(trained: TrainedPolicy, robot: str, balls: int, seed: int, console: Console) -> float:
    """Mean reward of the policy on the robot of a robot.yaml, on RIG or LOCK_STEP.

    seed: of the balls of an emulated one. Raises Waiting where fewer balls were played, RunError where the person
    brought none onto the robot's half.
    """
    if robot == LOCK_STEP:
        emulated = loop.lock_step_robot(loop.experiment_of(trained.source), seed=seed)
        policy = trained.policy.astype(np.float32)
        found = sparse_reward.reward_of(emulated.play(policy, n).summary for n in range(balls))
    else:
        artefact, logs = export_once(trained, console), trained.source / LOGS
        console.print(f"{balls} balls with {trained.source}", highlight=False, soft_wrap=True)
        play.run(artefact, robot, logs, console, RobotOptions(seed=seed), balls)
        newest = max(path for path in logs.glob("*.json") if "." not in path.stem)
        report = json.loads(newest.read_text(encoding="utf-8"))
        if report["episodes"] < balls:
            raise Waiting(f"{report['episodes']} of {balls} balls were played with {trained.source}; once more")
        found = report["selection_reward"]
    if found is None:
        raise RunError(f"{trained.source}: no ball came onto the robot's half")
    return found
