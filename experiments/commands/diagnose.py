"""``mjx-tt diagnose``: logs in; verdict.json, extended.yaml, report.html and plots out."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from experiments import options
from experiments.commands import command
from experiments.errors import ConfigError, error_context
from experiments.options import argument, option
from experiments.progress import make_console
from experiments.runs.run_dir import Run
from robot_io.contract import Contract

if TYPE_CHECKING:
    from experiments.runs.load_policy import TrainedPolicy
    from mjx_tt import diagnosis
    from mjx_tt.diagnosis.report import Play, Rate
    from mjx_tt.robot.robots import Robot


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Request:
    """What is judged, and how."""

    out: Annotated[Path, option("DIR", "where report, verdict and extended model go")]
    model: Annotated[str | None, option("YAML", "the model to judge (default: the nominal one)")] = None
    spin: Annotated[
        Literal["auto", "none", "free"],
        Parameter(help="whether balls may spin (auto: free where the model has a Magnus force, else a possible cause)"),
    ] = "auto"
    without: Annotated[tuple[str, ...], option("NAMES", "effects to leave out of the catalogue")] = ()
    home: Annotated[str, option("POSE", "pose before the first motion: home, or joint_1=0.52,gantry_x=0 [rad, m]")] = ""
    randomise: Annotated[bool, Parameter(help="randomise in extended.yaml what the logs do not determine")] = False
    seed: Annotated[int, Parameter(help="seed of the bootstrap (default: 0)", validator=Number(gte=0))] = 0
    policy: Annotated[str | None, option("POLICY", "a run or artefact: measure what the defect costs in play")] = None
    robot: Annotated[str | None, option("FOLDER", "robot whose joints were logged (default: the paper's)")] = None
    retrain: Annotated[
        int, option("UPDATES", "with --policy: retrain for so many updates under the extended model", Number(gte=0))
    ] = 0
    episodes: Annotated[int, Parameter(help="balls of each evaluation (default: 2000)")] = 2000
    tracks: options.TrackFileOptions = options.TRACKS

    def load_robot(self) -> Robot:
        """The robot whose joints were logged. Raises ConfigError."""
        from mjx_tt.robot import robots

        with error_context("--robot"):
            return robots.paper() if self.robot is None else robots.load(self.robot)


@command(
    "diagnose",
    """\
  mjx-tt diagnose session1.csv session2.mcap --out diagnosis
  mjx-tt diagnose robot/ --out diagnosis                    a folder with command.csv and state.csv
  mjx-tt diagnose robot/ --home home --out diagnosis        and the encoders' zeros: it began to move at home
  mjx-tt diagnose session1.csv --policy runs/quickstart --out diagnosis          what the defect costs in play
  mjx-tt train my.yaml --set model=diagnosis/extended.yaml                       train with what was found

Writes report.html (look at it first), verdict.json, extended.yaml and plots. Ball logs: tracks as
CSV, JSON, NumPy, Parquet, MCAP, ROS bag or the launcher's HDF5; robot logs: command.csv (t,joint,velocity) and
state.csv (t,joint,position).
""",
)
def diagnose(*logs: Annotated[str, argument("LOG", "a file, or a folder of files")], request: Request) -> None:
    """Finds what the simulation gets wrong about measured logs."""
    options.start_jax()
    from experiments.runs.load_policy import load
    from mjx_tt.diagnosis import report

    # What would fail after the work is refused at once.
    if request.retrain and request.policy is None:
        raise ConfigError("--retrain needs --policy: the run or artefact that is to be trained on")
    if request.policy is not None:
        options.PLAY.experiment(load(request.policy))
    robot = request.load_robot()
    resting_pose(request.home, robot)
    options.check_writable(request.out)
    screen, folder = make_console(), request.out
    found = run(logs, request, screen)
    folder.mkdir(parents=True, exist_ok=True)
    found.verdict.save(folder / "verdict.json")
    found.extended.save(folder / "extended.yaml")
    if found.balls is not None and found.balls.spins is not None:
        found.balls.spins.save(folder / "spins.csv")
    show(found, screen, robot.contract)
    cost = play(folder / "extended.yaml", request, screen) if request.policy else None
    report.write_report(folder, found, ", ".join(Path(p).name for p in logs), cost)
    for name in ("report.html", "verdict.json", "extended.yaml", "spins.csv"):
        if (folder / name).exists():
            screen.print(f"  {folder / name}")


def resting_pose(text: str, robot: Robot) -> dict[str, float]:
    """Positions [rad], [m] by joint: the robot's home pose, or pairs joint=position. Raises ConfigError."""
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


def read_logs(
    paths: Sequence[str], robot: Robot | None = None, tracks: options.TrackFileOptions = options.TRACKS
) -> diagnosis.Logs:
    """Logs of balls and joints, sessions at the robot among them. robot: whose joints; None: the paper's.

    Raises ValueError or FileNotFoundError naming the file.
    """
    from experiments.deploy import session_logs
    from mjx_tt import diagnosis

    files = diagnosis.hashes(paths)
    sessions = [f for f in files if session_logs.is_session(f)]
    others = [f for f in files if f not in sessions]
    if not sessions:
        return diagnosis.load_logs(paths, robot, tracks.load(), tracks.frame)
    rest = diagnosis.load_logs(others, robot, tracks.load(), tracks.frame) if others else diagnosis.Logs((), (), {})
    balls, records = list(rest.balls), [("the CSV files", rest.joints)] if rest.joints else []
    for file in sessions:
        flights, joints = session_logs.load(file, robot)
        if diagnosis.align(flights, str(file))[1]:  # its frame is the robot's, which no log may change
            raise ValueError(f"{file}: the balls do not bounce on the robot's table; calibrate the tracker")
        balls += flights
        if joints:
            records.append((str(file), joints))
    joints, notes = diagnosis.longest(records)
    return diagnosis.Logs(
        tuple(balls), joints, {str(file): digest for file, digest in files.items()}, rest.notes + notes
    )


def run(logs: Sequence[str], request: Request, console: Console) -> diagnosis.Diagnosis:
    """Runs the diagnosis. Raises ConfigError for bad logs."""
    from experiments.config import build
    from mjx_tt import diagnosis
    from mjx_tt.sim.model import ModelFile

    robot = request.load_robot()
    nominal = ModelFile(build.nominal_model(robot))
    if request.model:
        with error_context("--model"):
            nominal = ModelFile.load(request.model, nominal.model)
    with error_context():
        found = read_logs(logs, robot, request.tracks)
    home = resting_pose(request.home, robot)
    if home and not found.joints:
        raise ConfigError(f"--home {request.home}: the logs hold no joints")
    console.print(f"{len(found.balls)} trajectories, {len(found.joints)} joints from {', '.join(logs)}")
    began = time.perf_counter()

    def say(text: str) -> None:
        console.print(f"  {time.perf_counter() - began:5.1f} s  {text}")

    provenance = {
        "made_by": "mjx-tt diagnose",
        "model": request.model or "nominal",
        "seed": request.seed,
        "spin": request.spin,
    } | ({} if request.robot is None else {"robot": robot.name})
    if request.model:
        provenance["model_sha256"] = hashlib.sha256(Path(request.model).read_bytes()).hexdigest()
    with error_context(", ".join(logs)):
        return diagnosis.diagnose(
            found,
            nominal.model,
            request.spin,
            tuple(name for part in request.without for name in part.split(",") if name),
            request.seed,
            say,
            provenance,
            request.randomise,
            home,
        )


def play(extended: Path, request: Request, console: Console) -> Play:
    """Cost of the defect to the policy: return rates with 95 % intervals under the nominal and the extended model.

    extended: the model file that was written, under which the policy is trained on for ``request.retrain`` updates; the
    run of that training is kept beside the model file.
    """
    from experiments.config import build
    from experiments.evaluation import evaluate
    from experiments.runs.load_policy import load
    from experiments.training import loop

    folder = str(request.policy)
    trained = load(folder)
    config = options.PLAY.experiment(trained).config

    def rate(name: str, who: TrainedPolicy, model: str | None) -> Rate:
        experiment = options.PlayOptions(model=model).experiment(trained)
        found = evaluate.evaluate(experiment, who, request.episodes, config.evaluation.seed, None).report
        console.print(
            f"  {name}: {found['return_rate']:.1%} of {found['episodes']} balls returned "
            f"({found['low']:.1%} to {found['high']:.1%})"
        )
        return {"rate": found["return_rate"], "low": found["low"], "high": found["high"]}

    rates: Play = {
        "nominal": rate("nominal model", trained, request.model),
        "extended": rate("extended model", trained, str(extended)),
        "retrained": None,
        "balls": request.episodes,
    }
    if request.retrain:
        training = config.training.model_copy(update={"updates": request.retrain, "later_rewards": None})
        later = config.model_copy(
            update={"model": str(extended), "initial_policy": folder, "training": training, "name": "retrained"}
        )
        retrained = Run(extended.parent / "retrained")
        loop.train(build.experiment(later, folder), retrained, console)
        rates["retrained"] = rate("retrained", load(retrained.folder), str(extended))
    return rates


def show(found: diagnosis.Diagnosis, console: Console, contract: Contract) -> None:
    """Prints the verdict in a few lines; contract: of the robot that was logged."""
    from mjx_tt.diagnosis.report import text

    v, units = found.verdict, dict(zip(contract.joints, contract.units, strict=True))
    console.print(f"verdict: {v.verdict}", style="bold")
    for warning in v.warnings:
        console.print(f"  note: {warning}")
    for c in v.causes:
        unit = next((f"m{units[joint]}" for joint in units if c.name.startswith(f"{joint}.")), "mrad")
        size = f"{unit} rms" if "." in c.name else "mm at the end of a flight"
        console.print(f"  {c.name}: {c.effect_mm:.1f} {size}, confidence {c.confidence:.0%}")
        for path, e in c.parameters.items():
            interval = f"({e.low:.6g} to {e.high:.6g}) {e.unit}"
            console.print(f"    {path} {e.nominal:.6g} -> {e.estimate:.6g} {interval}")
        if len(c.group) > 1:
            console.print(f"    cannot be told from {', '.join(c.group[1:])}: {c.separating_measurement}")
    if v.unexplained:
        u = v.unexplained
        console.print(f"  no entry of the catalogue explains: {u.block}, {u.where}, along {u.direction}, {u.size}")
    if v.held_out:
        h = v.held_out
        console.print(f"  held out: {h.before:.2f} -> {h.after:.2f} mm, gain {h.low:.2f} to {h.high:.2f}")
    steps = v.next_experiment[:2]
    common, own = text.advice(steps)
    for step, tells in zip(steps, own, strict=True):
        beside = f" {'also ' if common else ''}tells {tells}" if tells else ""
        console.print(f"  next: {step.what}{beside}")
    if common:
        console.print(f"  each of these tells {common}")
