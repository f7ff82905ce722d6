"""A control process with its operator's side: start, requests, messages, recovery of the emulated robot, end."""

from __future__ import annotations

import ipaddress
import json
import math
import select
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import calibration_check, robot_attachment
from experiments.deploy.rig import box_of, rig_for
from experiments.errors import ConfigError
from experiments.options import RobotOptions
from experiments.runs import run_dir
from robot_io.contract import Contract
from robot_io.control import messages, process
from robot_io.control.config import RobotConfig
from robot_io.control.messages import Message, Played, RallyOver, Refused, Request, Status
from robot_io.emulator.processes import Rig
from robot_io.errors import JogFirstError, RefusedError
from robot_io.policy import artefact as artefacts
from robot_io.safety.owner_watch import BEAT_PERIOD

READY_TIME = 60.0  # [s] for the control process to start
PREPARE_TIME = 40.0  # [s] for the axes to home and the arm to report
RESET_TIME = 5.0  # [s]
SETTLE = 1.0  # [s] for the robot to come to rest after a fault
Wanted = TypeVar("Wanted", messages.Ready, messages.Ended)
RECOVERIES = 3  # times in a row that the rig is brought back after a fault before it counts as broken


class ControlSession:
    """One control process with its console, from start to end; use as a context manager.

    Raises RefusedError when it does not start, with the reason.
    """

    def __init__(self, robot: RobotConfig, options: process.ControlOptions, console: Console) -> None:
        self.robot, self.options, self.console = robot, options, console
        self.process, self.pipe = process.start(robot, options)
        try:
            self.report = _wait_for(self.pipe, messages.Ready, READY_TIME).report
        except (RefusedError, TimeoutError, EOFError) as error:
            self.process.join(2.0)
            self.process.kill()
            raise RefusedError(str(error) or "the control process ended at once") from None
        self.status: Status | None = None
        self.timings: dict[str, Any] = {}
        self._episodes: deque[Played | RallyOver] = deque()  # that came while an answer was waited for
        self._beaten = -math.inf

    @property
    def log_file(self) -> Path | None:
        """The MCAP log that the control process writes."""
        options = self.options
        return None if options.log_folder is None else Path(options.log_folder) / f"{options.log_name}.mcap"

    def __enter__(self) -> ControlSession:
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
        """Shows that the operator's keys are read, or will be again in so many seconds.

        Called only where they are read: a thread of its own would keep beating beside a terminal that hangs.
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

        With an armed robot it must be called again within ``robot_io.safety.owner_watch.LONGEST_SILENCE``.
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

        In a fault they are not homed: nothing else is missing then. On the rig balls are thrown until they have shown
        the tracker's frame.
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
                    if unhomed:
                        return
                    if not message.missing:
                        if rig is not None and message.unproven:
                            self._show_frame(rig)
                        return
                if isinstance(message, Refused):  # until the arm has sent its position, or an axis has answered
                    refusal, again = message.error, True
        missing = "no status" if self.status is None else self.status.missing
        text = f"the robot does not get ready within {PREPARE_TIME:g} s: {missing}"
        raise RefusedError(text) if refusal is None else type(refusal)(f"{text}; {refusal}")

    def _show_frame(self, rig: Rig) -> None:
        """Throw balls until they have shown the tracker's frame. Raises RefusedError."""
        before = rig.throwing
        rig.throw(True)
        try:
            for status in self._statuses(PREPARE_TIME):
                if not status.unproven or status.state == "fault":
                    return
        finally:
            rig.throw(before)
        unproven = "no status" if self.status is None else self.status.unproven
        raise RefusedError(f"the robot does not get ready within {PREPARE_TIME:g} s: {unproven}")

    def reset(self) -> None:
        """Reset a fault and wait until it is gone; without a fault there is nothing to do. Raises RefusedError."""
        for _ in self._answers(0.0):  # to see how things are now
            pass
        if self.status is not None and self.status.state != "fault":
            return
        self.send(messages.Reset())
        if not any(not status.faults for status in self._statuses(RESET_TIME)):
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
                self.timings = _wait_for(self.pipe, messages.Ended, 10.0).timings
            except (RefusedError, TimeoutError, EOFError, OSError):
                pass
        self.process.join(10.0)
        if self.process.is_alive():
            self.process.kill()
        self.pipe.close()


def load_installed(robot: str, policy: str | Path, contract: Contract, logs: Path) -> tuple[RobotConfig, Contract]:
    """The robot of a robot.yaml, for a policy of this contract, and the contract of the one that stands there.

    Raises ArtefactError for a policy of another robot, ConfigError where the newest session in ``logs`` contradicts the
    calibration, or where a robot is to be fast whose tracker has never been shown a point at a known place.
    """
    standing = robots.standing(robot)
    artefacts.check_robot(policy, contract, standing)
    config = robots.load_robot(robot, contract=standing)
    calibration_check.check(config, robot, logs)
    real, fast = not ipaddress.ip_address(config.arm.controller).is_loopback, robots.COMMISSIONING
    if real and config.safety.speed_scale > fast and not config.calibration.tracker.date:
        raise ConfigError(
            f"{robot}: calibration.tracker: expected one at safety.speed_scale {config.safety.speed_scale}, got none: "
            "no ball shows that x is mirrored, or the frame moved along the table. Calibrate it (mjx-tt calibrate "
            f"tracker), or play at {fast}"
        )
    return config, standing


@contextmanager
def open_session(
    policy: artefacts.Artefact,
    robot: str,
    installed: tuple[RobotConfig, Contract] | None,
    log_folder: Path,
    console: Console,
    setup: RobotOptions,
) -> Iterator[tuple[ControlSession, Rig | None]]:
    """A policy's session on the ``installed`` robot of a robot.yaml; None: on a rig that is started for it."""
    with ExitStack() as stack:
        if installed is None:
            console.print("starting the rig ...")
            rig = stack.enter_context(rig_for(policy, setup))
            config, contract, text = rig.robot, policy.contract, robots.to_yaml(rig.robot)
        else:
            rig, (config, contract), text = None, installed, Path(robot).read_text(encoding="utf-8")
        session = start_session(
            config,
            contract,
            log_folder,
            console,
            robot_yaml=text,
            attached=robot_attachment.of_policy(policy, console),
            artefact=str(policy.folder),
            backend=setup.backend,
            box=box_of(policy),
            metadata=(("git", json.dumps(run_dir.git_state())),),
        )
        yield stack.enter_context(session), rig


def start_session(
    config: RobotConfig,
    contract: Contract,
    log_folder: Path,
    console: Console,
    kind: str = "",
    robot_yaml: str | None = None,
    attached: robot_attachment.Attachments = (),
    **options: Any,
) -> ControlSession:
    """A session whose log is named by the time and ``kind``, and holds robot.yaml, calibration and what is attached.

    options: others of ``ControlOptions``. Raises RefusedError when it does not start.
    """
    log_folder.mkdir(parents=True, exist_ok=True)
    chosen = process.ControlOptions(
        log_folder=str(log_folder),
        log_name=f"{time.strftime('%Y%m%d-%H%M%S')}{kind}",
        attachments=(
            *(() if robot_yaml is None else (("robot.yaml", robot_yaml),)),
            ("calibration.yaml", robots.to_yaml(config.calibration)),
            *attached,
        ),
        contract=contract,
        **options,
    )
    session = ControlSession(config, chosen, console)
    for line in session.report:
        console.print(f"  {line}")
    return session


def _wait_for(pipe: Connection, kind: type[Wanted], seconds: float) -> Wanted:
    """The next message of that kind; others are dropped. Raises RefusedError for ``Failed``, TimeoutError."""
    end = time.monotonic() + seconds
    while pipe.poll(max(end - time.monotonic(), 0.0)):
        message = pipe.recv()
        if isinstance(message, kind):
            return message
        if isinstance(message, messages.Failed):
            raise RefusedError(message.sentence)
    raise TimeoutError(f"the control process sent no {kind.__name__} within {seconds:g} s")
