"""``mjx-tt run``: an exported policy on a robot, real or emulated, through the same bridge."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.config import robot as robots
from experiments.deploy.operator_console import KEYS, PAUSE, QUIT, Keyboard, View
from experiments.deploy.rig import RIG, rig_for
from experiments.runs import run_dir
from experiments.stats import wilson
from robot_io.control import messages, process
from robot_io.control.config import RobotConfig
from robot_io.control.episode import EpisodeSummary
from robot_io.control.messages import FaultReport, Message, Played, Refused, Request, Status
from robot_io.emulator.processes import Rig
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts

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
        self._episodes: deque[Played] = deque()  # that came while an answer was waited for

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

    def messages(self, seconds: float) -> Iterator[Message]:
        """Messages that arrive within that time. Raises RefusedError when the control process has ended."""
        while self._episodes:
            yield self._episodes.popleft()
        yield from self._received(seconds)

    def _answers(self, seconds: float) -> Iterator[Message]:
        """``messages`` without the episodes, which are kept for it."""
        for message in self._received(seconds):
            if isinstance(message, Played):
                self._episodes.append(message)
            else:
                yield message

    def _received(self, seconds: float) -> Iterator[Message]:
        end = time.monotonic() + seconds
        while self.pipe.poll(max(end - time.monotonic(), 0.0)):
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
                    raise RefusedError(message.sentence)
                if isinstance(message, Status):
                    yield message

    def prepare(self, rig: Rig | None) -> None:
        """Switch the axes on and home them, on the rig the arm too, until nothing is missing. Raises RefusedError."""
        if rig is not None:
            rig.switch_on()
        end, refusal, again = time.monotonic() + PREPARE_TIME, "", True
        while time.monotonic() < end:
            if again:
                self.send(messages.Prepare())
            again = False
            for message in self._answers(0.3):
                if isinstance(message, Status) and not message.missing:
                    return
                if isinstance(message, Refused):  # until the arm has sent its position, or an axis has answered
                    refusal, again = f"; {message.sentence}", True
        missing = "no status" if self.status is None else self.status.missing
        raise RefusedError(f"the robot does not get ready within {PREPARE_TIME:g} s: {missing}{refusal}")

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
                self.arm()
                return
            except RefusedError:  # a busy machine may be late again: a new fault, or a condition that is over by now
                if attempt == RECOVERIES - 1 or not self.process.is_alive():
                    raise

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
) -> int:
    """Play until ``balls`` outcomes are known, ``seconds`` have passed, or the operator quits; the exit status.

    0: all went well, 1: it ended early, 130: the operator ended it with Ctrl-C; the summary is written in any case.
    """
    loaded = artefacts.load(artefact)
    with ExitStack() as stack:
        rig = None
        if robot == RIG:
            console.print("starting the rig ...", highlight=False)
            rig = stack.enter_context(rig_for(loaded, distribution, rig_params, seed))
            config, text = rig.robot, robots.to_yaml(rig.robot)
        else:
            config = robots.load_robot(robot)
            text = Path(robot).read_text(encoding="utf-8")
        name = time.strftime("%Y%m%d-%H%M%S")
        git = run_dir.git_state()
        options = process.ControlOptions(
            str(artefact), backend, str(log_folder), name, (("git", json.dumps(git)),), (("robot.yaml", text),)
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
        episodes: list[EpisodeSummary] = []
        faults: list[FaultReport] = []
        try:
            with Keyboard() as keyboard, View(console, f"{artefact} on {config.name}") as view:
                problem = _watch(session, rig, keyboard, view, balls, seconds, console, episodes, faults)
            status = 1 if problem else 0
        except KeyboardInterrupt:
            status, problem = INTERRUPTED, "stopped by Ctrl-C"
        session.close()
    summary = _summary(loaded, config, episodes, session, process.log_path(options))
    summary["faults"] = [asdict(fault) for fault in faults]
    run_dir.write_json(log_folder / f"{name}.json", summary)
    _print(console, summary, log_folder / f"{name}.json")
    if problem:
        console.print(problem, style="red", highlight=False)
    return status


def _watch(
    session: Session,
    rig: Rig | None,
    keyboard: Keyboard,
    view: View,
    balls: int | None,
    seconds: float | None,
    console: Console,
    episodes: list[EpisodeSummary],
    faults: list[FaultReport],
) -> str | None:
    """Play, adding the episodes played and the faults after which the rig was brought back; why it ended early."""
    in_a_row = 0
    end = time.monotonic() + (float("inf") if seconds is None else seconds)
    heard = time.monotonic()
    while time.monotonic() < end and (balls is None or len(episodes) < balls):
        for message in session.messages(0.1):
            view.take(message)
            if isinstance(message, Played):
                heard = time.monotonic()
                episodes.append(message.summary)
                in_a_row = in_a_row if message.summary.fault else 0
                if not console.is_terminal:
                    console.print(f"ball {len(episodes)}: {message.summary.outcome}", highlight=False)
        key = keyboard.pressed()
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
            if session.status and session.status.faults:
                fault, in_a_row = session.status.faults[0], in_a_row + 1
                text = f"{fault.cause}: {fault.text}"
                if in_a_row > RECOVERIES:
                    return f"stopped by {in_a_row} faults in a row, the last: {text}"
                faults.append(fault)
                console.print(f"fault, reset and resumed: {text}", style="red", highlight=False)
                try:
                    session.recover(rig)
                except RefusedError as error:
                    return f"not brought back after {text}: {error}"
            if time.monotonic() - heard > QUIET:
                return f"no ball was played for {QUIET:g} s"
    return None


def _summary(
    loaded: artefacts.Artefact,
    config: RobotConfig,
    episodes: list[EpisodeSummary],
    session: Session,
    log_file: Path | None,
) -> dict[str, Any]:
    returned = sum(e.outcome == "returned" for e in episodes)
    hit = sum(e.outcome != "missed" for e in episodes)
    report: dict[str, Any] = {
        "artefact": str(loaded.folder),
        "artefact_sha256": loaded.digest,
        "robot": config.name,
        "episodes": len(episodes),
        "returned": returned,
        "hit": hit,
    }
    if episodes:
        low, high = wilson(returned, len(episodes))
        report |= {"return_rate": returned / len(episodes), "low": low, "high": high, "hit_rate": hit / len(episodes)}
    evaluation = (loaded.manifest.get("provenance") or {}).get("evaluation")
    if evaluation:
        report["simulation"] = {k: evaluation[k] for k in ("return_rate", "low", "high", "episodes")}
        report["simulation"]["balls"] = evaluation["balls"]["name"]
    status = session.status
    report["timings"] = session.timings or (status.timings if status else {})
    report["egm"] = status.egm if status else {}
    report |= {k: getattr(status, k, None) for k in ("axes_cycles", "axes_late", "tracker_counts", "log_dropped")}
    report["log"] = None if log_file is None else str(log_file)
    return report


def _print(console: Console, report: dict[str, Any], path: Path) -> None:
    table = Table(title=f"{report['artefact']} on {report['robot']}", title_justify="left", show_header=False)
    if report["episodes"]:
        text = f"{report['return_rate']:.1%}  ({report['returned']} of {report['episodes']}, 95 % interval "
        table.add_row("return rate", text + f"{report['low']:.1%} to {report['high']:.1%})", style="bold")
    if "simulation" in report:
        s = report["simulation"]
        table.add_row(
            "in simulation",
            f"{s['return_rate']:.1%}  ({s['episodes']:,} balls of {s['balls']}, {s['low']:.1%} to {s['high']:.1%})",
        )
    for name, t in report["timings"].items():
        if isinstance(t, dict):
            table.add_row(
                f"{name}, ms",
                f"p50 {t['p50_ms']:.3f}   p99 {t['p99_ms']:.3f}   p99.9 {t['p99.9_ms']:.3f}   max {t['max_ms']:.3f}",
            )
    if report["faults"]:
        table.add_row("faults, reset", ", ".join(fault["cause"] for fault in report["faults"]))
    table.add_row("ticks missed", str(report["timings"].get("missed_ticks", 0)))
    if report["egm"]:
        egm = report["egm"]
        table.add_row("EGM", f"{egm['accepted']:,} packets, {egm['replies']:,} answers, {egm['lost']:,} lost")
    if report["axes_cycles"] is not None:
        table.add_row("linear axes", f"{report['axes_cycles']:,} exchanges, {report['axes_late']:,} late")
    console.print(table)
    for name, value in {"summary": path, "log": report["log"]}.items():
        if value:
            console.print(f"  {name:<11}{value}", highlight=False, soft_wrap=True)
