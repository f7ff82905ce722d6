"""Settings of fine-tuning on a robot. Needs no JAX, as ``experiments.config.experiment``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ballmodel.io.validation import Count, Seed
from experiments.config import files
from experiments.config.experiment import Config, Rewards, refuse_unknown_terms
from experiments.config.optimiser import Constant, EliteFraction, EmaDecay, NumDirections, Optimiser, Shaping, Step
from mjx_tt.env.reward_weights import MEASURED_WEIGHTS

# Policies by first-order gradients return a third of their balls where the paper's sigma moves them, and learn from
# that where to go (docs/results/fine-tuning.md).
NEAR = {"sigma": 0.01, "step.learning_rate": 0.0015}


class FineTuning(Shaping):
    """Fine-tuning of one policy on a robot. The defaults are the paper's "real fine-tuning"."""

    updates: Count = 70
    """The paper's cycles have 60 or 70."""
    num_directions: NumDirections = 5
    repeats: Count = 3
    """Episodes, hence balls, per perturbation."""
    elite_fraction: EliteFraction = 0.6
    step: Step = Step(kind="sgd", learning_rate=0.00375, schedule=Constant(kind="constant"))
    """From the gradient estimate to a change of the parameters."""
    ema_decay: EmaDecay = 0.0
    rewards: Literal["sim", "real"] | Rewards = "real"
    """The paper's weights by name, or a mapping that changes single ones; only terms measured on a robot count."""
    observation_statistics: Literal["frozen", "merged"] = "frozen"
    """Those of the training throughout, or with each update's observations merged into them, as the authors' library
    does."""
    evaluation_balls: Annotated[int, Field(ge=2)] = 50
    """Balls played before the first update and again after the last, unperturbed."""
    seed: Seed = 0
    """Of the perturbations."""

    @model_validator(mode="after")
    def _measured(self) -> FineTuning:
        measured = ", ".join(MEASURED_WEIGHTS)
        given = Rewards.model_validate({"base": self.rewards}) if isinstance(self.rewards, str) else self.rewards
        if given.base == "sim":
            raise ValueError(f"rewards: expected weights based on real, got sim; a robot measures only {measured}")
        refuse_unknown_terms("rewards", given, measured)
        for name, weight in given.changed.items():
            if weight and name not in MEASURED_WEIGHTS:
                raise ValueError(f"rewards.{name}: expected 0, got {weight}; a robot measures only {measured}")
        return self

    @property
    def episodes_per_update(self) -> int:
        return 2 * self.num_directions * self.repeats

    def optimiser(self) -> Optimiser:
        """The same settings as the optimiser section of an experiment."""
        shared = {name: getattr(self, name) for name in type(self).model_fields if name in Optimiser.model_fields}
        return Optimiser(**shared, common_random_numbers=False)


def near(trained: Config | None) -> bool:
    """True for a policy that NEAR's settings are for, by the experiment that trained it."""
    return trained is not None and trained.optimiser.gradient == "first_order"


def load(path: str | Path | None = None, overrides: tuple[str, ...] = (), trained: Config | None = None) -> FineTuning:
    """The defaults, changed by a YAML of ``FineTuning``'s keys and then by "dotted.path=value". Raises ConfigError.

    trained: the experiment that trained the policy; the defaults of one by first-order gradients are NEAR's
    """
    data, where = FineTuning().model_dump(mode="json"), "--set"
    for key, value in NEAR.items() if near(trained) else ():
        files.apply_override(data, f"{key}={value}")
    if path is not None:
        data, where = data | files.read_mapping(path), str(path)
    for override in overrides:
        files.apply_override(data, override)
    return files.validate(FineTuning, data, where)
