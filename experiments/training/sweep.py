"""A batch of trainings: several experiments, several seeds, side by side or one after the other."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments.config import build
from experiments.config.experiment import Config
from experiments.errors import ConfigError, RunError, explained
from experiments.evaluation import evaluate
from experiments.jobs import engine, site
from experiments.jobs.engine import Setup
from experiments.jobs.site import ALONE, Workers
from experiments.progress import make_console
from experiments.runs import load_policy, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.locate import SELECTION
from experiments.runs.run_dir import Run
from experiments.sparse_reward import EPISODES, FAULT
from experiments.training import loop
from experiments.training.finalize import finish
from experiments.training.loop import train
from experiments.training.ranks import SINGLE, Ranks

WIDTH = 120  # [characters] of tables in a file


@dataclass(frozen=True)
class Job:
    """One run: an experiment with its seed, and the file that it comes from."""

    config: Config
    run: Run
    where: str


def plan(configs: list[tuple[str, Config]], seeds: tuple[int, ...], out: Path) -> list[Job]:
    """Jobs in ``out``/<name>/, or in ``out``/<name>/seed<k>/ where seeds are given.

    configs: (file, configuration). Raises ConfigError when two files would share a folder.
    """
    owners: dict[str, str] = {}
    for where, config in configs:
        if config.name in owners:
            raise ConfigError(
                f"{where}: name: {config.name!r} is also the name of {owners[config.name]}; give it another"
            )
        owners[config.name] = where
    jobs = []
    for where, config in configs:
        folder = out / config.name
        if not seeds:
            jobs.append(Job(config, Run(folder), where))
        for seed in seeds:
            seeded = config.training.model_copy(update={"seed": seed})
            jobs.append(Job(config.model_copy(update={"training": seeded}), Run(folder / f"seed{seed}"), where))
    return jobs


def count_processes(jobs: list[Job], asked: int | None, devices: int | None) -> int:
    """Number of processes for a batch; one where a number of ``devices`` is asked for. Call it when JAX is configured.

    It follows from the whole batch, not from what is left of it: it decides the devices of each, and these the last
    bits.
    """
    fixed = devices is not None or any(job.config.training.devices != "auto" for job in jobs)
    return site.count_processes(len(jobs), asked, alone=fixed)


def run_all(jobs: list[Job], console: Console, out: Path, workers: Workers = ALONE) -> bool:
    """Runs, resumes or skips each job; one that fails does not stop the others. Returns whether all succeeded.

    workers: alone, this process runs one after the other; others run side by side, each run's lines in a file of its
    folder. out: folder of the runs. Raises KeyboardInterrupt when it was stopped, ConfigError for a site that cannot be
    used.
    """
    by_name = {str(job.run.folder): job for job in jobs}
    outcomes: dict[str, tuple[str, str]] = {}  # "done" or "failed", and the return rate or the error
    if not workers.alone:
        _run_side_by_side(by_name, console, out, workers, outcomes)
    for name, job in by_name.items() if workers.alone else ():
        try:
            outcomes[name] = "done", run_job(job, console)
        except Exception as error:  # even a bug in one job must not cost the night's other trainings
            if explained(error):
                console.print(f"error: {error}", style="red", soft_wrap=True)
            else:
                console.print_exception()
            outcomes[name] = "failed", f"{type(error).__name__}: {error}".splitlines()[0]
    if len(jobs) > 1 or not workers.alone:
        table = Table("run", "", "return rate or error", title="Summary", title_justify="left")
        for name in by_name:
            state, result = outcomes[name]
            table.add_row(name, Text(state, "green" if state == "done" else "red"), result)
        console.print(table)
    return all(state == "done" for state, _ in outcomes.values())


def _run_side_by_side(
    jobs: dict[str, Job], console: Console, out: Path, workers: Workers, outcomes: dict[str, tuple[str, str]]
) -> None:
    def note(name: str, state: str, result: str) -> None:
        outcomes[name] = state, result
        line = f"[{len(outcomes)}/{len(jobs)}] {name}: {'' if state == 'done' else 'failed: '}{result}"
        console.print(line, style="red" if state == "failed" else None, soft_wrap=True)

    left = []
    for name, job in jobs.items():
        if job.run.done(job.config):
            note(name, "done", run_job(job, console))
        else:
            # Runs of one program: the first compiles it for all.
            program = hashlib.sha256(loop.program(job.config, job.config.training.devices).encode()).hexdigest()
            left.append(engine.Job(name, (job,), program=program, compiled=job.run.metrics))
    if not left:
        return
    output = next(iter(jobs.values())).run.output.name
    console.print(f"{len(left)} runs, {workers.text}; each writes its lines to {output} in its folder", soft_wrap=True)
    devices = max(
        [workers.cores, *(c.devices for c in (j.config.training for j in jobs.values()) if c.devices != "auto")]
    )
    setup = Setup("experiments.training.sweep:prepare", (), devices)
    engine.run(
        workers.engine(setup, out),
        left,
        lambda job, result: note(job.name, "done", result),
        lambda job, error: note(job.name, "failed", str(error)),
    )


def prepare() -> Callable[[Job], str]:
    """The function that does a job, in a worker."""
    return _run_into_file


def _run_into_file(job: Job) -> str:
    job.run.folder.mkdir(parents=True, exist_ok=True)
    with open(job.run.output, "a", encoding="utf-8") as file:
        console = make_console(file, WIDTH)
        try:
            return run_job(job, console)
        except Exception as error:
            if explained(error):
                raise
            console.print_exception()
            raise RunError(f"{type(error).__name__}: {error}; see {job.run.output}") from None


def run_job(job: Job, console: Console, ranks: Ranks = SINGLE) -> str:
    """Trains, evaluates and exports one run, as far as that is not done yet; returns its return rate as text.

    ranks: processes that train it together; the first one checks, evaluates, draws and exports alone. Raises
    ConfigError where the processes do not read the same.
    """
    experiment = build.experiment(job.config, job.where)
    run, config = job.run, experiment.config
    read = hashlib.sha256(json.dumps(config.to_dict(), sort_keys=True).encode()).digest()
    every = ranks.gather(int.from_bytes(read[:6], "big"))[:, 0]
    if (every != every[0]).any():
        other = int(np.argmax(every != every[0]))
        raise ConfigError(f"{job.where}: process {other} reads something else than process 0; all need the same files")
    if ranks.is_first:
        run.check(config)
    if not ranks.gather(ranks.is_first and run.trained(config))[0, 0]:
        reason = train(experiment, run, console, ranks)
        by = "" if ranks.is_alone else f" by {ranks.count} processes"
        console.print(f"{run.folder}: trained{by}, ended by {reason}")
    ranks.disconnect()
    if not ranks.is_first:
        return ""
    if run.done(config):
        console.print(f"{run.folder}: done before, skipped")
        report = run.read_evaluation()
    else:
        report = finish(experiment, run, console)
    return f"{report['return_rate']:.1%} ({report['low']:.1%} to {report['high']:.1%})"


def select(
    folder: Path,
    jobs: list[Job],
    console: Console,
    robot: str | None = None,
    score_on: Callable[[TrainedPolicy, str, int, int, Console], float] | None = None,
) -> None:
    """The paper's choice among seeds, written to selection.json: the best mean over 50 episodes of a sparse reward.

    All seeds play the same balls, where the robot can. robot: on which they are played, by ``score_on(policy, robot,
    balls, seed, console)``; None: in simulation. Raises what a missing run or an unwritable folder raises.
    """
    scores = {}
    for job in jobs:
        trained, seed = load_policy.load(job.run.folder), job.config.evaluation.seed + 1
        if robot is not None and score_on is not None:
            scores[job.run.folder.name] = score_on(trained, robot, EPISODES, seed, console)
        else:
            played = evaluate.evaluate(build.experiment(job.config, job.where), trained, EPISODES, seed)
            scores[job.run.folder.name] = evaluate.selection_score(played.result)
    best = max(scores, key=lambda seed: scores[seed])
    selection = {
        "episodes": EPISODES,
        "robot": robot,
        "reward": {"hit": 1, "landed": 1, "fault": FAULT},
        "scores": scores,
        "best": best,
    }
    run_dir.write_json(folder / SELECTION, selection)
    console.print(
        f"{folder}: best seed by {EPISODES} episodes on {robot or 'the simulation'}: {best} ({scores[best]:.2f} of 2)"
    )
