"""``mjx-tt robot commission`` on a real or an emulated robot: its sessions."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy.commission import SCALE, WAIT, Commissioning, NotProven, Record, Terminal, take
from experiments.deploy.control_session import ControlSession, start_session
from experiments.deploy.rig import box_of
from experiments.errors import ConfigError
from robot_io.contract import Contract
from robot_io.control import messages
from robot_io.control.config import RobotConfig
from robot_io.policy import artefact as artefacts


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
    operator: Terminal,
    log_folder: Path,
    console: Console,
    policy: Path | None,
    contract: Contract,
) -> int:
    """As ``commission``, with the parts that an emulated robot replaces."""
    scale = min(config.safety.speed_scale, SCALE)
    config = replace(config, safety=replace(config.safety, speed_scale=scale))
    with _start(config, contract, log_folder, console) as session:

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


def _start(
    config: RobotConfig, contract: Contract, log_folder: Path, console: Console, policy: Path | None = None
) -> ControlSession:
    """A control process that jogs; with a policy, one that plays."""
    if policy is None:
        return start_session(config, contract, log_folder, console, "-commission", jog=True)
    box = box_of(artefacts.load(policy))
    return start_session(config, contract, log_folder, console, "-commission-play", artefact=str(policy), box=box)


def _first_ball(
    config: RobotConfig, contract: Contract, operator: Terminal, log_folder: Path, console: Console, policy: Path
) -> str:
    """Play one ball with the policy at the low speed. Raises NotProven."""
    with _start(config, contract, log_folder, console, policy) as session:
        operator.do("switch_on", "start the arm's RAPID program again: EGM ended with the session before")
        session.prepare(None)
        operator.do("throw", "throw balls one by one from the player's end: three are watched, then the robot is armed")
        _wait_for_balls(session)
        session.send(messages.Arm())  # so slow a robot is rarely at its home pose between two balls
        played = take(session, lambda m: isinstance(m, messages.Played), 2.0 * WAIT)
        if played is None:
            raise NotProven("no ball was played")
        operator.do("stop_throwing", "throw no more balls")
        if played.summary.fault:
            raise NotProven(f"the first ball ended in the fault {played.summary.fault}")
        share = 100 * config.safety.speed_scale
        return f"the first ball was played at {share:.0f} %: {played.summary.outcome}"


def _wait_for_balls(session: ControlSession) -> None:
    """Until balls have shown the tracker's frame. Raises NotProven with what is not shown."""
    end = time.monotonic() + 2.0 * WAIT
    while time.monotonic() < end:
        for message in session.messages(0.1):
            if isinstance(message, messages.Status) and not message.unproven:
                return
    lacks = "no status" if (s := session.status) is None else f"{s.unproven} {s.shown} were seen"
    raise NotProven(f"waited {2.0 * WAIT:g} s for balls: {lacks}")
