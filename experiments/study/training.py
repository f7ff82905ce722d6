"""A study's trainings in simulation: ordinary runs, several seeds of a model, the best in reality chosen."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from ballmodel.distribution import load_distribution
from experiments.config import build
from experiments.config.experiment import Config, Evaluation, Training
from experiments.config.files import read_yaml
from experiments.config.study import Study
from experiments.runs import load_policy, run_dir
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.locate import SELECTION
from experiments.runs.run_dir import Run
from experiments.study.paths import POLICY
from experiments.study.schedule import Simulated, count_updates
from experiments.training.loop import train


def make_config(
    study: Study, item: Simulated, balls: str | dict, source: Path | None, seed: int, world: Path | None = None
) -> Config:
    """The training YAML of a model: balls by name or content, initial policy from ``source``, the round's recipe.

    world: model YAML that was identified; None: the study's.
    """
    simulation = study.simulation
    recipe = simulation.rounds[item.round or 0]
    optimiser = simulation.optimiser
    if recipe.step is not None:
        optimiser = optimiser.model_copy(update={"step": recipe.step})
    training = Training(
        updates=count_updates(study, item),
        later_rewards=recipe.later_rewards,
        seed=seed,
        pool=simulation.pool,
        checkpoint_seconds=simulation.checkpoint_seconds,
        evaluate_every=None,
        devices=simulation.devices,
    )
    return Config(
        name=item.key,
        balls=balls,
        model=simulation.model if world is None else read_yaml(world.read_text(encoding="utf-8"), str(world)),
        task=simulation.task,
        optimiser=optimiser,
        training=training,
        evaluation=Evaluation(sim_rate=study.reality.sim_rate, reachable_balls=None),
        initial_policy=None if source is None else str(source.resolve()),
    )


def train_seeds(
    study: Study,
    item: Simulated,
    folder: Path,
    human: Path | None,
    source: Path | None,
    name: str,
    console: Console,
    score: Callable[[TrainedPolicy], float] | None,
    world: Path | None = None,
) -> str:
    """Trains every seed of a model in ``folder``/training, or goes on with them, and writes the chosen policy.

    human: YAML of the human model; None: the distribution that the item names. source: run to start from. name: of the
    step, which decides the seeds. score: what a policy is worth in reality, needed to choose among seeds. world: as in
    ``make_config``.
    """
    balls = item.balls if human is None else load_distribution(human).to_dict()
    scores: dict[str, float] = {}
    for k in range(study.simulation.seeds):
        seed = zlib.crc32(f"{name}/{k}".encode()) >> 1  # another one for every player, model and study seed
        config = make_config(study, item, balls, source, seed, world)
        experiment, run = build.experiment(config, name), Run(folder / "training" / f"seed{k}")
        run.check(experiment.config)
        if not run.trained(experiment.config):
            train(experiment, run, console)
        if score is not None:
            scores[f"seed{k}"] = score(load_policy.load(run.folder))
    best = max(scores, key=scores.__getitem__) if scores else "seed0"
    chosen = load_policy.load(folder / "training" / best)
    chosen.policy.save(folder / POLICY)
    run_dir.write_json(folder / SELECTION, {"best": f"training/{best}", "scores": scores})
    worth = f", worth {scores[best]:.2f} of 2 in reality" if scores else ""
    among = f", best of {len(scores)}" if len(scores) > 1 else ""
    return f"{count_updates(study, item)} updates{among}{worth}"
