"""Trains several algorithms on one task, evaluates them alike, also in a world that no training saw.

Folder of a comparison:
  comparison.yaml                     the request, defaults written out
  <algorithm>/seed<K>/started.json    versions, once its program is compiled
  <algorithm>/seed<K>/training.json   the curve, and under which conditions it came about
  <algorithm>/seed<K>/policy/         the controller's arrays
  <algorithm>/seed<K>/evaluation.json
  comparison.json, curves.csv, *.png, comparison.md   the report (``report``)

An algorithm with a seed is trained in one go: interrupted, that one begins again, and those that are finished stay.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import yaml
from pydantic import TypeAdapter, ValidationError
from rich.console import Console

from ballmodel.io.atomic_files import replacing
from experiments.baselines import report
from experiments.baselines.arena import Arena, draw_balls
from experiments.baselines.bgs import Evolution
from experiments.baselines.learner import MEASURED, Advance, Learner, S
from experiments.baselines.off_policy import OffPolicyLearner
from experiments.baselines.ppo import PpoLearner
from experiments.baselines.qt_opt import QtOptAgent
from experiments.baselines.sac import SacAgent
from experiments.config import build
from experiments.config.baselines import OWN, Algorithm, Bgs, Budget, Comparison, Curve, Ppo, Sac
from experiments.config.build import Experiment
from experiments.config.experiment import Config, Task
from experiments.errors import RunError, checked
from experiments.evaluation import evaluate
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import ALONE, Workers
from experiments.runs import checkpoint, run_dir
from experiments.training.trainers import KINDS
from mjx_tt.env.brax import TableTennis
from mjx_tt.env.episode import Controller
from mjx_tt.env.rollout import Simulator
from mjx_tt.sim.model import ModelFile

STARTED = "started.json"
RELATIVE = ("velocity", "acceleration", "jerk")  # reward terms: 1 - mean over joints and steps of |value| / limit


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
        """Settings that decide a training, as plain data."""
        config = self.trains_in[name].config.to_dict()
        shared = {key: config[key] for key in ("robot", *OWN, "task")} | {"pool": config["training"]["pool"]}
        given = self.comparison.to_dict()
        algorithm = {key: value for key, value in given["algorithms"][name].items() if key not in OWN}
        return shared | {"budget": given["budget"], "curve": given["curve"], "algorithm": algorithm}

    def evaluation_conditions(self) -> dict[str, Any]:
        """Settings that decide an evaluation besides the policy."""
        return {
            "evaluation": self.experiment.config.evaluation.model_dump(mode="json"),
            "reality": self.comparison.reality,
        }


def choose(comparison: Comparison, processes: int | None) -> int:
    """Number of processes: ``processes`` where it is given, else one per core, and no more than trainings.

    One where minutes are the budget: what a training does in them would depend on its neighbours. Call it when JAX is
    configured.
    """
    most = len(comparison.algorithms) * len(comparison.seeds)
    if processes is not None:
        return min(processes, most)
    if comparison.budget.minutes is not None or jax.default_backend() != "cpu":
        return 1
    return min(len(os.sched_getaffinity(0)), most)


def compare(
    comparison: Comparison, config: Config, where: str, out: Path, console: Console, workers: Workers = ALONE
) -> Path:
    """Runs what is not finished yet and writes the report; returns the comparison's folder. Raises ExperimentErrors.

    workers: that train side by side; alone, this process trains one after the other.
    """
    common = prepare(comparison, config, where, out, console)
    missing = unfinished(common)
    common.folder.mkdir(parents=True, exist_ok=True)
    with replacing(common.folder / "comparison.yaml") as temporary:
        temporary.write_text(yaml.safe_dump(common.comparison.to_dict(), sort_keys=False), encoding="utf-8")
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


def learner(settings: Algorithm, experiment: Experiment) -> Learner[Any]:
    """The algorithm on the experiment's task. Raises ConfigError."""
    config, model = experiment.config, experiment.model
    pool = build.pool(experiment, build.key(config.training.seed, build.TRAINING_BALLS), config.training.pool)
    simulator = Simulator(experiment.task, 1)
    if isinstance(settings, Bgs):
        optimiser = settings.optimiser
        bgs = checked("optimiser", build.bgs_config, optimiser, settings.schedule_updates)
        return Evolution(
            KINDS[optimiser.gradient](
                simulator,
                bgs,
                pool,
                model.model,
                model.randomise,
                optimiser.repeats,
                optimiser.common_random_numbers,
                optimiser.initial_scale,
            )
        )
    env = TableTennis(simulator, pool, model.model, model.randomise)
    if isinstance(settings, Ppo):
        return PpoLearner(settings, env)
    sizes = env.observation_size, env.action_size
    agent = SacAgent(settings, *sizes) if isinstance(settings, Sac) else QtOptAgent(settings, *sizes)
    return OffPolicyLearner(settings.replay, env, agent)


class Judge:
    """Evaluates controllers: on the way, and in the end in simulation and in reality."""

    def __init__(self, common: Common) -> None:
        experiment = common.experiment
        config = experiment.config
        task = replace(experiment.task, sim_rate=config.evaluation.sim_rate or experiment.task.sim_rate)
        self._arenas = {"simulation": Arena(task, experiment.model), "reality": Arena(task, common.reality)}
        seed, on_the_way = config.training.seed, common.comparison.curve.episodes
        self._progress_key = build.key(seed, build.PROGRESS_EPISODES)
        self._progress_balls = draw_balls(experiment, build.key(seed, build.PROGRESS_BALLS), on_the_way)
        seed = config.evaluation.seed
        self._key = build.key(seed, build.EVALUATION_EPISODES)
        self._balls = draw_balls(experiment, build.key(seed, build.EVALUATION_BALLS), config.evaluation.episodes)

    def progress(self, controller: Controller) -> dict[str, Any]:
        result = self._arenas["simulation"].play(controller, self._progress_balls, self._progress_key)
        kept = ("return_rate", "low", "high", "hit_rate", "mean_return")
        summary = evaluate.summary(result)
        return {name: summary[name] for name in kept}

    def final(self, controller: Controller) -> dict[str, Any]:
        """Per world the summary of ``evaluate``, and how restless the motion is in simulation."""
        found = {
            world: evaluate.summary(arena.play(controller, self._balls, self._key))
            for world, arena in self._arenas.items()
        }
        terms = found["simulation"]["terms"]
        restless = {name: None if terms[name] is None else 1.0 - terms[name] for name in RELATIVE}
        change = self._arenas["simulation"].action_change(controller, self._balls, self._key)
        return found | {"restlessness": {"action_change": change if math.isfinite(change) else None} | restless}


class Trainings:
    """Trainings of one process, one after the other: those of an algorithm share its compiled program."""

    def __init__(self, common: Common) -> None:
        self._common, self._judge = common, Judge(common)
        self._name = ""
        self._algorithm: Learner[Any]
        self._compiled: Advance[Any] | None = None

    def run(self, name: str, seed: int) -> str:
        """Does what is missing of training and evaluation; the return rates in words. Raises RunError."""
        common, key = self._common, build.key(seed, build.INITIAL_STATE)
        if name != self._name:
            self._algorithm, self._compiled = learner(common.comparison.algorithms[name], common.trains_in[name]), None
            self._name = name
        algorithm, folder = self._algorithm, common.run_folder(name, seed)
        if not (folder / "training.json").exists():
            state = algorithm.init(key)
            if self._compiled is None:
                common.console.print(f"{folder}: compiling ...", highlight=False)
                self._compiled = algorithm.compiled(state)
            folder.mkdir(parents=True, exist_ok=True)
            run_dir.write_json(folder / STARTED, run_dir.provenance())
            _train(common, self._judge, name, folder, algorithm, self._compiled, state)
        template = jax.eval_shape(lambda key: algorithm.controller(algorithm.init(key)), key)
        restored = checkpoint.load_latest(folder / "policy", template)
        if restored is None:
            raise RunError(f"{folder / 'policy'}: holds no policy, though training.json is there; remove {folder}")
        found = self._judge.final(restored[0])
        run_dir.write_json(folder / "evaluation.json", {"conditions": common.evaluation_conditions()} | found)
        rates = (f"{world} {found[world]['return_rate']:.1%}" for world in ("simulation", "reality"))
        return f"returned in {', in '.join(rates)}"


def trainings(comparison: Comparison, config: Config, where: str, out: Path) -> Callable[[str, int], str]:
    """The function that does the training of an algorithm with a seed, in a worker."""
    return Trainings(prepare(comparison, config, where, out, Console(force_terminal=False))).run


def _finished(common: Common, name: str, seed: int) -> bool:
    """True where training and evaluation are there. Raises RunError for a training under other conditions."""
    folder = common.run_folder(name, seed)
    if not (folder / "training.json").exists():
        return False
    before, now = _completed(json.loads((folder / "training.json").read_text())["conditions"]), common.conditions(name)
    differing = [key for key in now if before.get(key) != now[key]]
    if differing:
        raise RunError(
            f"{folder}: was trained with other settings of {', '.join(differing)}; choose another name or another --out"
        )
    path = folder / "evaluation.json"
    return path.exists() and json.loads(path.read_text())["conditions"] == common.evaluation_conditions()


def _completed(conditions: dict[str, Any]) -> dict[str, Any]:
    """Settings of an earlier training with the defaults of keys that did not exist then."""
    completed = {"robot": None, "algorithm": {}} | conditions
    models: dict[str, Any] = {"task": Task, "budget": Budget, "curve": Curve, "algorithm": Algorithm}
    for key, model in models.items():
        with suppress(ValidationError):  # a key that is gone: not the settings of now
            completed[key] = TypeAdapter(model).validate_python(conditions.get(key)).model_dump(mode="json")
    completed["algorithm"] = {key: completed["algorithm"][key] for key in completed["algorithm"] if key not in OWN}
    return completed


def _train(
    common: Common, judge: Judge, name: str, folder: Path, algorithm: Learner[S], advance: Advance[S], state: S
) -> None:
    """Learns until the budget is spent; the curve has evenly spaced evaluations, the first before any learning."""
    budget, points = common.comparison.budget, common.comparison.curve.points
    spent = {"seconds": 0.0, "cpu_seconds": 0.0} | {name: 0 for name in ("episodes", "steps")}
    curve = [spent | judge.progress(algorithm.controller(state)) | {"training": None}]
    _say(common.console, folder, curve[-1])
    since: dict[str, float] = dict.fromkeys(MEASURED, 0.0)
    while (share := _share(budget, spent)) < 1.0:
        started = time.monotonic(), time.process_time()
        state, on_device = advance(state)
        measured = {key: float(value) for key, value in jax.device_get(on_device).items()}
        spent["seconds"] += time.monotonic() - started[0]
        spent["cpu_seconds"] += time.process_time() - started[1]
        for key in ("episodes", "steps"):
            spent[key] += round(measured[key])
        since = {key: since[key] + measured[key] for key in MEASURED}
        if int(points * min(_share(budget, spent), 1.0)) > int(points * share):
            ended = max(since["episodes"], 1.0)
            training = {key: since[key] / ended for key in ("hit", "returned", "episode_return")}
            curve.append(dict(spent) | judge.progress(algorithm.controller(state)) | {"training": training})
            since = dict.fromkeys(MEASURED, 0.0)
            _say(common.console, folder, curve[-1])
    notes = {"algorithm": name, **spent}
    checkpoint.save(folder / "policy", 1, algorithm.controller(state), notes)
    run_dir.write_json(
        folder / "training.json",
        {"conditions": common.conditions(name), "curve": curve, "provenance": run_dir.provenance()},
    )


def _share(budget: Budget, spent: dict[str, float]) -> float:
    """Spent share of the budget; at 1 it is used up."""
    seconds = spent["seconds" if budget.clock == "wall" else "cpu_seconds"]
    by_time = 0.0 if budget.minutes is None else seconds / (60 * budget.minutes)
    by_episodes = 0.0 if budget.episodes is None else spent["episodes"] / budget.episodes
    return max(by_time, by_episodes)


def _say(console: Console, folder: Path, point: dict[str, Any]) -> None:
    console.print(
        f"{folder}: {point['episodes']:,} episodes, {point['seconds']:.0f} s: returned {point['return_rate']:.1%}, "
        f"touched {point['hit_rate']:.1%}, mean return {point['mean_return'] or float('nan'):.2f}",
        highlight=False,
        soft_wrap=True,
    )
