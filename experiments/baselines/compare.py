"""Trains several algorithms on one task, evaluates them alike, also in a world that no training saw.

Folder of a comparison:
  comparison.yaml                     the request, defaults written out
  <algorithm>/seed<K>/started.json    versions, once the first piece is learned, so its program is compiled
  <algorithm>/seed<K>/training.json   the curve, and under which conditions it came about
  <algorithm>/seed<K>/policy/         the controller's arrays
  <algorithm>/seed<K>/evaluation.json
  comparison.json, *.png, comparison.html   the report (``report``)

An algorithm with a seed is trained in one go: interrupted, that one begins again, and those that are finished stay.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from experiments.baselines import report
from experiments.baselines.judge import Judge
from experiments.baselines.learners import (
    BudgetSpent,
    Counts,
    EvolutionLearner,
    Learner,
    PpoLearner,
    SacLearner,
)
from experiments.config import build
from experiments.config.baselines import OWN, Algorithm, Bgs, Budget, Comparison, Ppo
from experiments.config.build import Experiment
from experiments.config.experiment import Config
from experiments.errors import RunError, error_context
from experiments.jobs import engine, site
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import ALONE, Workers
from experiments.runs import checkpoint, run_dir
from experiments.training.loop import make_trainer
from mjx_tt.env.brax import TableTennis
from mjx_tt.env.episode import Controller
from mjx_tt.env.rollout import Simulator
from mjx_tt.sim.model import ModelFile

STARTED = "started.json"


@dataclass(frozen=True)
class Common:
    """Things that all algorithms of a comparison share."""

    comparison: Comparison
    experiment: Experiment
    trains_in: dict[str, Experiment]  # by algorithm: the experiment, or with balls and a model of its own
    reality: ModelFile
    folder: Path
    console: Console

    def run_folder(self, name: str, seed: int) -> Path:
        return self.folder / name / f"seed{seed}"

    def conditions(self, name: str) -> dict[str, Any]:
        """Settings that decide a training and its evaluation, as plain data."""
        config = self.trains_in[name].config.to_dict()
        shared = {key: config[key] for key in ("robot", *OWN, "task")} | {"pool": config["training"]["pool"]}
        given = self.comparison.to_dict()
        algorithm = {key: value for key, value in given["algorithms"][name].items() if key not in OWN}
        judged = {"evaluation": self.experiment.config.evaluation.model_dump(mode="json"), "reality": given["reality"]}
        return shared | judged | {"budget": given["budget"], "curve": given["curve"], "algorithm": algorithm}


def count_processes(comparison: Comparison, asked: int | None) -> int:
    """Number of processes; one where minutes are the budget, as what a training does in them depends on neighbours.

    Call it when JAX is configured.
    """
    jobs = len(comparison.algorithms) * len(comparison.seeds)
    return site.count_processes(jobs, asked, alone=comparison.budget.minutes is not None)


def compare(
    comparison: Comparison, config: Config, where: str, out: Path, console: Console, workers: Workers = ALONE
) -> Path:
    """Runs what is not finished yet and writes the report; returns the comparison's folder. Raises ExperimentErrors.

    workers: that train side by side; alone, this process trains one after the other.
    """
    common = prepare(comparison, config, where, out, console)
    missing = unfinished(common)
    common.folder.mkdir(parents=True, exist_ok=True)
    run_dir.write_yaml(common.folder / "comparison.yaml", common.comparison.to_dict())
    for name, seeds in missing.items():
        if not seeds:
            console.print(f"{common.folder / name}: done before, skipped", highlight=False)
    left = [
        Job(f"{name}/seed{seed}", (name, seed), program=name, compiled=common.run_folder(name, seed) / STARTED)
        for name, seeds in missing.items()
        for seed in seeds
    ]

    def say(job: Job, text: str) -> None:
        console.print(f"{common.folder / job.name}: {text}", highlight=False)

    if left and workers.alone:
        alone = Trainings(common)
        for job in left:
            say(job, alone.run(*job.arguments))
    elif left:
        setup = Setup("experiments.baselines.compare:trainings", (comparison, config, where, out))
        engine.run(workers.engine(setup, common.folder), left, say)
    report.write(common.folder, common.comparison)
    return common.folder


def prepare(comparison: Comparison, config: Config, where: str, out: Path, console: Console) -> Common:
    """Looks up what the comparison names; ``where`` is its origin in errors. Raises ConfigError."""
    experiment = build.experiment(config, where)
    real = build.experiment(config.model_copy(update={"model": comparison.reality}), f"{where}: reality")
    own = {name: settings.own() for name, settings in comparison.algorithms.items()}
    trains_in = {
        name: build.experiment(config.model_copy(update=changed), f"{where}: algorithms.{name}")
        if changed
        else experiment
        for name, changed in own.items()
    }
    algorithms = {
        name: settings.model_copy(update={key: getattr(trains_in[name].config, key) for key in own[name]})
        for name, settings in comparison.algorithms.items()
    }
    alone = {
        "experiment": experiment.config.to_dict(),
        "reality": real.config.model,
        "robot": None if comparison.robot is None else experiment.config.robot,
        "algorithms": algorithms,
    }
    folder = out / comparison.name
    return Common(comparison.model_copy(update=alone), experiment, trains_in, real.model, folder, console)


def unfinished(common: Common) -> dict[str, list[int]]:
    """Per algorithm the seeds without training or evaluation. Raises RunError for a training under other conditions."""
    seeds = common.comparison.seeds
    return {name: [k for k in seeds if not _finished(common, name, k)] for name in common.comparison.algorithms}


def learner(settings: Algorithm, experiment: Experiment) -> Learner:
    """The algorithm on the experiment's task. Raises ConfigError."""
    config, model = experiment.config, experiment.model
    if isinstance(settings, Bgs):
        with error_context("optimiser"):
            bgs = build.bgs_config(settings.optimiser, settings.schedule_updates)
        training = config.training.model_copy(update={"devices": 1})
        config = config.model_copy(update={"optimiser": settings.optimiser, "training": training})
        return EvolutionLearner(make_trainer(replace(experiment, config=config, bgs=bgs)))
    pool = build.pool(experiment, build.key(config.training.seed, build.TRAINING_BALLS), config.training.pool)
    simulator = Simulator(experiment.task, 1)
    env = TableTennis(simulator, pool, model.model, model.randomise)
    return PpoLearner(settings, env) if isinstance(settings, Ppo) else SacLearner(settings, env)


class Trainings:
    """Trainings of one process, one after the other: they share the programs of the evaluations."""

    def __init__(self, common: Common) -> None:
        self._common = common
        self._judge = Judge(common.experiment, common.reality, common.comparison.curve.episodes)

    def run(self, name: str, seed: int) -> str:
        """Does what is missing of training and evaluation; the return rates in words. Raises RunError."""
        common, folder = self._common, self._common.run_folder(name, seed)
        algorithm = learner(common.comparison.algorithms[name], common.trains_in[name])
        if not (folder / "training.json").exists():
            folder.mkdir(parents=True, exist_ok=True)
            common.console.print(f"{folder}: compiling ...", highlight=False)
            training = Training(common, self._judge, folder)
            algorithm.train(seed, training.observe)
            training.save(name)
        restored = checkpoint.load_latest(folder / "policy", algorithm.template())
        if restored is None:
            raise RunError(f"{folder / 'policy'}: holds no policy, though training.json is there; remove {folder}")
        found = self._judge.final(restored[0])
        run_dir.write_json(folder / "evaluation.json", found)
        rates = (f"{world} {found[world]['return_rate']:.1%}" for world in ("simulation", "reality"))
        return f"returned in {', in '.join(rates)}"


class Training:
    """The account of one training: what it has spent, and its curve of evenly spaced evaluations.

    The first piece of learning contains the compilation, so it is charged with the mean time of those that follow.
    """

    def __init__(self, common: Common, judge: Judge, folder: Path) -> None:
        self._common, self._judge, self._folder = common, judge, folder
        self._curve: list[dict[str, Any]] = []
        self._seconds = {"wall": 0.0, "cpu": 0.0}  # of all pieces but the first
        self._pieces = -1
        self._left = (0.0, 0.0)  # readings of both clocks when learning went on
        self._share = 0.0  # of the budget that was spent
        self._controller: Controller
        self._spent: dict[str, float] = {}

    def observe(self, controller: Controller, counts: Counts) -> None:
        """Notes a piece of learning. Raises BudgetSpent."""
        now, comparison = (time.monotonic(), time.process_time()), self._common.comparison
        self._pieces = 0 if counts["steps"] == 0 else max(self._pieces, 0) + 1
        if self._pieces > 1:
            for clock, before, after in zip(self._seconds, self._left, now, strict=True):
                self._seconds[clock] += after - before
        elif self._pieces == 1:
            run_dir.write_json(self._folder / STARTED, run_dir.provenance())
        scale = self._pieces / max(self._pieces - 1, 1)
        self._controller = controller
        self._spent = {
            "seconds": scale * self._seconds["wall"],
            "cpu_seconds": scale * self._seconds["cpu"],
            "episodes": round(counts["episodes"]),
            "steps": round(counts["steps"]),
        }
        share, points = min(_share(comparison.budget, self._spent), 1.0), comparison.curve.points
        if not self._curve or int(points * share) > int(points * self._share):
            self._add_point(controller)
        self._share = share
        if share >= 1.0:
            raise BudgetSpent
        self._left = time.monotonic(), time.process_time()

    def save(self, name: str) -> None:
        """Writes the policy, then the curve."""
        checkpoint.save(self._folder / "policy", 1, self._controller, {"algorithm": name, **self._spent})
        data = {"conditions": self._common.conditions(name), "curve": self._curve, "provenance": run_dir.provenance()}
        run_dir.write_json(self._folder / "training.json", data)

    def _add_point(self, controller: Controller) -> None:
        point = self._spent | self._judge.progress(controller)
        self._curve.append(point)
        self._common.console.print(
            f"{self._folder}: {point['episodes']:,} episodes, {point['seconds']:.0f} s: returned "
            f"{point['return_rate']:.1%}, touched {point['hit_rate']:.1%}",
            highlight=False,
            soft_wrap=True,
        )


def trainings(comparison: Comparison, config: Config, where: str, out: Path) -> Callable[[str, int], str]:
    """The function that does the training of an algorithm with a seed, in a worker."""
    return Trainings(prepare(comparison, config, where, out, Console(force_terminal=False))).run


def _finished(common: Common, name: str, seed: int) -> bool:
    """True where training and evaluation are there. Raises RunError for a training under other conditions."""
    folder = common.run_folder(name, seed)
    if not (folder / "training.json").exists():
        return False
    before, now = json.loads((folder / "training.json").read_text())["conditions"], common.conditions(name)
    differing = [key for key in now if before.get(key) != now[key]]
    if differing:
        raise RunError(
            f"{folder}: was trained with other settings of {', '.join(differing)}; choose another name or another --out"
        )
    return (folder / "evaluation.json").exists()


def _share(budget: Budget, spent: dict[str, float]) -> float:
    """Spent share of the budget; at 1 it is used up."""
    seconds = spent["seconds" if budget.clock == "wall" else "cpu_seconds"]
    by_time = 0.0 if budget.minutes is None else seconds / (60 * budget.minutes)
    by_episodes = 0.0 if budget.episodes is None else spent["episodes"] / budget.episodes
    return max(by_time, by_episodes)
