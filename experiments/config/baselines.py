"""The YAML of a comparison of algorithms: the task they share, their settings, and what each may spend.

Needs neither JAX nor NumPy, as ``experiments.config.experiment``, whose sections and errors it uses.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ballmodel.io.validation import Count, Name, Positive, Section, Seed
from experiments.config import experiment as config
from experiments.config import files
from experiments.config.experiment import Config, Different
from experiments.config.optimiser import Optimiser
from experiments.errors import ConfigError

Layers = Annotated[list[Count], Field(min_length=1)]
Share = Annotated[float, Field(ge=0, le=1)]
Discount = Annotated[float, Field(gt=0, le=1, description="Worth of a reward one control step later.")]
LearningRate = Annotated[Positive, Field(description="Of Adam, for every network.")]
RewardScale = Annotated[Positive, Field(description="By which rewards are multiplied before learning.")]


OWN = ("balls", "model")  # keys of the experiment that an algorithm may have values of its own for


class Learning(Section):
    """Settings of every algorithm."""

    balls: str | dict[str, Any] | None = None
    """Balls that this one trains on, in place of the experiment's; all are judged on the experiment's."""
    model: str | dict[str, Any] | None = None
    """The SimModel that this one trains in, likewise."""

    def own(self) -> dict[str, Any]:
        """Keys of the experiment that this algorithm has values of its own for, and those."""
        return {key: value for key in OWN if (value := getattr(self, key)) is not None}


class Bgs(Learning):
    """An evolution strategy on the paper's network, of 976 parameters for eight joints: BGS, or with other settings
    ARS."""

    kind: Literal["bgs"]
    """This algorithm."""
    optimiser: Optimiser = Optimiser()
    """As in an experiment."""
    schedule_updates: Count = 2000
    """Updates over which a cosine schedule of the learning rate falls; it then stays."""


class Ppo(Learning):
    """Proximal policy optimisation by brax's training function."""

    kind: Literal["ppo"]
    """This algorithm."""
    environments: Count = 1024
    """Side by side."""
    unroll: Count = 32
    """Control steps in every environment between two rounds of learning."""
    epochs: Count = 4
    """Passes over the data of a round."""
    minibatches: Count = 16
    """Parts, of whole unrolls, that a pass is cut into; they must divide the environments."""
    learning_rate: LearningRate = 3e-4
    discount: Discount = 0.99
    gae_lambda: Share = 0.95
    """Lambda of the generalised advantage estimate."""
    clip: Positive = 0.2
    """Largest change of an action's probability ratio that counts."""
    entropy_cost: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1e-3
    """Weight of the policy's entropy in the loss."""
    reward_scale: RewardScale = 1.0
    max_gradient_norm: Positive = 1.0
    """Longer gradients are cut."""
    policy_layers: Layers = [64, 64]
    """Hidden units of the policy's layers."""
    value_layers: Layers = [64, 64]
    """Hidden units of the value function's layers."""

    @model_validator(mode="after")
    def _divides(self) -> Ppo:
        if self.environments % self.minibatches:
            raise ValueError(f"minibatches {self.minibatches} do not divide the environments {self.environments}")
        return self


class Sac(Learning):
    """Soft actor-critic by brax's training function; its first steps are of the untrained policy, not random."""

    kind: Literal["sac"]
    """This algorithm."""
    environments: Count = 64
    """Side by side."""
    capacity: Count = 300_000
    """Transitions kept; once so many are there, brax's buffer moves all of them at every step (0.1 us each)."""
    random_steps: Count = 20_000
    """Control steps, of all environments together, before learning begins."""
    gradient_steps: Count = 1
    """After every step of all environments."""
    batch: Count = 256
    """Transitions of a gradient step."""
    layers: Layers = [128, 128]
    """Hidden units of every network's layers."""
    learning_rate: LearningRate = 1e-3
    discount: Discount = 0.99
    reward_scale: RewardScale = 10.0
    target_rate: Share = 0.005
    """By which the target network moves towards the critic in a gradient step."""


Algorithm = Annotated[Bgs | Ppo | Sac, Field(discriminator="kind")]


class Budget(Section):
    """Limits of each algorithm with each seed; the first that is reached ends its training."""

    minutes: Positive | None = None
    """Of training, without compilation and evaluations."""
    episodes: Count | None = None
    """Of training."""
    clock: Literal["wall", "cpu"] = "wall"
    """Measure of the minutes: the clock, or processor time of this program, for a machine that is busy otherwise."""

    @model_validator(mode="after")
    def _limited(self) -> Budget:
        if self.minutes is None and self.episodes is None:
            raise ValueError("minutes, episodes or both are needed")
        return self


class Curve(Section):
    """The evaluations during training."""

    points: Count = 12
    """Evenly over the budget, besides the one before training."""
    episodes: Count = 512
    """Balls of an evaluation, the same every time."""


class Comparison(Section):
    """One comparison."""

    name: Name
    """Folder of the comparison."""
    experiment: str | dict[str, Any]
    """An experiment's YAML, its path or content: balls, model, task, pool and evaluation hold for every algorithm."""
    robot: str | dict[str, Any] | None = None
    """In place of the experiment's: as ``robot`` there, a folder, its content or a name; null: the experiment's."""
    reality: str | dict[str, Any]
    """The SimModel that no training sees, its path or content."""
    algorithms: Annotated[dict[Name, Algorithm], Field(min_length=1)]
    """By the name that the report gives them."""
    budget: Budget
    """Limits of each algorithm with each seed."""
    seeds: Different[Seed] = [0]
    """Repetitions of every training."""
    curve: Curve = Curve()
    """The evaluations during training."""


def load(path: str | os.PathLike, overrides: tuple[str, ...] = ()) -> tuple[Comparison, Config]:
    """Reads a comparison and the experiment that it names; ``overrides`` are "dotted.path=value".

    Relative paths in the file are relative to its folder, those of overrides to the current one; an experiment that is
    not there is looked up among the shipped ones. Raises ConfigError.
    """
    comparison = files.load(Comparison, "a comparison", path, overrides, _absolute)
    experiment = _experiment(comparison.experiment, str(path))
    if comparison.robot is not None:
        experiment = experiment.model_copy(update={"robot": comparison.robot})
    if experiment.training.later_rewards is not None:
        raise ConfigError(
            f"{path}: experiment: training.later_rewards: a comparison has one set of reward weights; null"
        )
    for key in ("network", "initial_policy"):
        if getattr(experiment, key) is not None:
            raise ConfigError(
                f"{path}: experiment: {key}: {getattr(experiment, key)}: every algorithm of a comparison starts from "
                "random weights of its own network; null"
            )
    return comparison, experiment


def _absolute(data: dict[str, Any], folder: Path) -> None:
    there = (folder / str(data.get("robot"))).exists()  # otherwise it is the name of one that comes with the program
    files.make_absolute(data, ("experiment", "reality", "robot") if there else ("experiment", "reality"), folder)
    algorithms = data.get("algorithms")
    for settings in algorithms.values() if isinstance(algorithms, dict) else ():
        if isinstance(settings, dict):
            config.absolute_paths(settings, folder)


def _experiment(given: str | dict[str, Any], where: str) -> Config:
    if isinstance(given, dict):
        return config.parse(given, f"{where}: experiment")
    path = Path(given)
    return config.load(path if path.exists() else files.shipped("train").get(path.stem, path))
