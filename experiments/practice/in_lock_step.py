"""Practice on the emulated robot in this process: it plays, and stands still while the world is identified."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.finetuning import loop
from experiments.options import RobotOptions
from experiments.practice.growing_log import GrowingLog
from experiments.practice.learner import Learner
from experiments.practice.practice import Exchange, Piece, Practice
from experiments.runs import load_policy
from robot_io.control.bridge import BridgeState
from robot_io.control.interfaces import BridgeConfig
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.opponent import Opponent, Throws
from robot_io.errors import RefusedError
from robot_io.log.recorder import FileRecorder
from robot_io.policy.backends import make_policy

PIECE = 5.0  # [s] of play between two looks at the log
LONGEST_WAIT = 60.0  # [s] of play without a ball


def practise(
    source: Path,
    folder: Path,
    console: Console,
    setup: RobotOptions,
    updates: int,
    balls: int | None = None,
    seconds: float | None = None,
) -> int:
    """Plays until so many balls were played or so many seconds of play are over; returns the exit status.

    1: it ended early, for no ball was played any more.
    """
    experiment = loop.experiment_of(source, setup.distribution)
    name, robot = time.strftime("%Y%m%d-%H%M%S"), experiment.task.robot
    opponent: Opponent | Throws = loop.throws_of(experiment, setup.seed)
    if setup.player is not None:
        opponent = VirtualPlayer(setup.player, setup.seed)
    folder.mkdir(parents=True, exist_ok=True)
    with FileRecorder(folder, name, {}) as recorder:
        rig = LockStep(
            robot.scene(),
            opponent,
            make_policy("jit", load_policy.load(source).policy.astype(np.float32), robot.contract),
            robots.load_rig(setup.rig, robot),
            BridgeConfig(contract=robot.contract),
            recorder=recorder,
        )

        def say(text: str) -> None:
            console.print(text, highlight=False, soft_wrap=True)

        course = Practice(source, experiment.distribution, folder / name, Learner(updates, setup.seed), say)
        growing = GrowingLog(folder / f"{name}.mcap")
        rig.start()
        rig.throwing, heard, status, waiting = True, 0.0, 0, None
        while course.count < (balls or np.inf) and rig.now < (seconds or np.inf):
            if rig.run(PIECE, lambda: rig.bridge.state in (BridgeState.FAULT, BridgeState.DISARMED)):
                rig.recover()
            recorder.flush()
            new, returned, joints = growing.read()
            course.add(Piece(list(new), returned, joints))
            heard = rig.now if new else heard
            if rig.now > heard + LONGEST_WAIT:
                say(f"no ball was played for {LONGEST_WAIT:g} s: {[str(fault) for fault in rig.bridge.gate.faults]}")
                status = 1
                break
            waiting = course.back() or (course.refine(joints) if course.due else None) or waiting
            waiting = _put(rig, waiting)
    console.print(f"  journal    {folder / name / 'journal.jsonl'}")
    console.print(f"  log        {folder / name}.mcap")
    return status


def _put(rig: LockStep, waiting: Exchange | None) -> Exchange | None:
    """Hands a policy over between two balls; what could not be handed over yet."""
    if waiting is None:
        return None
    policy = load_policy.load(waiting.policy).policy.astype(np.float32)
    with suppress(RefusedError):  # the ball before is still played
        rig.bridge.set_policy(make_policy("jit", policy, rig.bridge.config.contract), waiting.version)
        return None
    return waiting
