"""``mjx-tt finetune``: fine-tuning on a robot, on the rig in real time or in lock-step."""

from __future__ import annotations

import json
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.config import robot as robots
from experiments.config.build import Experiment
from experiments.config.finetuning import FineTuning
from experiments.deploy import contradictions, robot_attachment
from experiments.deploy.operator_console import Keyboard, View
from experiments.deploy.rig import RIG, box_of, rig_for
from experiments.deploy.session import Session
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.finetuning import loop
from experiments.finetuning.bridge_robot import COMPUTING, BridgeRobot
from experiments.finetuning.robot import LockStepRallies, Robot
from experiments.runs import load_policy, run_dir
from experiments.training import finalize
from robot_io.control import process
from robot_io.policy import artefact as artefacts

LOCK_STEP = "lockstep"


def finetune(
    source: str,
    settings: FineTuning,
    run: run_dir.Run,
    robot: str,
    distribution: str | None,
    rig_params: str | None,
    backend: str,
    seed: int,
    console: Console,
    player: str | None = None,
) -> dict[str, Any] | None:
    """Fine-tune on the robot of a robot.yaml, on RIG or LOCK_STEP; the report, or None when the operator stopped it.

    player: virtual player who rallies with the robot on RIG or LOCK_STEP, in place of thrown balls
    """
    experiment = loop.experiment_of(source, distribution)
    moved = experiment.task.robot
    installed = None if robot in (LOCK_STEP, RIG) else robots.load_robot(robot)
    if installed is not None:
        artefacts.check_robot(source, moved.contract, robots.standing(robot))
        contradictions.check(installed, robot)
    if robot == LOCK_STEP:
        params = robots.load_rig(rig_params, moved)
        lock_step: Robot = (
            loop.lock_step_robot(experiment, params, seed)
            if player is None
            else LockStepRallies(VirtualPlayer(player, seed), params, moved.scene(), contract=moved.contract)
        )
        return loop.finetune(source, settings, run, lock_step, console, None, experiment)
    run.folder.mkdir(parents=True, exist_ok=True)
    artefact = _artefact_of(source, experiment, run.folder, console)
    with ExitStack() as stack:
        rig = None
        if robot == RIG:
            rig = stack.enter_context(rig_for(artefacts.load(artefact), distribution, rig_params, seed, player))
        config = rig.robot if rig else installed or robots.load_robot(robot)
        options = process.ControlOptions(
            str(artefact),
            backend,
            str(run.folder),
            time.strftime("%Y%m%d-%H%M%S"),
            box_of(artefacts.load(artefact)),
            (("git", json.dumps(run_dir.git_state())),),
            (
                ("robot.yaml", robots.to_yaml(config)),
                ("calibration.yaml", robots.to_yaml(config.calibration)),
                *robot_attachment.of_policy(artefacts.load(artefact), console),
            ),
            contract=moved.contract,
        )
        session = stack.enter_context(Session(config, options, console))
        keyboard = stack.enter_context(Keyboard())
        view = stack.enter_context(View(console, f"{source} on {config.name}"))
        bridge = BridgeRobot(session, rig, keyboard, view, config.name)
        if rig:
            session.prepare(rig)
            session.arm()
            rig.throw(True)
            session.beat(COMPUTING)  # armed and paused, until the first population is drawn
        return loop.finetune(source, settings, run, bridge, console, bridge, experiment)


def _artefact_of(source: str, experiment: Experiment, folder: Path, console: Console) -> Path:
    """The source itself when it is an artefact; else its policy, exported beside the run."""
    if (Path(source) / artefacts.MANIFEST).exists():
        return Path(source)
    target = folder / "start"
    finalize.export_policy(target, load_policy.load(source), experiment, None, console)
    return target
