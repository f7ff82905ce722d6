"""``mjx-tt run``: an exported policy plays on a robot, real or emulated, through the same bridge."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import calibration_check, session_report
from experiments.deploy.control_session import RECOVERIES, ControlSession, load_installed, open_session
from experiments.deploy.operator_console import PAUSE, QUIT, Keyboard, View
from experiments.deploy.recovery import Controls
from experiments.deploy.session_report import PlayedSession
from experiments.interrupts import stop_requested
from experiments.options import RIG, RobotOptions
from experiments.runs import run_dir
from robot_io.contract import PAPER
from robot_io.control.config import RobotConfig
from robot_io.control.messages import Discarded, Message, Pause, Played, RallyOver
from robot_io.emulator.processes import Rig
from robot_io.errors import RefusedError
from robot_io.log import view as log_view
from robot_io.policy import artefact as artefacts

QUIET = 30.0  # [s] without a ball on the rig, after which something is wrong
INTERRUPTED = 130  # exit status after a signal, as a shell gives it for Ctrl-C


def run(
    artefact: Path,
    robot: str,
    log_folder: Path,
    console: Console,
    setup: RobotOptions,
    balls: int | None = None,
    rallies: int | None = None,
    seconds: float | None = None,
    accompany: Callable[[ControlSession], Companion] | None = None,
) -> int:
    """Plays a policy; returns the exit status.

    accompany: makes what is to go along with play.

    Ends when ``balls`` outcomes are known, ``rallies`` that count are over, ``seconds`` have passed, or the operator
    quits. 0: all went well, 1: it ended early, 130: ended by Ctrl-C, SIGTERM or a closed terminal. The summary is
    written in any case, also where control process, rig or this program fail: then it raises what failed.
    """
    policy = artefacts.load(artefact)
    installed = None if robot == RIG else load_installed(robot, artefact, policy.contract, log_folder)
    played = PlayedSession()
    with open_session(policy, robot, installed, log_folder, console, setup) as (session, rig):
        if rig is not None:
            session.prepare(rig)
            session.arm()
            rig.throw(True)
        else:
            console.print("press p to prepare the axes, a to arm; space stops")
        failure: Exception | None = None
        try:
            with (
                stop_requested(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as stop,
                Keyboard() as keyboard,
                View(console, f"{artefact} on {session.robot.name}") as view,
            ):
                controls = Controls(session, keyboard, view, rig is not None)
                companion = accompany(session) if accompany is not None else None
                try:
                    problem = _Play(session, rig, controls, played, balls, rallies, seconds, stop, companion).run()
                finally:
                    if companion is not None:
                        companion.close()
            if stop.is_set():
                raise KeyboardInterrupt
            status = 1 if problem else 0
        except (Exception, KeyboardInterrupt) as error:  # whatever ends the session, what was played is not to be lost
            if isinstance(error, KeyboardInterrupt) or stop.is_set():  # the rig ends with the same signal
                status, problem = INTERRUPTED, "stopped by Ctrl-C or another signal"
            else:
                status, problem, failure = 1, "", error
        session.close()
    summary = session_report.summary(policy, session.robot, played, session.status, session.timings, session.log_file)
    summary |= {"faults": [asdict(fault) for fault in played.faults], "player": setup.player}
    path = log_folder / f"{session.options.log_name}.json"
    if policy.contract != PAPER:  # the shipped layout of the viewers is for the paper's robot's log
        summary["layout"] = str(path.with_suffix(".layout.json"))
        run_dir.write_json(path.with_suffix(".layout.json"), log_view.layout(policy.contract))
    _finish(summary, session.robot, session.log_file, path, console)
    if failure is not None:
        raise failure
    if problem:
        console.print(problem, style="red")
    return status


def _finish(summary: dict[str, Any], config: RobotConfig, log_file: Path | None, path: Path, console: Console) -> None:
    """Writes and shows a session's summary, then adds the contacts in its log, without which it is whole as well."""
    summary["calibration"] = robots.plain(config.calibration)
    run_dir.write_json(path, summary)
    try:
        contacts = calibration_check.measure(config, log_file)
        if contacts is not None:
            run_dir.write_json(path, summary | {"contacts": contacts})
    except (Exception, KeyboardInterrupt) as error:  # whatever it is, what was played is not to be lost
        reason = f"{type(error).__name__}: {error}".removesuffix(": ")
        console.print(f"contacts of ball and paddle not measured: {reason}", style="yellow")
    session_report.show(console, summary, path)


class Companion(Protocol):
    """Goes along with a session. Nothing of it may wait: the robot's keys are read in between."""

    def take(self, message: Message) -> None:
        """Takes a message of the control process."""

    def look(self) -> None:
        """Called some ten times a second."""

    def close(self) -> None:
        """The session is over."""


@dataclass
class _Play:
    """The loop between the first ball and the last."""

    session: ControlSession
    rig: Rig | None
    controls: Controls
    played: PlayedSession
    balls: int | None
    rallies: int | None
    seconds: float | None
    stop: threading.Event
    companion: Companion | None = None
    faults_in_a_row: int = 0
    heard: float = 0.0  # when the last ball was played

    def run(self) -> str | None:
        """Plays until the end or until ``stop`` is set; returns the reason why it ended early."""
        self.heard = time.monotonic()
        end = self.heard + (math.inf if self.seconds is None else self.seconds)
        while time.monotonic() < end and not self.stop.is_set():
            enough = len(self.played.episodes) >= (self.balls or math.inf)
            if enough or len(self.played.counted) >= (self.rallies or math.inf):
                break
            for message in self.session.messages(0.1):
                self._take(message)
            if self.companion is not None:
                self.companion.look()
            key = self.controls.pressed()
            if key == QUIT:
                break
            if key == PAUSE:
                self.session.send(Pause(not (self.session.status and self.session.status.paused)))
            if self.rig is not None and (problem := self._watch_rig(self.rig)):
                return problem
        return None

    def _take(self, message: Message) -> None:
        self.controls.take(message)
        if self.companion is not None:
            self.companion.take(message)
        console = self.session.console
        if isinstance(message, Played):
            self.heard = time.monotonic()
            self.played.episodes.append(message.summary)
            self.faults_in_a_row = self.faults_in_a_row if message.summary.fault else 0
            if not console.is_terminal:
                console.print(f"ball {len(self.played.episodes)}: {message.summary.outcome}")
        elif isinstance(message, Discarded):
            self.played.discard(message.number)
        elif isinstance(message, RallyOver):
            rally = message.summary
            self.played.rallies.append(rally)
            if not console.is_terminal and self.balls is None:  # who counts balls may have a launcher
                touches = f"{rally.length} touch{'es' * (rally.length != 1)}"
                console.print(f"rally {rally.number}: {touches}: {rally.text}")

    def _watch_rig(self, rig: Rig) -> str | None:
        """Brings the rig back after a fault; returns the reason where that fails, or where no ball comes."""
        rig.check()
        if self.session.status and (fault := self.session.status.halt):
            self.faults_in_a_row += 1
            text = f"{fault.cause}: {fault.text}"
            if self.faults_in_a_row > RECOVERIES:
                return f"stopped by {self.faults_in_a_row} faults in a row, the last: {text}"
            self.played.faults.append(fault)
            self.session.console.print(f"fault, reset and resumed: {text}", style="red")
            try:
                self.session.recover(rig)
            except RefusedError as error:
                return f"not brought back after {text}: {error}"
        if time.monotonic() - self.heard > QUIET:
            return f"no ball was played for {QUIET:g} s"
        return None
