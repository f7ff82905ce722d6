"""From a configuration to the objects it describes: balls, simulation model, task, optimiser."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax

from ballmodel import registry
from ballmodel.io import yaml
from ballmodel.io.validation import Section
from ballmodel.registry import Balls
from ballmodel.sampling import BallPool, sample_pool
from bgs import optimizers
from bgs.strategy import BGSConfig
from experiments.config import prior
from experiments.config.experiment import Config, Rewards, Task
from experiments.config.optimiser import Optimiser
from experiments.errors import ConfigError, error_context
from mjx_tt.env import user_defined
from mjx_tt.env.reward_weights import PRESETS
from mjx_tt.env.task import CONTRACT_OBSERVATIONS, TaskConfig, weigh_rewards
from mjx_tt.env.terms import ObservationTerm, RewardTerm
from mjx_tt.env.user_defined import Definitions
from mjx_tt.env.user_network import Network
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from mjx_tt.sim import model as models
from mjx_tt.sim import randomisation
from mjx_tt.sim.model import ModelFile, SimModel
from robot_io.contract import JOINT_NAMES

# What a seed is used for; each purpose has its own key.
NONE = Definitions()  # of the user's own
TRAINING_BALLS, INITIAL_STATE, PROGRESS_BALLS, PROGRESS_EPISODES, EVALUATION_BALLS, EVALUATION_EPISODES = range(6)


@dataclass(frozen=True)
class Experiment:
    """A configuration whose names and files have been looked up.

    config        with the content of the files that it named in their place, so that it stands alone
    distribution  of the balls: a box or a mixture
    model         nominal parameters and what is randomised around them
    task, bgs     settings of simulator and optimiser
    network       one of the user's own; None: the paper's
    """

    config: Config
    distribution: Balls
    model: ModelFile
    task: TaskConfig
    bgs: BGSConfig
    network: Network | None = None


def experiment(config: Config, where: str) -> Experiment:
    """Looks up what a configuration names; ``where`` is its origin in errors. Raises ConfigError."""
    balls = distribution(config.balls, f"{where}: balls")
    robot, robot_data = robot_of(config, where)
    with error_context(f"{where}: robot"):
        nominal = nominal_model(robot)
    with error_context(f"{where}: model"):
        own_model = config.model if isinstance(config.model, dict) else yaml.read(config.model)
        folder = "" if isinstance(config.model, dict) else Path(config.model).parent
        model_data = with_prior(randomisation.with_content(own_model, folder) or {}, robot, where)
    with error_context():
        origin = f"{where}: model" + (f": {config.model}" if isinstance(config.model, str) else "")
        model = models.from_dict(model_data, origin, nominal)
    if config.initial_policy is not None and not Path(config.initial_policy).is_dir():
        raise ConfigError(
            f"{where}: initial_policy: expected the folder of a run or an artefact, got {config.initial_policy}"
        )
    named = isinstance(config.balls, str) and config.balls in registry.names()
    own, text = definitions(config, where)
    content = {"balls": config.balls if named else balls.to_dict(), "model": model_data, "robot": robot_data}
    alone = config.model_copy(update={**content, "definitions": text})
    if config.training.later_rewards is not None:
        with error_context(f"{where}: training.later_rewards"):
            reward_terms(config.training.later_rewards.rewards, own)
    with error_context(f"{where}: task"):
        terms = {"rewards": reward_terms(config.task.rewards, own), "observations": observation_terms(config.task, own)}
        task = TaskConfig(**_shared(config.task, TaskConfig) | terms | {"robot": robot})
    with error_context(f"{where}: optimiser"):
        bgs = bgs_config(config.optimiser, config.training.updates)
    return Experiment(alone, balls, model, task, bgs, network(config, where))


def with_prior(data: dict[str, Any], robot: Robot, where: str) -> dict[str, Any]:
    """A model's plain data with the named ranges of the prior in place of their name. Raises ConfigError."""
    given = data.get("randomise")
    if not isinstance(given, str) or given not in prior.NAMED:
        return data
    if robot.contract.joints != JOINT_NAMES:
        raise ConfigError(
            f"{where}: model.randomise: expected a range for each parameter, as in {{ball.paddle.restitution: "
            f"[0.83, 1.0]}}, got {given}, whose ranges are of the paper's robot alone"
        )
    return data | {"randomise": dict(prior.NAMED[given])}


def believed(model: dict[str, Any]) -> ModelFile:
    """The model of the paper's robot that a study's plain data ``simulation.model`` say. Raises ConfigError."""
    plain = with_prior(model, robots.paper(), "simulation")
    return models.from_dict(plain, "simulation.model")


def robot_of(config: Config, where: str) -> tuple[Robot, str | dict[str, Any] | None]:
    """The experiment's robot, and its content in place of the folder; a name of the program's own robots stays.

    Raises ConfigError with a line for every mistake.
    """
    given = config.robot
    if given is None or given == robots.DEFAULT:
        return robots.paper(), given
    if isinstance(given, dict):
        with error_context():
            return robots.from_content(given, f"{where}: robot"), given
    if given in robots.names():
        return robots.load_shipped(given), given
    with error_context(f"{where}: robot"):
        data = robots.content(given)
    with error_context():  # the lines name their origin
        return robots.load(given), data


def unknown_worlds(experiment: Experiment) -> Experiment | None:
    """The experiment with every ball in a world of its own, drawn from the prior; None for another robot."""
    if experiment.task.robot.contract.joints != JOINT_NAMES:
        return None
    drawn = models.from_dict({"randomise": dict(prior.PRIOR)}, "prior").randomise
    return replace(experiment, model=ModelFile(experiment.model.model, drawn))


def nominal_model(robot: Robot) -> SimModel:
    """The simulation's parameters with the latencies and drives that the robot's YAML gives. Raises ValueError."""
    return models.with_values(SimModel(joints=robot.contract.joints), dict(robot.file.model))


def definitions(config: Config, where: str) -> tuple[Definitions, str | None]:
    """The definitions of the experiment's Python file, and its text. Runs the file. Raises ConfigError."""
    given = config.definitions
    if given is None:
        return NONE, None
    contract = robot_of(config, where)[0].contract
    with error_context(f"{where}: definitions"):
        if "\n" in given:
            return user_defined.load(given, f"definitions of {config.name}", contract), given
        if not given.endswith(".py"):
            raise ValueError(f"expected a Python file, such as my_task.py, got {given}")
        text = Path(given).read_text(encoding="utf-8")
        return user_defined.load(text, given, contract), text


def network(config: Config, where: str) -> Network | None:
    """The experiment's own network; None: the paper's. Raises ConfigError."""
    own, names = definitions(config, where)[0], config.task.observations
    if config.network is None:
        if names:
            raise ConfigError(
                f"{where}: task.observations: {', '.join(names)}: the paper's network takes ball and joints only; "
                "name a network of yours under the key network"
            )
        return None
    if config.network not in own.networks:
        known = own.networks
        allowed = f"one of {', '.join(known)}" if known else "a file that defines it under the key definitions"
        raise ConfigError(f"{where}: network: expected {allowed}, got {config.network}")
    with error_context(f"{where}: task.observations"):
        seen = user_defined.count_rows(observation_terms(config.task, own), own.contract)
    with error_context(f"{where}: definitions"):
        return own.checked_network(config.network, seen)


def distribution(balls: str | dict[str, Any], where: str) -> Balls:
    """The box or mixture of that name, in the YAML at that path, or with that content. Raises ConfigError."""
    if isinstance(balls, dict):
        with error_context():
            return registry.parse_balls(balls, where)
    with error_context(where):
        return registry.resolve(balls)


def reward_terms(chosen: str | Rewards, own: Definitions = NONE) -> tuple[RewardTerm, ...]:
    """The built-in terms and the user's, with their weights. Raises ValueError for an unknown one."""
    base, changed = (chosen, {}) if isinstance(chosen, str) else (chosen.base, chosen.changed)
    return weigh_rewards(PRESETS[base] | changed, own.rewards.values())


def observation_terms(task: Task, own: Definitions) -> tuple[ObservationTerm, ...]:
    """The contract's terms, and the user's that the task asks for. Raises ValueError for an unknown one."""
    for name in task.observations:
        if name not in own.observations:
            allowed = ", ".join(own.observations) or "none is defined; name a file of yours under the key definitions"
            raise ValueError(f"observations: {name} is not defined; allowed: {allowed}")
    user = (replace(own.observations[name], weight=weight) for name, weight in task.observations.items())
    return (*CONTRACT_OBSERVATIONS, *user)


def later_weights(config: Config) -> tuple[int, tuple[float, ...]] | None:
    """The number of updates after which the reward weights change, and those weights."""
    later = config.training.later_rewards
    if later is None:
        return None
    terms = reward_terms(later.rewards, definitions(config, config.name)[0])
    return round(later.after * config.training.updates), tuple(term.weight for term in terms)


def bgs_config(optimiser: Optimiser, updates: int) -> BGSConfig:
    """``updates`` is the length of the run, which a cosine schedule needs. Raises ValueError."""
    chosen = optimiser.step
    rate: float | optimizers.Schedule = chosen.learning_rate
    if chosen.schedule.kind == "cosine":
        rate = optimizers.cosine(rate, chosen.schedule.final, updates, chosen.schedule.hold)
    elif chosen.schedule.kind == "piecewise":
        rate = optimizers.piecewise(rate, tuple((c.update, c.learning_rate) for c in chosen.schedule.changes))
    sigma: float | optimizers.Schedule = optimiser.sigma
    if optimiser.sigma_fall is not None:
        sigma = optimizers.cosine(sigma, optimiser.sigma_fall.final, updates, optimiser.sigma_fall.hold)
    step = optimizers.make(chosen.kind, rate, chosen.b1, chosen.b2, chosen.weight_decay)
    return BGSConfig(**_shared(optimiser, BGSConfig) | {"sigma": sigma, "step": step})


def device_count(config: Config) -> int:
    """Devices to train on: the number asked for, or the most of those present that divide the perturbations evenly.

    Several processes take all that they have. Raises ConfigError where these do not divide the perturbations.
    """
    asked, members, there = config.training.devices, 2 * config.optimiser.num_directions, jax.device_count()
    if jax.process_count() == 1:
        return asked if asked != "auto" else max(n for n in range(1, there + 1) if members % n == 0)
    if asked not in ("auto", there):
        raise ConfigError(f"training.devices: {asked}; {jax.process_count()} processes have {there}; allowed: auto")
    if members % there:
        raise ConfigError(
            f"optimiser.num_directions: {members // 2} pairs cannot be split evenly over {there} devices "
            f"of {jax.process_count()} processes; take a number of processes that divides {members}"
        )
    return there


def key(seed: int, purpose: int) -> jax.Array:
    """A key of its own for each purpose of a seed."""
    return jax.random.fold_in(jax.random.key(seed), purpose)


def pool(experiment: Experiment, key: jax.Array, n: int) -> BallPool:
    """``n`` balls of the experiment's distribution under its nominal ball model. Raises ConfigError."""
    with error_context("balls"):
        return sample_pool(key, experiment.distribution, experiment.model.model.ball, n)


def _shared(section: Section, settings: type) -> dict[str, Any]:
    """The values of the keys that the settings have too."""
    return {field.name: getattr(section, field.name) for field in fields(settings) if hasattr(section, field.name)}
