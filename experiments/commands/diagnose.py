"""``mjx-tt diagnose``: logs in; verdict.json, extended.yaml, report.html and plots out."""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from experiments.config import build
from experiments.deploy import session_logs
from experiments.errors import ConfigError, checked
from experiments.evaluation import evaluate
from experiments.runs.load_policy import TrainedPolicy, load
from experiments.runs.run_dir import Run
from experiments.training import loop
from mjx_tt import diagnosis
from mjx_tt.diagnosis import report
from mjx_tt.diagnosis.report import Play, Rate, text
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import ModelFile
from robot_io.contract import PAPER, Contract


@dataclass(frozen=True)
class Request:
    """Arguments of the command line."""

    logs: Sequence[str]
    out: Path
    model: str | None = None
    spin: str = "auto"
    without: Sequence[str] = ()
    seed: int = 0
    randomise: bool = False
    policy: str | None = None
    retrain: int = 0
    home: str = ""
    robot: str | None = None  # another one than the paper's

    def the_robot(self) -> Robot:
        """The robot whose joints were logged. Raises ConfigError."""
        return robots.paper() if self.robot is None else checked("--robot", robots.load, self.robot)

    def check(self) -> None:
        """Refuses at once a request that would fail after the work. Raises ConfigError."""
        if self.seed < 0:
            raise ConfigError(f"--seed {self.seed}: a whole number from 0 on is wanted")
        if self.retrain and self.policy is None:
            raise ConfigError("--retrain needs --policy: the run or artefact that is to be trained on")
        if self.retrain < 0:
            raise ConfigError(f"--retrain {self.retrain}: a number of updates is wanted")
        if self.policy is not None and load(self.policy).config is None:
            raise ConfigError(f"{self.policy}: does not say how it was trained; give the run that it came from")
        resting_pose(self.home, self.the_robot())
        existing = next(p for p in (self.out, *self.out.absolute().parents) if p.exists())
        if not existing.is_dir():
            raise ConfigError(f"--out {self.out}: {existing} is a file, a folder is wanted")
        if not os.access(existing, os.W_OK):
            raise ConfigError(f"--out {self.out}: {existing} cannot be written to")


def resting_pose(text: str, robot: Robot | None = None) -> dict[str, float]:
    """Positions [rad], [m] by joint: the robot's home pose, or pairs joint=position. Raises ConfigError."""
    robot = robots.paper() if robot is None else robot
    joints = robot.contract.joints
    if text in ("", "home"):
        return dict(zip(joints, robot.home.tolist(), strict=True)) if text else {}
    pose = {}
    for pair in text.split(","):
        joint, _, value = pair.partition("=")
        if joint not in joints:
            raise ConfigError(f"--home {text}: no joint {joint!r}; there are {', '.join(joints)}, or home for all")
        if joint in pose:
            raise ConfigError(f"--home {text}: {joint} is given twice; once is allowed")
        try:
            pose[joint] = float(value)
        except ValueError:
            pose[joint] = math.nan
        if not math.isfinite(pose[joint]):
            raise ConfigError(f"--home {text}: {joint} at {value!r}; a number is wanted [rad], [m], and a finite one")
    return pose


def read_logs(paths: Sequence[str], robot: Robot | None = None) -> diagnosis.Logs:
    """Logs of balls and joints, sessions at the robot among them. robot: whose joints; None: the paper's.

    Raises ValueError or FileNotFoundError naming the file.
    """
    files = diagnosis.hashes(paths)
    sessions = [f for f in files if session_logs.is_session(f)]
    others = [f for f in files if f not in sessions]
    if not sessions:
        return diagnosis.load_logs(paths, robot)
    rest = diagnosis.load_logs(others, robot) if others else diagnosis.Logs((), (), {})
    balls, records = list(rest.balls), [("the CSV files", rest.joints)] if rest.joints else []
    for file in sessions:
        flights, joints = session_logs.load(file, robot)
        diagnosis.check(flights, str(file))
        balls += flights
        if joints:
            records.append((str(file), joints))
    joints, notes = diagnosis.longest(records)
    return diagnosis.Logs(
        tuple(balls), joints, {str(file): digest for file, digest in files.items()}, rest.notes + notes
    )


def diagnose(request: Request, console: Console) -> diagnosis.Diagnosis:
    """Runs the diagnosis and writes its files. Raises ConfigError for bad logs before anything is written."""
    request.check()
    robot = request.the_robot()
    nominal = ModelFile(build.nominal_model(robot))
    if request.model:
        nominal = checked("--model", ModelFile.load, request.model, nominal.model)
    logs = checked("", read_logs, request.logs, robot)
    balls, joints = len(logs.balls), len(logs.joints)
    home = resting_pose(request.home, robot)
    if home and not joints:
        raise ConfigError(f"--home {request.home}: the logs hold no joints")
    console.print(
        f"{balls} trajectories, {joints} joints from {', '.join(str(p) for p in request.logs)}", highlight=False
    )
    began = time.perf_counter()

    def say(text: str) -> None:
        console.print(f"  {time.perf_counter() - began:5.1f} s  {text}", highlight=False)

    provenance = {
        "made_by": "mjx-tt diagnose",
        "model": request.model or "nominal",
        "seed": request.seed,
        "spin": request.spin,
    } | ({} if request.robot is None else {"robot": robot.name})
    if request.model:
        provenance["model_sha256"] = hashlib.sha256(Path(request.model).read_bytes()).hexdigest()
    return checked(
        ", ".join(request.logs),
        diagnosis.diagnose,
        logs,
        nominal.model,
        request.spin,
        tuple(request.without),
        request.seed,
        say,
        provenance,
        request.randomise,
        home,
    )


def play(extended: Path, request: Request, episodes: int, console: Console) -> Play | None:
    """Cost of the defect to a policy: return rates with 95 % intervals under the nominal and the extended model.

    None without a policy.

    extended: the model file that was written, under which the policy is trained on for ``request.retrain`` updates; the
    run of that training is kept beside the model file.
    """
    folder = request.policy
    if folder is None:
        return None
    trained = load(folder)
    config = trained.config
    if config is None:
        raise ConfigError(f"{folder}: does not record how it was trained; give the run that it came from")

    def rate(name: str, who: TrainedPolicy, model_path: str | None) -> Rate:
        changes = {"initial_policy": None} | ({"model": model_path} if model_path else {})
        experiment = build.experiment(config.model_copy(update=changes), folder)
        found = evaluate.evaluate(experiment, who, episodes, config.evaluation.seed, None).report
        console.print(
            f"  {name}: {found['return_rate']:.1%} of {found['episodes']} balls returned "
            f"({found['low']:.1%} to {found['high']:.1%})",
            highlight=False,
        )
        return {"rate": found["return_rate"], "low": found["low"], "high": found["high"]}

    rates: Play = {
        "nominal": rate("nominal model", trained, request.model),
        "extended": rate("extended model", trained, str(extended)),
        "retrained": None,
        "balls": episodes,
    }
    if request.retrain:
        training = config.training.model_copy(update={"updates": request.retrain, "later_rewards": None})
        later = config.model_copy(
            update={"model": str(extended), "initial_policy": folder, "training": training, "name": "retrained"}
        )
        run = Run(extended.parent / "retrained")
        loop.train(build.experiment(later, folder), run, console)
        rates["retrained"] = rate("retrained", load(run.folder), str(extended))
    return rates


def save(found: diagnosis.Diagnosis, folder: Path) -> Path:
    """Writes verdict.json and extended.yaml; returns the path of the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    found.verdict.save(folder / "verdict.json")
    found.extended.save(folder / "extended.yaml")
    if found.balls is not None and found.balls.spins is not None:
        found.balls.spins.save(folder / "spins.csv")
    return folder / "extended.yaml"


def draw(found: diagnosis.Diagnosis, folder: Path, title: str, console: Console, cost: Play | None = None) -> None:
    """Writes report.html and its pictures, and prints the paths."""
    report.write_report(folder, found, title, cost)
    for name in ("report.html", "verdict.json", "extended.yaml", "spins.csv"):
        if (folder / name).exists():
            console.print(f"  {folder / name}", highlight=False)


def show(found: diagnosis.Diagnosis, console: Console, contract: Contract = PAPER) -> None:
    """Prints the verdict in a few lines; contract: of the robot that was logged."""
    v, units = found.verdict, dict(zip(contract.joints, contract.units, strict=True))
    console.print(f"verdict: {v.verdict}", style="bold")
    for warning in v.warnings:
        console.print(f"  note: {warning}", highlight=False)
    for c in v.causes:
        unit = next((f"m{units[joint]}" for joint in units if c.name.startswith(f"{joint}.")), "mrad")
        size = f"{unit} rms" if "." in c.name else "mm at the end of a flight"
        console.print(f"  {c.name}: {c.effect_mm:.1f} {size}, confidence {c.confidence:.0%}", highlight=False)
        for path, e in c.parameters.items():
            console.print(
                f"    {path} {e.nominal:.6g} -> {e.estimate:.6g} ({e.low:.6g} to {e.high:.6g}) {e.unit}",
                highlight=False,
            )
        if len(c.group) > 1:
            console.print(
                f"    cannot be told from {', '.join(c.group[1:])}: {c.separating_measurement}", highlight=False
            )
    if v.unexplained:
        u = v.unexplained
        console.print(
            f"  no entry of the catalogue explains: {u.block}, {u.where}, along {u.direction}, {u.size}",
            highlight=False,
        )
    if v.held_out:
        h = v.held_out
        console.print(
            f"  held out: {h.before:.2f} -> {h.after:.2f} mm, gain {h.low:.2f} to {h.high:.2f}", highlight=False
        )
    steps = v.next_experiment[:2]
    common, own = text.advice(steps)
    for step, tells in zip(steps, own, strict=True):
        beside = f" {'also ' if common else ''}tells {tells}" if tells else ""
        console.print(f"  next: {step.what}{beside}", highlight=False)
    if common:
        console.print(f"  each of these tells {common}", highlight=False)
