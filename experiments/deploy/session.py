"""``mjx-tt run``: an exported policy on a robot, real or emulated, through the same bridge."""

from __future__ import annotations

import json
import math
import select
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments import stages
from experiments.config import robot as robots
from experiments.deploy import contradictions, robot_attachment, session_report
from experiments.deploy.operator_console import KEYS, PAUSE, QUIT, RECOVER, Keyboard, View
from experiments.deploy.recovery import Recovery
from experiments.deploy.rig import RIG, box_of, rig_for
from experiments.deploy.session_report import PlayedSession
from experiments.runs import run_dir
from robot_io.contract import PAPER
from robot_io.control import messages, process
from robot_io.control.config import RobotConfig
from robot_io.control.messages import Message, Played, RallyOver, Refused, Request, Status
from robot_io.emulator.processes import Rig
from robot_io.errors import JogFirstError, RefusedError
from robot_io.log import view as log_view
from robot_io.policy import artefact as artefacts
from robot_io.safety.owner_watch import BEAT_PERIOD

READY_TIME = 60.0  # [s] for the control process to start
PREPARE_TIME = 40.0  # [s] for the axes to home and the arm to report
RESET_TIME = 5.0  # [s]
SETTLE = 1.0  # [s] for the robot to come to rest after a fault
RECOVERIES = 3  # times in a row that the rig is brought back after a fault before it counts as broken
QUIET = 30.0  # [s] without a ball on the rig, after which something is wrong
INTERRUPTED = 130  # exit status after Ctrl-C, as a shell gives it


class Session:
    """One control process with its console, from start to end; use as a context manager.

    Raises RefusedError when it does not start, with the reason.
    """

    def __init__(self, robot: RobotConfig, options: process.ControlOptions, console: Console) -> None:
        self.console = console
        self.process, self.pipe = process.start(robot, options)
        try:
            self.report = process.wait_for(self.pipe, messages.Ready, READY_TIME).report
        except (RefusedError, TimeoutError, EOFError) as error:
            self.process.join(2.0)
            self.process.kill()
            raise RefusedError(str(error) or "the control process ended at once") from None
        self.status: Status | None = None
        self.timings: dict[str, Any] = {}
        self._episodes: deque[Played | RallyOver] = deque()  # that came while an answer was waited for
        self._beaten = -math.inf

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def send(self, request: Request) -> None:
        """Send a request; refusals come as messages."""
        try:
            self.pipe.send(request)
        except OSError:
            pass  # it has ended: the next message says so

    def beat(self, absence: float = 0.0) -> None:
        """Show that the operator's keys are read, or will be again in so many seconds.

        Only from where they are read: a thread that beats by itself would go on beside a terminal that hangs.
        """
        self._beaten = time.monotonic()
        try:
            free = select.select([], [self.pipe], [], 0.0)[1]
        except (OSError, ValueError):
            return  # it has ended: the next message says so
        if free:  # a control process that stands still must not keep the owner from its keys
            self.send(messages.Beat(absence))

    def messages(self, seconds: float) -> Iterator[Message]:
        """Messages that arrive within that time. Raises RefusedError when the control process has ended.

        Whoever has armed the robot must call it again within ``robot_io.safety.owner_watch.LONGEST_SILENCE``.
        """
        while self._episodes:
            yield self._episodes.popleft()
        yield from self._received(seconds)

    def _answers(self, seconds: float) -> Iterator[Message]:
        """``messages`` without the episodes, which are kept for it."""
        for message in self._received(seconds):
            if isinstance(message, Played | RallyOver):
                self._episodes.append(message)
            else:
                yield message

    def _received(self, seconds: float) -> Iterator[Message]:
        end = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            if now >= self._beaten + BEAT_PERIOD:
                self.beat()
            if not self.pipe.poll(max(min(end - now, BEAT_PERIOD), 0.0)):
                if time.monotonic() >= end:
                    return
                continue
            try:
                message = self.pipe.recv()
            except (EOFError, OSError):
                raise RefusedError(f"the control process has ended (status {self.process.exitcode})") from None
            if isinstance(message, messages.Failed):
                raise RefusedError(f"the control process failed after it had stopped the robot: {message.sentence}")
            if isinstance(message, Status):
                self.status = message
            yield message

    def _statuses(self, seconds: float) -> Iterator[Status]:
        """States that arrive within that time. Raises RefusedError for a refusal, with its reason."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for message in self._answers(0.3):
                if isinstance(message, Refused):
                    raise message.error
                if isinstance(message, Status):
                    yield message

    def prepare(self, rig: Rig | None) -> None:
        """Switch the axes on and home them, on the rig the arm too, until nothing is missing. Raises RefusedError.

        In a fault they are not homed: nothing else is missing then.
        """
        if rig is not None:
            rig.switch_on()
        end, again = time.monotonic() + PREPARE_TIME, True
        refusal: RefusedError | None = None
        while time.monotonic() < end:
            if again:
                self.send(messages.Prepare())
            again = False
            for message in self._answers(0.3):
                if isinstance(message, Status):
                    unhomed = (
                        message.state == "fault" and message.preparable and not message.arm and not message.tracker
                    )
                    if unhomed or not message.missing:
                        return
                if isinstance(message, Refused):  # until the arm has sent its position, or an axis has answered
                    refusal, again = message.error, True
        missing = "no status" if self.status is None else self.status.missing
        text = f"the robot does not get ready within {PREPARE_TIME:g} s: {missing}"
        raise RefusedError(text) if refusal is None else type(refusal)(f"{text}; {refusal}")

    def reset(self) -> None:
        """Reset a fault and wait until it is gone; without a fault there is nothing to do. Raises RefusedError."""
        for _ in self._answers(0.0):  # to see how things are now
            pass
        if self.status is not None and self.status.state != "fault":
            return
        self.send(messages.Reset())
        for status in self._statuses(RESET_TIME):
            if not status.faults:
                return
        raise RefusedError("the fault is not reset")

    def arm(self) -> None:
        """Arm and wait for the home pose. Raises RefusedError."""
        self.send(messages.Arm())
        for status in self._statuses(PREPARE_TIME):
            if status.faults:
                raise RefusedError(status.faults[0].text)
            if status.at_home:
                return
        raise RefusedError(f"the robot does not reach its home pose within {PREPARE_TIME:g} s")

    def recover(self, rig: Rig) -> None:
        """Bring the rig back after a fault, as an operator does. Raises RefusedError when it fails RECOVERIES times."""
        for attempt in range(RECOVERIES):
            time.sleep(SETTLE)
            for _ in self._answers(0.0):  # older than the fault
                pass
            try:
                self.prepare(rig)
                self.reset()
                self.prepare(rig)  # what lost its reference is homed without a fault only
                self.arm()
                return
            except RefusedError as error:  # a busy machine may be late again: a new fault, or what is over by now
                if attempt == RECOVERIES - 1 or not self.process.is_alive():
                    raise
                if isinstance(error, JogFirstError):
                    rig.jog()

    def close(self) -> None:
        """Stops the robot in order, then the process."""
        if self.process.is_alive():
            self.send(messages.Quit())
            try:
                self.timings = process.wait_for(self.pipe, messages.Ended, 10.0).timings
            except (RefusedError, TimeoutError, EOFError, OSError):
                pass
        self.process.join(10.0)
        if self.process.is_alive():
            self.process.kill()
        self.pipe.close()


def run(
    artefact: Path,
    robot: str,
    balls: int | None,
    distribution: str | None,
    backend: str,
    log_folder: Path,
    rig_params: str | None,
    seed: int,
    seconds: float | None,
    console: Console,
    rallies: int | None = None,
    player: str | None = None,
) -> int:
    """Play until ``balls`` outcomes are known, ``rallies`` that count are over, ``seconds`` have passed, or until the
    operator quits; the exit status.

    player: virtual player who rallies with the robot on the rig.

    0: all went well, 1: it ended early, 130: the operator ended it with Ctrl-C; the summary is written in any case.
    """
    loaded = artefacts.load(artefact)
    with ExitStack() as stack:
        rig = None
        if robot == RIG:
            console.print("starting the rig ...", highlight=False)
            rig = stack.enter_context(rig_for(loaded, distribution, rig_params, seed, player))
            contract, config, text = loaded.contract, rig.robot, robots.to_yaml(rig.robot)
        else:
            contract = robots.standing(robot)
            artefacts.check_robot(artefact, loaded.contract, contract)
            config = robots.load_robot(robot, contract=contract)
            contradictions.check(config, robot, log_folder)
            text = Path(robot).read_text(encoding="utf-8")
        name = time.strftime("%Y%m%d-%H%M%S")
        git = run_dir.git_state()
        options = process.ControlOptions(
            str(artefact),
            backend,
            str(log_folder),
            name,
            box_of(loaded),
            (("git", json.dumps(git)),),
            (
                ("robot.yaml", text),
                ("calibration.yaml", robots.to_yaml(config.calibration)),
                *robot_attachment.of_policy(loaded, console),
            ),
            contract=contract,
        )
        log_folder.mkdir(parents=True, exist_ok=True)
        session = stack.enter_context(Session(config, options, console))
        for line in session.report:
            console.print(f"  {line}", highlight=False)
        if rig is not None:
            session.prepare(rig)
            session.arm()
            rig.throw(True)
        else:
            console.print("press p to prepare the axes, a to arm; space stops", highlight=False)
        played = PlayedSession()
        try:
            with (
                stages.orderly() as asked,
                Keyboard() as keyboard,
                View(console, f"{artefact} on {config.name}") as view,
            ):
                problem = _watch(session, rig, keyboard, view, balls, rallies, seconds, console, played, asked)
            if asked.is_set():
                raise KeyboardInterrupt
            status = 1 if problem else 0
        except KeyboardInterrupt:
            status, problem = INTERRUPTED, "stopped by Ctrl-C"
        session.close()
    log_file = process.log_path(options)
    summary = session_report.summary(loaded, config, played, session.status, session.timings, log_file)
    summary |= {"faults": [asdict(fault) for fault in played.faults], "player": player}
    if loaded.contract != PAPER:  # the shipped layout of the viewers is for the paper's robot's log
        path = log_folder / f"{name}.layout.json"
        run_dir.write_json(path, log_view.layout(loaded.contract))
        summary["layout"] = str(path)
    _finish(summary, config, log_file, log_folder / f"{name}.json", console)
    if problem:
        console.print(problem, style="red", highlight=False)
    return status


def _finish(summary: dict[str, Any], config: RobotConfig, log_file: Path | None, path: Path, console: Console) -> None:
    """Write and show a session's summary, then add the contacts in its log, without which it is whole as well."""
    summary["calibration"] = robots.plain(config.calibration)
    run_dir.write_json(path, summary)
    try:
        contacts = contradictions.observed(config, log_file)
        if contacts is not None:
            run_dir.write_json(path, summary | {"contacts": contacts})
    except (Exception, KeyboardInterrupt) as error:  # whatever it is, what was played is not to be lost
        reason = f"{type(error).__name__}: {error}".removesuffix(": ")
        console.print(f"contacts of ball and paddle not measured: {reason}", style="yellow", highlight=False)
    session_report.show(console, summary, path)


def _watch(
    session: Session,
    rig: Rig | None,
    keyboard: Keyboard,
    view: View,
    balls: int | None,
    rallies: int | None,
    seconds: float | None,
    console: Console,
    played: PlayedSession,
    asked: threading.Event,
) -> str | None:
    """Play until the end or until it is ``asked`` for, adding to what was played; the reason why it ended early."""
    in_a_row = 0
    end = time.monotonic() + (float("inf") if seconds is None else seconds)
    heard = time.monotonic()
    recovery: Recovery | None = None
    while time.monotonic() < end and not asked.is_set():
        if len(played.episodes) >= (balls or math.inf) or len(played.counted) >= (rallies or math.inf):
            break
        for message in session.messages(0.1):
            view.take(message)
            if isinstance(message, Refused) and recovery is not None and recovery.refused(message):
                recovery = None
            elif isinstance(message, Status) and recovery is not None:
                recovery = _continued(session, recovery, message, view)
            if isinstance(message, Played):
                heard = time.monotonic()
                played.episodes.append(message.summary)
                in_a_row = in_a_row if message.summary.fault else 0
                if not console.is_terminal:
                    console.print(f"ball {len(played.episodes)}: {message.summary.outcome}", highlight=False)
            elif isinstance(message, RallyOver):
                played.rallies.append(message.summary)
                if not console.is_terminal and balls is None:  # who counts balls may have a launcher
                    rally = message.summary
                    touches = f"{rally.length} touch{'es' * (rally.length != 1)}"
                    console.print(f"rally {rally.number}: {touches}: {rally.text}", highlight=False)
        key = keyboard.pressed()
        if key is not None:  # whatever it is, the operator wants something else
            recovery = Recovery(time.monotonic(), session.status, rig is not None) if key == RECOVER else None
        if key == QUIT:
            break
        if key == PAUSE:
            session.send(messages.Pause(not (session.status and session.status.paused)))
        elif key in KEYS and (request := KEYS[key].request) is not None:
            session.send(request)
        if key in KEYS:
            view.say(KEYS[key].text)
        if rig is not None:
            rig.check()
            if session.status and (fault := session.status.halt):
                in_a_row += 1
                text = f"{fault.cause}: {fault.text}"
                if in_a_row > RECOVERIES:
                    return f"stopped by {in_a_row} faults in a row, the last: {text}"
                played.faults.append(fault)
                console.print(f"fault, reset and resumed: {text}", style="red", highlight=False)
                try:
                    session.recover(rig)
                except RefusedError as error:
                    return f"not brought back after {text}: {error}"
            if time.monotonic() - heard > QUIET:
                return f"no ball was played for {QUIET:g} s"
    return None


def _continued(session: Session, recovery: Recovery, status: Status, view: View) -> Recovery | None:
    """One step of a recovery; None when it has ended."""
    try:
        request = recovery.step(status, time.monotonic())
    except TimeoutError as error:
        view.say(str(error))
        return None
    if request is not None:
        session.send(request)
    if recovery.word:
        view.say(recovery.word)
    return None if recovery.done else recovery
