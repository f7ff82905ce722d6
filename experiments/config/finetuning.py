"""What may be set in fine-tuning on a robot. Needs no JAX, as ``experiments.config.experiment``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from experiments.config import validation
from experiments.config.experiment import (
    Constant,
    Count,
    Decay,
    Optimiser,
    Positive,
    Rewards,
    Section,
    Step,
    apply_override,
    read_yaml,
)
from experiments.errors import ConfigError

MEASURED = ("state_transition", "net_clearance", "hit_and_land", "fault")  # terms that a real episode tells


class FineTuning(Section):
    """Fine-tuning of one policy on a robot. The defaults are the paper's "real fine-tuning"."""

    updates: Count = 70
    """The paper's cycles have 60 or 70."""
    pairs: Count = 5
    """Antithetic pairs of perturbations per update."""
    repeats: Count = 3
    """Episodes, hence balls, per perturbation."""
    sigma: Positive = 0.025
    """Scale of the perturbations."""
    keep: Annotated[float, Field(gt=0, le=1)] = 0.6
    """Share of the pairs that become elites."""
    rank: Literal["abs", "signed", "max"] = "abs"
    weighting: Literal["returns", "centered_rank"] = "returns"
    normalise: Literal["std", "none"] = "std"
    orthogonal: bool = True
    scale: Literal["sqrt_d", "chi"] = "sqrt_d"
    step: Step = Step(kind="sgd", learning_rate=0.00375, schedule=Constant(kind="constant"))
    average: Decay = 0.0
    """Decay per update of the moving average of the parameters, which is what is evaluated and exported; 0: none."""
    rewards: Literal["sim", "real"] | Rewards = "real"
    """The paper's weights by name, or a mapping that changes single ones; only terms measured on a robot count."""
    evaluation_balls: Annotated[int, Field(ge=2)] = 50
    """Balls played before the first update and again after the last, unperturbed."""
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Of the perturbations."""

    @property
    def episodes_per_update(self) -> int:
        return 2 * self.pairs * self.repeats

    def optimiser(self) -> Optimiser:
        """The same settings as the optimiser section of an experiment."""
        names = "pairs repeats sigma keep rank weighting normalise orthogonal scale step average".split()
        return Optimiser(**{name: getattr(self, name) for name in names}, common_random_numbers=False)


def load(path: str | Path | None = None, overrides: tuple[str, ...] = ()) -> FineTuning:
    """The defaults, changed by a YAML of ``FineTuning``'s keys and then by "dotted.path=value". Raises ConfigError."""
    data, where = FineTuning().model_dump(mode="json"), "--set"
    if path is not None:
        try:
            given = read_yaml(Path(path).read_text(encoding="utf-8"), str(path))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from None
        if not isinstance(given, dict):
            raise ConfigError(f"{path}: fine-tuning is a mapping with the keys {', '.join(FineTuning.model_fields)}")
        data, where = data | given, str(path)
    for override in overrides:
        apply_override(data, override)
    return parse(data, where)


def parse(data: dict[str, Any], where: str) -> FineTuning:
    """FineTuning from parsed YAML; ``where`` names its origin. Raises ConfigError with one line per mistake."""
    try:
        settings = FineTuning.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{where}: {line}" for line in validation.lines(error, FineTuning))) from None
    if settings.rewards == "sim" or not isinstance(settings.rewards, str):
        _check_rewards(settings.rewards, where)
    return settings


def _check_rewards(rewards: str | Rewards, where: str) -> None:
    if isinstance(rewards, str) or rewards.base == "sim":
        raise ConfigError(
            f"{where}: rewards: the weights for simulation ask for terms that a robot does not measure; "
            f"base them on real and weigh only {', '.join(MEASURED)}"
        )
    for name, weight in rewards.model_dump(exclude={"base"}, exclude_none=True).items():
        if weight and name not in MEASURED:
            raise ConfigError(
                f"{where}: rewards.{name} = {weight}: not measured on a robot, must be 0; "
                f"terms with a weight: {', '.join(MEASURED)}"
            )
