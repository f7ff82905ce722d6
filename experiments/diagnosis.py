"""``mjx-tt diagnose``: logs in; verdict.json, extended.yaml, report.html and plots out."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from experiments import build, evaluate, policy, session_logs, train
from experiments.errors import ConfigError, checked
from experiments.runs import Run
from mjx_tt import gap, model
from mjx_tt.gap import report
from mjx_tt.model import ModelFile


@dataclass(frozen=True)
class Request:
    """What was asked for on the command line."""

    logs: Sequence[str]
    out: Path
    model: str | None = None
    spin: str = "none"
    without: Sequence[str] = ()
    seed: int = 0
    randomise: bool = False


def read_logs(paths: Sequence[str]) -> gap.Logs:
    """Logs of balls and joints, sessions at the robot among them. Raises ValueError or FileNotFoundError naming the file."""
    files = [f for path in map(Path, paths) for f in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])]
    sessions = [f for f in files if session_logs.is_session(f)]
    others = [p for p in paths if Path(p) not in sessions and not (Path(p).is_dir() and sessions)]
    if not sessions:
        return gap.load(paths)
    rest = gap.load(others) if others else gap.Logs((), (), {})
    balls, joints, sources = list(rest.balls), list(rest.joints), dict(rest.sources)
    for file in sessions:
        flights, records = session_logs.load(file)
        gap.check(flights, str(file))
        balls += flights
        # One record a joint: of several sessions the longest tells most.
        if records and (not joints or records[0].state_time.size > joints[0].state_time.size):
            joints = list(records)
        sources[str(file)] = hashlib.sha256(file.read_bytes()).hexdigest()
    return gap.Logs(tuple(balls), tuple(joints), sources)


def diagnose(request: Request, console: Console) -> gap.Diagnosis:
    """Runs the diagnosis and writes its files. Raises ConfigError for bad logs before anything is written."""
    nominal = checked("", model.load, request.model) if request.model else ModelFile(model.SimModel())
    logs = checked("", read_logs, request.logs)
    balls, joints = len(logs.balls), len(logs.joints)
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
    }
    if request.model:
        provenance["model_sha256"] = hashlib.sha256(Path(request.model).read_bytes()).hexdigest()
    return checked(
        ", ".join(request.logs), gap.diagnose, logs, nominal.model, request.spin, tuple(request.without), request.seed, say,
        provenance, request.randomise,
    )  # fmt: skip


def play(
    extended: Path, request: Request, folder: str, retrain: int, episodes: int, console: Console
) -> dict[str, dict | int | None]:
    """What the defect costs a policy: return rates with 95 % intervals under the nominal and the extended model.

    extended: the model file that was written. retrain: updates of training under it, from the policy on; 0 for none.
    The run of that training is kept beside the model file. Raises ConfigError for a policy that does not say how it was
    trained.
    """
    trained = policy.load(folder)
    if trained.config is None:
        raise ConfigError(f"{folder}: does not say how it was trained; give the run that it came from")
    nominal = {"model": request.model} if request.model else {}

    def rate(name: str, who: policy.Policy, changes: dict) -> dict[str, float]:
        experiment = build.experiment(trained.config.model_copy(update=changes | {"initial_policy": None}), folder)
        report = evaluate.evaluate(experiment, who, episodes, trained.config.evaluation.seed, None).report
        console.print(
            f"  {name}: {report['return_rate']:.1%} of {report['episodes']} balls returned "
            f"({report['low']:.1%} to {report['high']:.1%})", highlight=False,
        )  # fmt: skip
        return {"rate": report["return_rate"], "low": report["low"], "high": report["high"]}

    rates = {
        "nominal": rate("nominal model", trained, nominal),
        "extended": rate("extended model", trained, {"model": str(extended)}),
        "retrained": None,
    }
    if retrain:
        training = trained.config.training.model_copy(update={"updates": retrain, "later_rewards": None})
        config = trained.config.model_copy(
            update={"model": str(extended), "initial_policy": folder, "training": training, "name": "retrained"}
        )
        run = Run(extended.parent / "retrained")
        train.train(build.experiment(config, folder), run, console)
        rates["retrained"] = rate("retrained", policy.load(run.folder), {"model": str(extended)})
    return {"balls": episodes, **rates}


def save(found: gap.Diagnosis, folder: Path) -> Path:
    """Writes verdict.json and extended.yaml; returns the path of the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    found.verdict.save(folder / "verdict.json")
    model.save(folder / "extended.yaml", found.extended)
    return folder / "extended.yaml"


def draw(found: gap.Diagnosis, folder: Path, title: str, console: Console, cost: dict | None = None) -> None:
    """Writes report.html and its pictures, and says where everything is."""
    report.write(folder, found, title, cost)
    for name in ("report.html", "verdict.json", "extended.yaml"):
        console.print(f"  {folder / name}", highlight=False)


def show(found: gap.Diagnosis, console: Console) -> None:
    """The answer in a few lines."""
    v = found.verdict
    console.print(f"verdict: {v.verdict}", style="bold")
    for c in v.causes:
        unit = "mm" if c.name.startswith("gantry") else "mrad"
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
    for e in v.next_experiment[:2]:
        console.print(f"  next: {e.what}{' tells ' + ', '.join(e.separates) if e.separates else ''}", highlight=False)
