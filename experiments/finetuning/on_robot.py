"""``mjx-tt finetune``: fine-tuning on a robot, on the rig in real time or in lock-step.

A real robot, and the rig in real time, are behind the bridge process, with the operator at the keyboard.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.config import robot as robots
from experiments.config.build import Experiment
from experiments.config.finetuning import FineTuning
from experiments.deploy.calibration_check import SESSIONS
from experiments.deploy.control_session import RECOVERIES, ControlSession, load_installed, open_session
from experiments.deploy.operator_console import PAUSE, QUIT, Keyboard, View
from experiments.deploy.recovery import Controls
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.finetuning import loop
from experiments.finetuning.robot import LockStepRallies, Operator, PlayedBall, Robot
from experiments.options import LOCK_STEP, RIG, RobotOptions
from experiments.runs import load_policy
from experiments.runs.run_dir import Run
from experiments.training import finalize
from robot_io.control.messages import Beat, Discarded, Message, Pause, Played, PolicySet, Refused, SetPolicy, Stop
from robot_io.emulator.processes import Rig
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts
from robot_io.policy.policy import Policy
from robot_io.safety.owner_watch import LONGEST_ABSENCE

GLANCE = 0.1  # [s] between two looks at the keys
COMPUTING = LONGEST_ABSENCE  # for an update between two balls, the compilation of the first one included


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
    exported = Path(source)
    if not (exported / artefacts.MANIFEST).exists():
        exported = run.folder / "start"
        finalize.export_policy(exported, load_policy.load(source), experiment, None, console)
    policy = artefacts.load(exported)
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


class BridgeRobot(Operator):
    """A robot behind a control process, and its operator.

    It takes balls only while an episode is asked for, and credits only those that the policy of that episode played.
    rig: None for a real robot, whose operator recovers from faults.
    """

    repeatable = False

    def __init__(self, session: ControlSession, rig: Rig | None, keyboard: Keyboard, view: View) -> None:
        self._session, self._rig, self._controls = session, rig, Controls(session, keyboard, view, rig is not None)
        self._paused = self._stopped = self._retracts = False
        self._version = self._credited = 0  # of the policy, of the ball that was returned last
        session.send(Pause(True))

    def describe(self) -> dict[str, Any]:
        return {"robot": self._session.robot.name}

    def play(self, policy: Policy, episode_number: int) -> PlayedBall:
        """Wait for the person's next ball. Raises RefusedError when the robot cannot be brought back after faults.

        The policy is exchanged while no new ball is taken; refused, because the ball before is still played, it is
        handed over again. A ball that another version played does not count.
        """
        self._version += 1
        exchange = SetPolicy(policy, self._version)
        session, failures = self._session, 0
        session.send(exchange)
        while True:
            refused = False
            for message in session.messages(GLANCE):
                self._take(message)
                if isinstance(message, PolicySet) and message.version == self._version:
                    session.send(Pause(False))
                elif isinstance(message, Refused) and isinstance(message.request, SetPolicy):
                    refused = True
                elif isinstance(message, Played):
                    if message.summary.policy_version != self._version:
                        self._controls.view.say(
                            f"ball {message.summary.ball} was played by an earlier policy: not counted"
                        )
                        continue
                    session.send(Pause(True))
                    if message.summary.fault and self._rig is not None:
                        session.recover(self._rig)
                    session.send(Beat(COMPUTING))
                    self._credited = message.summary.number
                    return PlayedBall(message.summary, message.ball)
            if refused:
                session.send(exchange)
            self._keys()
            if self._rig is not None:
                self._rig.check()
                if session.status and (halt := session.status.halt):
                    failures += 1
                    if failures > RECOVERIES:
                        raise RefusedError(f"the rig does not recover: {halt.text}")
                    session.recover(self._rig)
                    session.send(exchange)

    def _take(self, message: Message) -> None:
        self._controls.take(message)
        if isinstance(message, Discarded):
            self._retracts |= message.number == self._credited != 0

    def _wait(self, seconds: float) -> None:
        """Reads keys and messages for so long."""
        for _ in range(max(1, math.ceil(seconds / GLANCE))):
            for message in self._session.messages(min(seconds, GLANCE)):
                self._take(message)
            self._keys()

    def _keys(self) -> None:
        key = self._controls.pressed()
        if key == QUIT:
            self._stopped = True
            self._session.send(Stop())  # ends the episode in play, which is then played again
        elif key == PAUSE:
            self._paused = not self._paused

    # The operator, asked between episodes

    def retracts(self, seconds: float = 0.0) -> bool:
        if seconds:
            self._wait(seconds)
        retracts, self._retracts = self._retracts, False
        return retracts

    def paused(self) -> bool:
        """Also keep the view alive while it waits."""
        self._wait(0.0)
        return self._paused and not self._stopped

    def stopped(self) -> bool:
        return self._stopped
