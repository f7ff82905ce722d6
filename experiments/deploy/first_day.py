"""``mjx-tt robot commission`` on a real or an emulated robot: its sessions, and the person at the terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.prompt import Prompt

from experiments.config import robot as robots
from experiments.deploy.commission import SCALE, WAIT, Commissioning, NotProven, Operator, Record
from experiments.deploy.control_session import ControlSession
from experiments.deploy.rig import box_of
from experiments.errors import ConfigError
from robot_io.contract import Contract
from robot_io.control import messages, process
from robot_io.control.config import RobotConfig
from robot_io.policy import artefact as artefacts


class Terminal:
    """The person at the terminal. While a question waits nothing is armed that moves: silence disarms."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def ask(self, key: str, question: str) -> str:
        return Prompt.ask(question, console=self._console)

    def do(self, key: str, instruction: str) -> None:
        Prompt.ask(f"{instruction}; then press Enter", console=self._console, default="", show_default=False)

    def say(self, text: str) -> None:
        self._console.print(text)


def commission(robot: Path, log_folder: Path, console: Console, policy: Path | None, name: str | None = None) -> int:
    """Every step that is not proven yet; returns the exit status, 1 where one was not proven. Raises ConfigError."""
    contract = robots.standing(robot)
    if name is not None:
        raise ConfigError(f"robot {name}: commission takes the robot that {robot} names")
    if policy is not None:
        artefacts.check_robot(policy, artefacts.load(policy).contract, contract)
    config = robots.load_robot(robot, contract=contract)
    return run(config, Record.of(robot), Terminal(console), log_folder, console, policy, contract)


def run(
    config: RobotConfig,
    record: Record,
    operator: Operator,
    log_folder: Path,
    console: Console,
    policy: Path | None,
    contract: Contract,
) -> int:
    """As ``commission``, with the parts that an emulated robot replaces."""
    scale = min(config.safety.speed_scale, SCALE)
    config = replace(config, safety=replace(config.safety, speed_scale=scale))
    log_folder.mkdir(parents=True, exist_ok=True)
    with _session(config, contract, log_folder, console) as session:

        def play() -> str:
            session.close()
            if policy is None:
                raise NotProven("no policy is given: --artefact")
            return _first_ball(config, contract, operator, log_folder, console, policy)

        try:
            Commissioning(session, operator, config, record, contract, play).run()
        except NotProven as error:
            console.print(f"not proven: {error}", style="red")
            return 1
    console.print(f"commissioned; {record.path} has what was proven")
    return 0


@contextmanager
def _session(
    config: RobotConfig, contract: Contract, log_folder: Path, console: Console, policy: Path | None = None
) -> Iterator[ControlSession]:
    """A control process that jogs; with a policy, one that plays."""
    box = None if policy is None else box_of(artefacts.load(policy))
    options = process.ControlOptions(
        None if policy is None else str(policy),
        log_folder=str(log_folder),
        log_name=f"{time.strftime('%Y%m%d-%H%M%S')}-commission{'' if policy is None else '-play'}",
        attachments=(("calibration.yaml", robots.to_yaml(config.calibration)),),
        box=box,
        jog=policy is None,
        contract=contract,
    )
    with ControlSession(config, options, console) as session:
        yield session


def _first_ball(
    config: RobotConfig, contract: Contract, operator: Operator, log_folder: Path, console: Console, policy: Path
) -> str:
    """Play one ball with the policy at the low speed. Raises NotProven."""
    with _session(config, contract, log_folder, console, policy) as session:
        operator.do("switch_on", "start the arm's RAPID program again: EGM ended with the session before")
        session.prepare(None)
        operator.do("throw", "throw balls one by one from the player's end: three are watched, then the robot is armed")
        _wait_for_balls(session)
        session.send(messages.Arm())  # so slow a robot is rarely at its home pose between two balls
        end = time.monotonic() + 2.0 * WAIT
        while time.monotonic() < end:
            for message in session.messages(0.1):
                if isinstance(message, messages.Refused):
                    raise message.error
                if isinstance(message, messages.Played):
                    operator.do("stop_throwing", "throw no more balls")
                    if message.summary.fault:
                        raise NotProven(f"the first ball ended in the fault {message.summary.fault}")
                    share = 100 * config.safety.speed_scale
                    return f"the first ball was played at {share:.0f} %: {message.summary.outcome}"
    raise NotProven("no ball was played")


def _wait_for_balls(session: ControlSession) -> None:
    """Until balls have shown the tracker's frame. Raises NotProven with what is not shown."""
    end, lacks = time.monotonic() + 2.0 * WAIT, "no status"
    while time.monotonic() < end:
        for message in session.messages(0.1):
            if isinstance(message, messages.Status):
                if not message.unproven:
                    return
                lacks = f"{message.unproven} {message.shown} were seen"
    raise NotProven(f"waited {2.0 * WAIT:g} s for balls: {lacks}")
