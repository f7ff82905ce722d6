"""``mjx-tt run`` and ``mjx-tt rig``: an exported policy on a robot, real or emulated, through the same bridge."""

from __future__ import annotations

import json
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from experiments.config import robot as robots
from experiments.config.finetuning import FineTuning
from experiments.deploy.operator_console import KEYS, Keyboard, View
from experiments.errors import ConfigError
from experiments.runs import run_dir
from experiments.stats import wilson
from robot_io.control import process
from robot_io.control.config import RobotConfig
from robot_io.emulator.processes import Ports, Rig
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts

RIG, LOCK_STEP = "rig", "lockstep"
THROWS = 4096  # balls that the rig can throw before it begins anew
READY_TIME = 60.0  # [s] for the control process to start
PREPARE_TIME = 40.0  # [s] for the axes to home and the arm to report
RESET_TIME = 5.0  # [s]
SETTLE = 1.0  # [s] for the robot to come to rest after a fault
RECOVERIES = 3  # times in a row that the rig is brought back after a fault before it counts as broken
QUIET = 30.0  # [s] without a ball on the rig, after which something is wrong


def scene() -> str:
    """Path of the robot's MJCF."""
    from importlib import resources

    return str(resources.files("mjx_tt") / "assets" / "scene.xml")


def rig_for(artefact: artefacts.Artefact, balls: str | None, params_path: str | None, seed: int) -> Rig:
    """A rig that throws balls of a distribution: the named one, or that of the policy's training."""
    from experiments.config import build
    from mjx_tt.sim.model import SimModel

    chosen = balls or _trained_on(artefact)
    distribution = build.distribution(chosen, "--distribution")
    throws = robots.throws_of(distribution, SimModel(), THROWS, seed)
    return Rig(scene(), throws, robots.load_rig(params_path))


def _trained_on(artefact: artefacts.Artefact):
    config = (artefact.manifest.get("provenance") or {}).get("config") or {}
    if "balls" not in config:
        raise ConfigError(
            f"{artefact.folder}: does not say on which balls it was trained; name some with --distribution"
        )
    return config["balls"]


class Session:
    """One control process with its console, from start to end; use as a context manager.

    Raises RefusedError when it does not start, with the reason.
    """

    def __init__(self, robot: RobotConfig, options: process.ControlOptions, console: Console) -> None:
        self.console = console
        self.process, self.pipe = process.start(robot, options)
        try:
            _, self.report = process.wait_for(self.pipe, "ready", READY_TIME)
        except (RefusedError, TimeoutError, EOFError) as error:
            self.process.join(2.0)
            self.process.kill()
            raise RefusedError(str(error) or "the control process ended at once") from None
        self.status: dict[str, Any] | None = None
        self.timings: dict[str, Any] = {}
        self._episodes: deque[tuple] = deque()  # that came while an answer was waited for

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc_info) -> None:
        self.close()

    def ask(self, *message) -> None:
        """Sends a request; refusals come as messages."""
        try:
            self.pipe.send(message)
        except OSError:
            pass  # it has ended: the next message says so

    def messages(self, seconds: float):
        """What the control process says within that time. Raises RefusedError when it has ended."""
        while self._episodes:
            yield self._episodes.popleft()
        yield from self._received(seconds)

    def _answers(self, seconds: float):
        """``messages`` without the episodes, which are kept for it."""
        for message in self._received(seconds):
            if message[0] == "episode":
                self._episodes.append(message)
            else:
                yield message

    def _received(self, seconds: float):
        end = time.monotonic() + seconds
        while self.pipe.poll(max(end - time.monotonic(), 0.0)):
            try:
                message = self.pipe.recv()
            except (EOFError, OSError):
                raise RefusedError(f"the control process has ended (status {self.process.exitcode})") from None
            if message[0] == "failed":
                raise RefusedError(f"the control process failed after it had stopped the robot: {message[1]}")
            if message[0] == "status":
                self.status = message[1]
            yield message

    def prepare(self, rig: Rig | None) -> None:
        """Axes on and homed, and on the rig the arm switched on: until nothing is missing. Raises RefusedError."""
        self.ask("prepare")
        if rig is not None:
            rig.switch_on()
        end = time.monotonic() + PREPARE_TIME
        while time.monotonic() < end:
            for message in self._answers(0.3):
                if message[0] == "status" and not (message[1]["arm"] or message[1]["axes"] or message[1]["tracker"]):
                    return
        status = self.status or {}
        missing = "; ".join(f"{k}: {status[k]}" for k in ("arm", "axes", "tracker") if status.get(k))
        raise RefusedError(f"the robot does not get ready within {PREPARE_TIME:g} s: {missing or 'no status'}")

    def reset(self) -> None:
        """Resets a fault and waits until it is gone. Raises RefusedError."""
        self.ask("reset")
        end = time.monotonic() + RESET_TIME
        while time.monotonic() < end:
            for message in self._answers(0.3):
                if message[0] == "refused":
                    raise RefusedError(message[1])
                if message[0] == "status" and not message[1]["faults"]:
                    return
        raise RefusedError("the fault is not reset")

    def arm(self) -> None:
        """Arms and waits for the home pose. Raises RefusedError."""
        self.ask("arm")
        end = time.monotonic() + PREPARE_TIME
        while time.monotonic() < end:
            for message in self._answers(0.3):
                if message[0] == "refused":
                    raise RefusedError(message[1])
                if message[0] == "status" and message[1]["faults"]:
                    raise RefusedError(message[1]["faults"][0]["text"])
                if message[0] == "status" and message[1]["at_home"]:
                    return
        raise RefusedError(f"the robot does not reach its home pose within {PREPARE_TIME:g} s")

    def recover(self, rig: Rig) -> None:
        """What an operator does after a fault, on the rig. Raises RefusedError."""
        time.sleep(SETTLE)
        for _ in self._answers(0.0):  # what was said before: not how things are now
            pass
        self.prepare(rig)
        self.reset()
        self.arm()

    def close(self) -> None:
        """Stops the robot in order, then the process."""
        if self.process.is_alive():
            self.ask("quit")
            try:
                self.timings = process.wait_for(self.pipe, "ended", 10.0)[1]
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
    """Plays until ``balls`` outcomes are known, ``seconds`` have passed, or the operator quits; 0 when all went well."""
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
        with Keyboard() as keyboard, View(console, f"{artefact} on {config.name}") as view:
            episodes, faults, problem = _watch(session, rig, keyboard, view, balls, seconds, console)
        session.close()
    summary = _summary(loaded, config, episodes, session, process.log_path(options)) | {"faults": faults}
    run_dir.write_json(log_folder / f"{name}.json", summary)
    _print(console, summary, log_folder / f"{name}.json")
    if problem:
        console.print(problem, style="red", highlight=False)
    return 1 if problem else 0


def _watch(session: Session, rig: Rig | None, keyboard: Keyboard, view: View, balls, seconds, console):
    """The episodes played, the faults after which the rig was brought back, and why it ended early, or None."""
    episodes: list = []
    faults: list[dict] = []
    in_a_row = 0
    end = time.monotonic() + (float("inf") if seconds is None else seconds)
    heard = time.monotonic()
    paused = False
    while time.monotonic() < end and (balls is None or len(episodes) < balls):
        for message in session.messages(0.1):
            if message[0] == "status":
                view.show(message[1])
            elif message[0] == "episode":
                heard = time.monotonic()
                episodes.append(message[1])
                in_a_row = in_a_row if message[1].fault else 0
                if not console.is_terminal:
                    console.print(f"ball {len(episodes)}: {message[1].outcome}", highlight=False)
            elif message[0] == "refused":
                view.say(message[1])
        key = keyboard.pressed()
        if key in KEYS:
            request = KEYS[key][0]
            if request == "quit":
                break
            paused = not paused if request == "pause" else paused
            session.ask(*((request, paused) if request == "pause" else (request,)))
            view.say(request)
        if rig is not None:
            rig.check()
            status = session.status
            if status and status["faults"]:
                fault, in_a_row = status["faults"][0], in_a_row + 1
                text = f"{fault['cause']}: {fault['text']}"
                if in_a_row > RECOVERIES:
                    return episodes, faults, f"stopped by {in_a_row} faults in a row, the last: {text}"
                faults.append(fault)
                console.print(f"fault, reset and gone on: {text}", style="red", highlight=False)
                try:
                    session.recover(rig)
                except RefusedError as error:
                    return episodes, faults, f"not brought back after {text}: {error}"
            if time.monotonic() - heard > QUIET:
                return episodes, faults, f"no ball was played for {QUIET:g} s"
    return episodes, faults, None


def _summary(loaded, config: RobotConfig, episodes: list, session: Session, log_file) -> dict[str, Any]:
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
    status = session.status or {}
    report |= {"timings": session.timings or status.get("timings", {}), "egm": status.get("egm", {})}
    report |= {k: status.get(k) for k in ("axes_cycles", "axes_late", "tracker_counts", "log_dropped")}
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
    table.add_row("linear axes", f"{report['axes_cycles']:,} exchanges, {report['axes_late']:,} late")
    console.print(table)
    for name, value in {"summary": path, "log": report["log"]}.items():
        if value:
            console.print(f"  {name:<11}{value}", highlight=False, soft_wrap=True)


def finetune(
    source: str,
    settings: FineTuning,
    run: run_dir.Run,
    robot: str,
    distribution: str | None,
    rig_params: str | None,
    backend: str,
    seed: int,
    console: Console,
) -> dict[str, Any] | None:
    """Fine-tunes on a robot, the rig in real time, or the rig in lock-step; None when the operator stopped it."""
    from experiments.finetuning import loop as tuning
    from experiments.finetuning.bridge_robot import BridgeRobot

    experiment = tuning.experiment_of(source, distribution)
    if robot == LOCK_STEP:
        emulated = tuning.lock_step_robot(experiment, robots.load_rig(rig_params), seed)
        return tuning.finetune(source, settings, run, emulated, console, None, experiment)
    run.folder.mkdir(parents=True, exist_ok=True)
    artefact = _artefact_of(source, experiment, run.folder, console)
    loaded = artefacts.load(artefact)
    with ExitStack() as stack:
        emulated = None
        if robot == RIG:
            emulated = stack.enter_context(rig_for(loaded, distribution, rig_params, seed))
        config = emulated.robot if emulated else robots.load_robot(robot)
        text = robots.to_yaml(config)
        name = time.strftime("%Y%m%d-%H%M%S")
        options = process.ControlOptions(
            str(artefact),
            backend,
            str(run.folder),
            name,
            (("git", json.dumps(run_dir.git_state())),),
            (("robot.yaml", text),),
        )
        session = stack.enter_context(Session(config, options, console))
        keyboard, view = (
            stack.enter_context(Keyboard()),
            stack.enter_context(View(console, f"{source} on {config.name}")),
        )
        bridge = BridgeRobot(session, emulated, keyboard, view, config.name)
        if emulated:
            session.prepare(emulated)
            session.arm()
            emulated.throw(True)
        return tuning.finetune(source, settings, run, bridge, console, bridge, experiment)


def _artefact_of(source: str, experiment, folder: Path, console: Console) -> Path:
    """The source itself when it is an artefact; else its policy, exported beside the run."""
    from experiments.runs import load_policy
    from experiments.training import finalize

    if (Path(source) / artefacts.MANIFEST).exists():
        return Path(source)
    target = folder / "start"
    finalize.export_policy(target, load_policy.load(source), experiment, None, console)
    return target


def rig(balls: str, rig_params: str | None, seed: int, ports: tuple[int, ...], out: Path, console: Console) -> int:
    """The rig alone, for a bridge that runs elsewhere; until the operator quits."""
    from experiments.config import build
    from mjx_tt.sim.model import SimModel

    throws = robots.throws_of(build.distribution(balls, "--distribution"), SimModel(), THROWS, seed)
    chosen = Ports(ports[0], ports[1], (ports[2], ports[3]))
    keys = {
        "o": ("switch_on", "switch the arm on"),
        "b": ("throw", "throw balls, or stop"),
        "e": ("motors_off", "emergency stop"),
        "f": ("fault", "drive fault"),
        "c": ("cable", "pull or plug an axis's cable"),
        "t": ("drop_out", "tracker silent for 1 s"),
        "q": ("quit", "end"),
    }
    with Rig(scene(), throws, robots.load_rig(rig_params), chosen) as running, Keyboard() as keyboard:
        out.write_text(robots.to_yaml(running.robot), encoding="utf-8")
        console.print(f"the rig runs; {out} is its robot.yaml: mjx-tt run ARTEFACT --robot {out}", highlight=False)
        console.print("   ".join(f"\\[{k}] {text}" for k, (_, text) in keys.items()), highlight=False)
        throwing, connected = False, True
        while True:
            time.sleep(0.1)
            running.check()
            request = keys.get(keyboard.pressed() or "", ("",))[0]
            if request == "quit":
                return 0
            if request == "throw":
                throwing = not throwing
                running.throw(throwing)
            elif request == "fault":
                running.drive_fault(0, 0x31)
            elif request == "cable":
                connected = not connected
                running.connect_axis(0, connected)
            elif request == "drop_out":
                running.drop_out(1.0)
            elif request:
                getattr(running, request)()
            if request:
                qpos, _ = running.state()
                console.print(f"{request}; {running.thrown} balls thrown; joints {np.round(qpos, 3)}", highlight=False)
