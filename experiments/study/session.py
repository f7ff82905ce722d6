"""One session of a study: looks up what it names, checks that the folder is its own, does the remaining steps.

Most steps are independent: players, seeds, methods. Several processes do them side by side, since one training on all
cores is slower than as many trainings on a core each. The process that was asked decides what is next, marks what is
done and says so; the workers only do what they are told. What a step makes follows from its name alone, so nothing
depends on who does it.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from experiments.config import build
from experiments.config.files import read_yaml
from experiments.config.study import Study, parse
from experiments.errors import ConfigError, RunError, error_context
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import ALONE, Workers
from experiments.runs import run_dir
from experiments.runs.run_dir import Run
from experiments.study import identification
from experiments.study.paths import JOURNAL, REPORT, SESSIONS, SETTINGS
from experiments.study.pipeline import Pipeline, make_config
from experiments.study.schedule import Simulated, list_items
from experiments.study.target_domain import play_on_robot
from experiments.study.workflow import Journal, Step, Waiting, list_unfinished, perform

CHANGEABLE = ("players", "seeds", "simulation.checkpoint_seconds", "simulation.devices")


def run(study: Study, folder: Path, console: Console, workers: Workers = ALONE) -> bool:
    """Does, or goes on with, a study in ``folder``, up to its report; False when it waits for people.

    workers: that do steps which need nothing of each other side by side; alone, this process does them all. Raises
    RunError for a folder of another study, naming the differences, ConfigError for what the study names and is not
    there, and what the steps raise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with Run(folder).locked():
        if not Journal(folder / JOURNAL).steps:  # later on, what is no longer read may be gone
            look_up(study)
        pipeline = Pipeline(study, folder, console)
        _open(study, folder)
        try:
            with run_dir.continuable(folder, "every finished step", "the study"):
                do_steps(study, folder, pipeline.steps(), console, workers)
        except Waiting as waiting:
            console.print(str(waiting), highlight=False, soft_wrap=True, markup=False)
            return False
    console.print(f"report: {folder / REPORT}", highlight=False, soft_wrap=True)
    return True


def look_up(study: Study) -> None:
    """Raises ConfigError for what a study names and is not there, before hours are spent on its first steps."""
    for balls in study.ablation.balls if study.ablation else ():
        build.distribution(balls, "ablation.balls")
    for item in list_items(study, study.players[0]):
        if isinstance(item, Simulated) and item.source is None:
            build.experiment(make_config(study, item, "narrow", None, 0), "simulation")
    if study.identification is not None:
        with error_context("identification"):
            identification.read_prior(study.identification.prior, "prior")
    if study.robot is not None:
        play_on_robot.look_up(study, study.robot)


def _open(study: Study, folder: Path) -> None:
    """Records what the study is and this session, or checks that it is the one that is asked for.

    Where no step is done yet there is nothing that belongs to another study.
    """
    path, sessions = folder / SETTINGS, folder / SESSIONS
    if path.exists() and Journal(folder / JOURNAL).steps:
        recorded = parse(_read(path), str(path))
        changed = run_dir.differences(recorded.to_dict(), study.to_dict(), CHANGEABLE.__contains__, "study")
        if changed:
            raise RunError(f"{folder}: is another study:\n{changed}\nRestore these values or choose another --out")
    run_dir.write_yaml(path, study.to_dict())
    content = _read(sessions) if sessions.exists() else {"sessions": []}
    if not isinstance(content, dict) or not isinstance(content.get("sessions"), list):
        raise RunError(f"{sessions}: holds no list of sessions; restore the file or remove it")
    run_dir.write_json(sessions, {"sessions": [*content["sessions"], run_dir.provenance()]})


def _read(path: Path) -> Any:
    with error_context(str(path)):
        text = path.read_text("utf-8")
    return read_yaml(text, str(path))


def choose_processes(study: Study, processes: int | None, devices: int | None) -> int:
    """Number of processes for a study's steps: ``processes`` where it is given, else one per core.

    On a robot, on an accelerator, or where a number of devices is asked for, one does them all. Call it when JAX is
    configured. Raises ConfigError for several processes at a robot.
    """
    if study.robot is not None:
        if (processes or 1) > 1:
            raise ConfigError(
                f"--processes {processes}: with a robot the steps are done one after the other; allowed: 1"
            )
        return 1
    if processes is not None:
        return processes
    if devices is not None or study.simulation.devices != "auto":
        return 1
    return len(os.sched_getaffinity(0)) if jax.default_backend() == "cpu" else 1


def do_steps(study: Study, folder: Path, steps: list[Step], console: Console, workers: Workers) -> None:
    """Does what is not done yet of a study's steps, each as soon as its inputs are made and a worker is free.

    Ctrl-C and SIGTERM stop the workers, which save what they train, and then raise KeyboardInterrupt; so does the first
    error of a step, which is raised when the others have stopped. Raises RunError when a worker was killed.
    """
    journal = Journal(folder / JOURNAL)
    left = list_unfinished(steps, journal)
    if len(left) < len(steps):
        console.print(f"{len(steps) - len(left)} of {len(steps)} steps were done before", highlight=False)
    done = itertools.count(len(steps) - len(left) + 1)

    def ended(name: str, result: tuple[str, float]) -> None:
        text, seconds = result
        journal.append(name, seconds)
        line = f"[{next(done)}/{len(steps)}] {name}: {text}  ({seconds:.1f} s)"
        console.print(line, highlight=False, soft_wrap=True, markup=False)

    if workers.alone:
        for step in left:
            ended(step.name, perform(step))
    elif left:
        setup = Setup("experiments.study.session:prepare", (study, folder))
        makers = {path: step.name for step in left for path in step.outputs}
        jobs = []
        for step in left:  # each after those that make its inputs; a round's trainings share a program
            needed = frozenset(makers[path] for path in step.inputs if path in makers)
            jobs.append(Job(step.name, (step.name,), needed, step.program, step.compiled))
        engine.run(workers.engine(setup, folder), jobs, lambda job, result: ended(job.name, result))


def prepare(study: Study, folder: Path) -> Callable[[str], tuple[str, float]]:
    """The function that does a step of that name, in a worker."""
    simulation = study.simulation.model_copy(update={"devices": 1})
    console = Console(force_terminal=False)  # live bars of several processes would overwrite each other
    pipeline = Pipeline(study.model_copy(update={"simulation": simulation}), folder, console)
    steps = {step.name: step for step in pipeline.steps()}
    return lambda name: perform(steps[name])
