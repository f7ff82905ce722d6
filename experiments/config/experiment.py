"""The typed experiment YAML: what may stand in it, what is left out means, and errors that say what to change.

Needs neither JAX nor NumPy, so that a mistake in a file is reported at once. Names and files that a configuration
refers to are looked up by ``experiments.config.build``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from ballmodel.io import validation
from ballmodel.io.validation import Count, Finite, Fraction, Name, Positive, Section, Seed
from experiments.config import files
from experiments.config.optimiser import Optimiser
from mjx_tt.env.reward_weights import REAL_WEIGHTS, SIM_WEIGHTS


def _check_different(values: list) -> list:
    if len(set(values)) < len(values):
        raise ValueError("different entries")
    return values


T = TypeVar("T")
Different = Annotated[list[T], Field(min_length=1), AfterValidator(_check_different)]
ALLOWED_TERMS = f"{', '.join(SIM_WEIGHTS)}, and terms of a file that the key definitions names"


def _describe_weights(schema: dict[str, Any]) -> None:
    """Adds the built-in terms' weights to the JSON schema, for editors and the reference."""
    schema["properties"] |= {
        name: {
            "anyOf": [{"type": "number"}, {"type": "null"}],
            "default": None,
            "title": name,
            "description": f"Weight of the term; {SIM_WEIGHTS[name]:g} in sim, {REAL_WEIGHTS[name]:g} in real.",
        }
        for name in SIM_WEIGHTS
    }


class Rewards(Section):
    """Weights of reward terms by name; a term that is left out, or null, keeps the weight of ``base``.

    The names are those of the built-in terms and of those that the file of the key definitions has, which weigh 0 when
    they are left out.
    """

    model_config = ConfigDict(extra="allow", json_schema_extra=_describe_weights)
    __pydantic_extra__: dict[str, Finite]

    base: Literal["sim", "real"] = "sim"
    """The paper's weights for simulation or for the real robot."""

    @model_validator(mode="before")
    @classmethod
    def _flatten(cls, data: Any) -> Any:
        """Leaves out nulls. Artefacts of earlier versions hold the weights of user-defined terms under ``own``."""
        if not isinstance(data, dict):
            return data
        user = data.get("own")
        flat = {k: v for k, v in data.items() if k != "own"} | user if isinstance(user, dict) else data
        return {name: weight for name, weight in flat.items() if weight is not None or name == "base"}

    @property
    def changed(self) -> dict[str, float]:
        """The weights that differ from the base's."""
        return {name: float(weight) for name, weight in self.__pydantic_extra__.items()}


class Task(Section):
    """The episode."""

    engine: Literal["fused", "mjx"] = "fused"
    """Robot dynamics: fused is fast, mjx is the reference."""
    lanes: bool = True
    """On processors, fused only: control steps run for a few episodes at a time; false leaves them to XLA."""
    control_rate: Positive = 75.0
    """[Hz] of the policy."""
    sim_rate: Positive = 300.0
    """[Hz] of the physics, a whole multiple of control_rate."""
    max_steps: Count = 200
    """Control steps after which an episode ends."""
    contact_ends_episode: bool = False
    """The robot stops, as the real one, where it touches the table or itself; false: it passes through, and the term
    collision counts the contact. First-order gradients climb past it either way."""
    rewards: Literal["sim", "real"] | Rewards = "sim"
    """The paper's weights by name, or a mapping that changes single ones."""
    observations: dict[str, Finite] = {}
    """Observation terms of the file of the key definitions that the policy sees besides ball and joints, and the number
    by which each is multiplied."""


class LaterRewards(Section):
    """Other reward weights for the rest of a training."""

    after: Fraction
    """Share of the updates that are trained with the weights of the task."""
    rewards: Literal["sim", "real"] | Rewards
    """The weights from then on, as those of the task."""


class Training(Section):
    """Length of a training and what to keep of it."""

    updates: Count = 2000
    """Length of the training; a cosine schedule falls over it."""
    later_rewards: LaterRewards | None = None
    """First learn to hit with the weights of the task, then with these; null: the same weights throughout."""
    max_minutes: Positive | None = None
    """Stop after this much training time, all sessions of the run together; a larger value continues the run."""
    stop_at_return_rate: Annotated[float, Field(gt=0, le=1)] | None = None
    """Stop when an evaluation during training reaches this return rate."""
    seed: Seed = 0
    """Of balls, first parameters, perturbations and episodes."""
    pool: Count = 65536
    """Balls drawn from the distribution before training; episodes choose among them."""
    checkpoint_seconds: Positive = 30.0
    """Least time between checkpoints."""
    evaluate_every: Count | None = 200
    """Updates between evaluations on fresh balls; null: none."""
    evaluate_episodes: Count = 1024
    """Balls of such an evaluation, the same every time."""
    devices: Count | Literal["auto"] = "auto"
    """Devices that share the perturbations; auto: as many as divide them evenly."""


class Evaluation(Section):
    """The evaluation after training."""

    episodes: Count = 2000
    """Balls that are played, each once."""
    seed: Seed = 1000
    """Of balls, latencies and noise."""
    sim_rate: Positive | None = None
    """[Hz] of the physics; null: that of the task."""
    reachable_balls: Count | None = 128
    """Balls for which a motion is optimised, one by one, for a lower bound on the return rate in reach; null: none."""
    unknown_worlds: Count | None = None
    """Balls that are also played in worlds unknown to training, each in one drawn from the prior; null: none."""


class Config(Section):
    """One experiment."""

    name: Name
    """Folder of the run."""
    balls: str | dict[str, Any]
    """A distribution's name such as player3/M1 or narrow, the path of a YAML, or the YAML's content."""
    model: str | dict[str, Any] = {}
    """SimModel: the path of a YAML or its content, such as {sensing: {ball_noise: 0.02}}; may hold randomise: ranges,
    prior (what a laboratory that has measured nothing may expect) or dynamics (of those the table, paddle, drives)."""
    robot: str | dict[str, Any] | None = None
    """A folder with YAML and MJCF of your own robot (docs/how-to/bring-your-own-robot.md), that YAML, its content, or
    the name of a robot that comes with the program; null: the paper's."""
    task: Task = Task()
    """The episode."""
    optimiser: Optimiser = Optimiser()
    """Blackbox Gradient Sensing."""
    training: Training = Training()
    """Length of a training, and what to keep of it."""
    evaluation: Evaluation = Evaluation()
    """The evaluation after training."""
    definitions: str | None = None
    """A Python file of your own with reward terms and networks (docs/how-to/define-a-task.md), or its content."""
    network: str | None = None
    """One of the networks in definitions; null: the paper's gated dilated CNN of 976 parameters."""
    initial_policy: str | None = None
    """A run folder or an exported artefact whose policy training starts from."""

    @model_validator(mode="after")
    def _of_one_kind(self) -> Config:
        later = {"training.later_rewards": self.training.later_rewards}
        refuse_rewards(self.optimiser, self.task, "", later, self.definitions is not None)
        return self


def refuse_unknown_terms(key: str, rewards: str | Rewards, allowed: str = ALLOWED_TERMS) -> None:
    """Raises ValueError for weights of terms that are not built in, in a message with ``key`` and ``allowed``."""
    for name in () if isinstance(rewards, str) else rewards.changed:
        if name not in SIM_WEIGHTS:
            hint = validation.nearest(name, SIM_WEIGHTS)
            raise ValueError(f"{key}.{name}: unknown reward term; {hint}{hint and ' '}allowed: {allowed}")


def refuse_rewards(
    optimiser: Optimiser, task: Task, where: str, later: dict[str, LaterRewards | None], own: bool = False
) -> None:
    """Raises ValueError for rewards that first-order gradients do not know, user-defined ones and ``later`` ones by
    their key, and for unknown terms, unless a file of one's ``own`` defines some.

    where: before the other keys in the message.
    """
    changed = {} if isinstance(task.rewards, str) else task.rewards.changed
    user = {f"{where}task.rewards.{name}": weight for name, weight in changed.items() if name not in SIM_WEIGHTS}
    for key, given in (later | user).items():
        if given and optimiser.gradient == "first_order":
            raise ValueError(
                f"{key}: {where}optimiser.gradient first_order climbs an objective of its own, in which it has no "
                "part; leave it out, or take gradient: zeroth_order"
            )
    if not own:
        refuse_unknown_terms(f"{where}task.rewards", task.rewards)
        for key, rest in later.items():
            refuse_unknown_terms(f"{key}.rewards", "sim" if rest is None else rest.rewards)


def load(path: str | os.PathLike, overrides: tuple[str, ...] = ()) -> Config:
    """Reads one experiment; ``overrides`` are "dotted.path=value" with the value in YAML.

    Relative paths in the file are relative to its folder, those of overrides to the current one. Raises ConfigError.
    """
    return files.load(Config, "an experiment", path, overrides, absolute_paths)


def absolute_paths(data: dict[str, Any], folder: Path) -> None:
    """Makes paths in an experiment's plain data absolute that are relative to ``folder``."""
    robot, balls = (str(data.get(key)) for key in ("robot", "balls"))
    named = {
        "robot": not (folder / robot).exists(),  # one that comes with the program
        "balls": Path(balls).suffix not in (".yaml", ".yml"),
        "definitions": "\n" in str(data.get("definitions")),  # the file's content
    }
    keys = ("balls", "model", "robot", "initial_policy", "definitions")
    files.make_absolute(data, tuple(key for key in keys if not named.get(key)), folder)
    absolute_samples(data.get("model"), folder)


def absolute_samples(model: Any, folder: Path) -> None:
    """Makes the path of the samples in a model's plain data absolute."""
    if isinstance(model, dict):
        files.make_absolute(model.get("randomise"), ("samples",), folder)


def parse(data: dict[str, Any], where: str) -> Config:
    """A Config from parsed YAML; ``where`` names its origin. Raises ConfigError with one line per mistake."""
    return files.validate(Config, data, where)
