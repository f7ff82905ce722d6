"""Steps of a study that need nothing of each other, done side by side by the workers of this machine or of a site.

One training on all cores is slower than as many trainings on a core each, and most of a study's steps are independent:
players, seeds, methods. The process that was asked decides what is next, marks what is done and says so; the workers
only do what they are told. What a step makes follows from its name alone, so nothing depends on who does it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import jax
from rich.console import Console

from experiments.config.study import Study
from experiments.errors import ConfigError
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import Workers
from experiments.study.workflow import Journal, Session, Step, perform


def choose(study: Study, processes: int | None, devices: int | None) -> int:
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


def run_side_by_side(
    study: Study, folder: Path, steps: list[Step], journal: Journal, console: Console, workers: Workers
) -> None:
    """Does what is not done yet of a study's steps, each as soon as its inputs are made and a worker is free.

    Ctrl-C and SIGTERM stop the workers, which save what they train, and then raise KeyboardInterrupt; so does the first
    error of a step, which is raised when the others have stopped. Raises RunError when a worker was killed.
    """
    session = Session(steps, journal, console, workers.count)
    if not session.left:
        return
    by_name = {step.name: step for step in session.left}
    setup = Setup("experiments.study.workers:prepare", (study, folder))

    def ended(job: Job, result: tuple[str, float]) -> None:
        session.mark(by_name[job.name], *result)

    engine.run(workers.engine(setup, folder), jobs(session.left), ended)


def jobs(steps: list[Step]) -> list[Job]:
    """The steps, each after those that make its inputs; a round's trainings share a program."""
    makers = {path: step.name for step in steps for path in step.outputs}
    return [
        Job(
            step.name,
            (step.name,),
            frozenset(makers[path] for path in step.inputs if path in makers),
            step.program,
            step.compiled,
        )
        for step in steps
    ]


def prepare(study: Study, folder: Path) -> Callable[[str], tuple[str, float]]:
    """The function that does a step of that name, in a worker."""
    from experiments.study.pipeline import Pipeline

    simulation = study.simulation.model_copy(update={"devices": 1})
    console = Console(force_terminal=False)  # live bars of several processes would overwrite each other
    pipeline = Pipeline(study.model_copy(update={"simulation": simulation}), folder, console)
    steps = {step.name: step for step in pipeline.steps()}
    return lambda name: perform(steps[name])
