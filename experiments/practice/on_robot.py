"""``mjx-tt practise``: play on a robot, and beside it a process of low priority that keeps the policy right.

That process reads the session's log as it grows and sends back policies. It shares nothing with the control process:
it may be slow, fail or be killed, and play goes on.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.deploy import play
from experiments.deploy.control_session import ControlSession
from experiments.errors import ConfigError
from experiments.finetuning import loop
from experiments.options import LOCK_STEP, RobotOptions
from experiments.practice import in_lock_step
from experiments.practice.practice import Exchange
from experiments.runs.locate import artefact_of, find_policy
from robot_io.contract import PAPER
from robot_io.control.messages import Message, PolicySet, Refused, SetPolicy
from robot_io.policy.policy import Policy

LOOK = 5.0  # [s] between two looks at the log
RESTART = 10.0  # [s] after which a process that ended is started again


def practise(
    policy: str,
    robot: str,
    folder: Path,
    console: Console,
    setup: RobotOptions,
    updates: int,
    balls: int | None = None,
    rallies: int | None = None,
    seconds: float | None = None,
) -> int:
    """Plays as ``play.run`` does, with a companion; returns the exit status. folder: of the log and all that is made.

    Raises ConfigError for a policy that does not say how it was trained, or of another robot than the paper's.
    """
    source = find_policy(policy)
    if loop.experiment_of(source).task.robot.contract != PAPER:
        raise ConfigError(f"{policy}: expected a policy of the paper's robot, whose worlds can be identified")
    if robot == LOCK_STEP:
        if rallies is not None:
            raise ConfigError(f"--rallies {rallies}: lock-step ends after --balls or --seconds; give one of them")
        return in_lock_step.practise(source, folder, console, setup, updates, balls, seconds)

    def accompany(session: ControlSession) -> Companion:
        if session.log_file is None:
            raise ConfigError("a session that is practised in needs a log")
        made = folder / session.options.log_name
        return Companion(session, Assignment(session.log_file, source, made, updates, setup.seed), console)

    return play.run(artefact_of(source), robot, folder, console, setup, balls, rallies, seconds, accompany)


@dataclass(frozen=True)
class Advice:
    """A policy for the robot, and what it is; or only a sentence."""

    sentence: str
    policy: Policy | None = None
    exchange: Exchange | None = None


@dataclass(frozen=True)
class Assignment:
    """What the process beside needs to know."""

    log: Path  # first file of the session's log, as it is named when it is finished
    policy: Path  # run or artefact in play
    folder: Path
    updates: int
    seed: int


class Companion:
    """The robot's side of it: hands policies over between balls, and tells what was found."""

    def __init__(self, session: ControlSession, assignment: Assignment, console: Console) -> None:
        self._session, self._assignment, self._console = session, assignment, console
        self._starts = 0
        self._waiting: Advice | None = None
        self._asked, self._version, self._ended = False, 0, 0.0
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # What a process before it has made stays, and has the same names.
        given = replace(self._assignment, folder=self._assignment.folder / str(self._starts))
        self._starts += 1
        self._process = context.Process(target=advise, args=(given, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def take(self, message: Message) -> None:
        """A message of the control process: whether a policy was exchanged."""
        waiting = self._waiting
        if waiting is None:
            return
        if isinstance(message, PolicySet) and message.version == self._version:
            assert waiting.exchange is not None
            self._assignment = replace(self._assignment, policy=waiting.exchange.policy)
            self._waiting = None
            self._console.print(f"policy {self._version} is in play: {waiting.sentence}", highlight=False)
        elif isinstance(message, Refused) and isinstance(message.request, SetPolicy):
            self._asked = False  # the ball before is still played

    def look(self) -> None:
        """Reads what the process beside found, and asks for the exchange that is due. Never waits."""
        try:
            while self._pipe.poll():
                advice = self._pipe.recv()
                self._console.print(advice.sentence, highlight=False, soft_wrap=True)
                if advice.policy is not None:
                    self._waiting, self._asked = advice, False
                    self._version += 1
        except (EOFError, OSError):
            self._restart()
        if self._waiting is not None and self._waiting.policy is not None and not self._asked:
            self._session.send(SetPolicy(self._waiting.policy, self._version))
            self._asked = True

    def _restart(self) -> None:
        now = time.monotonic()
        if not self._ended:
            self._ended = now
            self._console.print(f"the process beside has ended; it starts again in {RESTART:g} s", style="yellow")
        elif now > self._ended + RESTART:
            self._ended = 0.0
            self._start()

    def close(self) -> None:
        """Ends the process beside."""
        self._process.terminate()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()


def advise(assignment: Assignment, pipe: Connection) -> None:
    """The process beside: reads the log until the pipe is closed."""
    _step_back()
    from experiments import options

    options.start_jax()
    from experiments.practice.growing_log import GrowingLog
    from experiments.practice.learner import Learner
    from experiments.practice.practice import Piece, Practice
    from experiments.runs import load_policy

    def say(sentence: str) -> None:
        pipe.send(Advice(sentence))

    experiment = loop.experiment_of(assignment.policy)
    learner = Learner(assignment.updates, assignment.seed)
    course = Practice(assignment.policy, experiment.distribution, assignment.folder, learner, say)
    growing = GrowingLog(assignment.log)
    while not pipe.poll(LOOK):
        balls, returned, joints = growing.read()
        if balls:
            alarm = course.add(Piece(list(balls), returned, joints))
            if alarm is not None:
                say(f"ball {course.count}: something has changed: {alarm.name}")
        exchange = course.back()
        if exchange is None and course.due:
            exchange = course.refine(joints)
        if exchange is not None:
            policy = load_policy.load(exchange.policy).policy.astype(np.float32)
            pipe.send(Advice(exchange.reason, policy, exchange))


def _step_back() -> None:
    """Leaves the processor to everything else: only what is idle, of one core only."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
