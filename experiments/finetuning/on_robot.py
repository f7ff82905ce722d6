"""``mjx-tt finetune``: fine-tuning on a robot, on the rig in real time or in lock-step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.config import robot as robots
from experiments.config.build import Experiment
from experiments.config.finetuning import FineTuning
from experiments.deploy.calibration_check import SESSIONS
from experiments.deploy.control_session import load_installed, open_session
from experiments.deploy.operator_console import Keyboard, View
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.finetuning import loop
from experiments.finetuning.bridge_robot import COMPUTING, BridgeRobot
from experiments.finetuning.robot import LockStepRallies, Robot
from experiments.options import LOCK_STEP, RIG, RobotOptions
from experiments.runs import load_policy
from experiments.runs.run_dir import Run
from experiments.training import finalize
from robot_io.policy import artefact as artefacts


def finetune(
    source: str, settings: FineTuning, run: Run, robot: str, console: Console, setup: RobotOptions
) -> dict[str, Any] | None:
    """Fine-tunes on the robot of a robot.yaml, on RIG or LOCK_STEP; None when the operator stopped it."""
    experiment = loop.experiment_of(source, setup.distribution)
    if robot == LOCK_STEP:
        return loop.finetune(source, settings, run, _in_lock_step(experiment, setup), console, None, experiment)
    installed = None
    if robot != RIG:
        installed = load_installed(robot, source, experiment.task.robot.contract, SESSIONS)
    run.folder.mkdir(parents=True, exist_ok=True)
    policy = artefacts.load(_find_artefact(source, experiment, run.folder, console))
    with (
        open_session(policy, robot, installed, run.folder, console, setup) as (session, rig),
        Keyboard() as keyboard,
        View(console, f"{source} on {session.robot.name}") as view,
    ):
        bridge = BridgeRobot(session, rig, keyboard, view)
        if rig:
            session.prepare(rig)
            session.arm()
            rig.throw(True)
            session.beat(COMPUTING)  # armed and paused, until the first population is drawn
        return loop.finetune(source, settings, run, bridge, console, bridge, experiment)


def _in_lock_step(experiment: Experiment, setup: RobotOptions) -> Robot:
    robot = experiment.task.robot
    params = robots.load_rig(setup.rig, robot)
    if setup.player is None:
        return loop.lock_step_robot(experiment, params, setup.seed)
    player = VirtualPlayer(setup.player, setup.seed)
    return LockStepRallies(player, params, robot.scene(), contract=robot.contract)


def _find_artefact(source: str, experiment: Experiment, folder: Path, console: Console) -> Path:
    """The source itself when it is an artefact; else its policy, exported beside the run."""
    if (Path(source) / artefacts.MANIFEST).exists():
        return Path(source)
    target = folder / "start"
    finalize.export_policy(target, load_policy.load(source), experiment, None, console)
    return target
