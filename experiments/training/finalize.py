"""Steps after training: evaluation, pictures, artefact, and the lines that name their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.config.build import Experiment
from experiments.evaluation import evaluate, figures, learning_curves, video
from experiments.evaluation.evaluate import Played
from experiments.progress import Stage, print_files, print_stages
from experiments.runs import load_policy, metrics, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import Run
from robot_io import contract
from robot_io.policy import artefact as artefacts
from robot_io.policy import export

EPISODES_SHOWN = 2


def finish(experiment: Experiment, run: Run, console: Console) -> dict[str, Any]:
    """Evaluates, draws and exports the run's policy; evaluation.json, written last, marks the run as done.

    Returns the report. Raises ArtefactError when the policy's exported forms disagree, OSError when the disk refuses.
    """
    trained, evaluation = load_policy.load(run.folder), experiment.config.evaluation
    stage = print_stages(console, str(run.folder))
    played = evaluate.evaluate(
        experiment,
        trained,
        evaluation.episodes,
        evaluation.seed,
        evaluation.reachable_balls,
        stage,
        unknown_balls=evaluation.unknown_worlds,
    )
    with stage("drawing pictures"):
        pictures = figures.draw_evaluation(
            run.plots, played, experiment.task.reward_weights, experiment.task.robot.contract
        )
        title = f"{experiment.config.name}: training on {experiment.distribution.name}"
        rows, marks = metrics.read(run.metrics), learning_curves.changes(experiment)
        pictures.append(learning_curves.draw_training(run.plots / "training.png", rows, title, marks))
    shown = show_episodes(experiment, trained, [run.folder / "episode.png", run.folder / "episode.mp4"], console, stage)
    with stage("exporting and checking the artefact"):
        exported = export_policy(run.artefact, trained, experiment, played.report, console)
    run_dir.write_json(run.evaluation, played.report)
    print_report(console, played.report, str(run.folder))
    files = {
        "evaluation": run.evaluation,
        "pictures": f"{run.plots} ({', '.join(p.name for p in pictures)})",
        "episodes": ", ".join(str(path) for path in shown),
        "artefact": run.artefact if exported else None,
    }
    print_files(console, files)
    return played.report


def show_episodes(
    experiment: Experiment, trained: TrainedPolicy, paths: list[Path], console: Console, stage: Stage
) -> list[Path]:
    """Writes the pictures that this machine can draw; says why where it cannot."""
    with stage("compiling and playing the episodes to be drawn"):
        played = video.record(experiment, trained, EPISODES_SHOWN, experiment.config.evaluation.seed)
    drawn, failed = [], {}
    with stage(f"drawing {' and '.join(path.name for path in paths)}"):
        for path in paths:
            try:
                drawn.append(video.draw(path, played, robot=experiment.task.robot))
            except RuntimeError as error:
                failed[path] = error
    for path, reason in failed.items():
        console.print(f"{path}: not drawn: {reason}")
    return drawn


def export_policy(
    folder: Path, trained: TrainedPolicy, experiment: Experiment, report: dict[str, Any] | None, console: Console
) -> bool:
    """Writes and verifies the artefact; False, with a line that says so, for a policy that the robot cannot run."""
    rate, more = experiment.task.control_rate, ", ".join(experiment.config.task.observations)
    reasons = {
        f"the policy acts at {rate:g} Hz, the robot at {contract.CONTROL_RATE:g} Hz": rate != contract.CONTROL_RATE,
        f"the policy observes {more}, the robot's side computes ball and joints only": bool(more),
    }
    for reason in (text for text, holds in reasons.items() if holds):
        console.print(f"{folder}: not exported: {reason}")
        return False
    provenance = {
        "config": experiment.config.to_dict(),
        "seed": experiment.config.training.seed,
        "git": run_dir.git_state(),
        "update": trained.notes.get("update"),
        "evaluation": report,
    }
    if trained.policy.network is not None:
        console.print(f"{folder}: a network of your own has {artefacts.JAX_EXPORT} and no ONNX file")
    export.write(folder, trained.policy, provenance, overwrite=True, robot=experiment.task.robot.contract)
    return True


def print_report(console: Console, report: dict[str, Any], title: str) -> None:
    """The evaluation as a table."""
    table = Table(title=f"{title} on {report['balls']['name']}", title_justify="left", show_header=False)
    rate = f"{report['return_rate']:.1%}  (95 % interval {report['low']:.1%} to {report['high']:.1%})"
    table.add_row("return rate", rate, style="bold")
    if report["reachable"] is not None:
        bound = report["reachable"]
        text = (
            f"{bound['return_rate']:.1%}  ({bound['balls']} balls, interval {bound['low']:.1%} to {bound['high']:.1%})"
        )
        table.add_row("reachable, at least", text)
    if report.get("unknown_worlds") is not None:
        other = report["unknown_worlds"]
        text = f"{other['return_rate']:.1%}  ({other['episodes']} balls, {other['low']:.1%} to {other['high']:.1%})"
        table.add_row("in unknown worlds", text)
    table.add_row("hit rate", f"{report['hit_rate']:.1%}")
    counts = ", ".join(f"{count:,} {name}" for name, count in report["outcomes"].items())
    table.add_row("episodes", f"{report['episodes']:,}: {counts}; {report['non_finite']} not finite")
    if report["mean_return"] is not None:
        table.add_row("mean return", f"{report['mean_return']:.3f}")
        for name, value in report["terms"].items():
            table.add_row(f"  {name}", f"{value:.3f}")
    console.print(table)


def save_evaluation(folder: Path, played: Played, experiment: Experiment) -> None:
    """evaluation.json and its pictures, in a folder of their own."""
    folder.mkdir(parents=True, exist_ok=True)
    figures.draw_evaluation(folder / "plots", played, experiment.task.reward_weights, experiment.task.robot.contract)
    run_dir.write_json(folder / "evaluation.json", played.report)
