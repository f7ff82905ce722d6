"""Keys of Blackbox Gradient Sensing in a YAML: perturbations, elites, and the step."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator

from ballmodel.io.validation import Count, Decay, Positive, Section

# Keys of the optimiser, which training and fine-tuning share but for their defaults; see also ``Shaping``.
NumDirections = Annotated[Count, Field(description="Antithetic pairs of perturbations per update.")]
EliteFraction = Annotated[float, Field(gt=0, le=1, description="Share of the pairs that become elites.")]
EmaDecay = Annotated[
    Decay, Field(description="Decay per update of the moving average of the parameters, which is exported; 0: none.")
]


class Constant(Section):
    """The learning rate never changes."""

    kind: Literal["constant"]
    """This schedule."""


class Cosine(Section):
    """The learning rate holds, then falls along half a cosine until the last update."""

    kind: Literal["cosine"]
    """This schedule."""
    final: Positive = 0.0005
    """Learning rate after the last update."""
    hold: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """Share of the updates before the fall."""


class Change(Section):
    """A new learning rate from an update on."""

    update: Count
    """First update that has the new rate."""
    learning_rate: Positive
    """From then on."""


class Piecewise(Section):
    """The learning rate changes at given updates."""

    kind: Literal["piecewise"]
    """This schedule."""
    changes: Annotated[list[Change], Field(min_length=1)]
    """In the order of their updates."""

    @model_validator(mode="after")
    def _increasing(self) -> Piecewise:
        starts = [change.update for change in self.changes]
        if any(later <= earlier for earlier, later in itertools.pairwise(starts)):
            raise ValueError(f"the updates must increase, got {starts}")
        return self


class Step(Section):
    """From a gradient estimate to a change of the parameters."""

    kind: Literal["adam", "sgd"] = "adam"
    """Adam, or the plain gradient."""
    learning_rate: Positive = 0.01
    """Before the schedule changes it."""
    b1: Decay = 0.9
    """Adam's decay of the first moment; sgd does not use it."""
    b2: Decay = 0.99
    """Adam's decay of the second moment; sgd does not use it."""
    weight_decay: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Share by which an update shrinks the parameters, over the learning rate."""
    schedule: Annotated[Constant | Cosine | Piecewise, Field(discriminator="kind")] = Cosine(kind="cosine")
    """Change of the learning rate over the updates."""


class SigmaFall(Section):
    """The scale of the perturbations holds, then falls along half a cosine until the last update."""

    final: Positive
    """Scale after the last update."""
    hold: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """Share of the updates before the fall."""


class Shaping(Section):
    """Keys of Blackbox Gradient Sensing that training and fine-tuning share with their defaults."""

    model_config = ConfigDict(
        json_schema_extra={"renamed": {"pairs": "num_directions", "keep": "elite_fraction", "average": "ema_decay"}}
    )

    sigma: Positive = 0.025
    """Scale of the perturbations."""
    rank: Literal["abs", "signed", "max"] = "abs"
    """Pairs are ranked by |D|, by D or by their better member, D the difference of their returns."""
    weighting: Literal["returns", "centered_rank"] = "returns"
    """Weights follow the returns or their centred ranks."""
    normalise: Literal["std", "none"] = "std"
    """Weights are divided by the standard deviation of the elites' returns."""
    orthogonal: bool = True
    """Orthogonal perturbations; false: independent ones."""
    scale: Literal["sqrt_d", "chi"] = "sqrt_d"
    """Norm of orthogonal perturbations: the root of their dimension, or as of Gaussian vectors."""


class Optimiser(Shaping):
    """Blackbox Gradient Sensing. The defaults are the recipe that trains best here; paper.yaml has the paper's."""

    gradient: Literal["zeroth_order", "first_order"] = "zeroth_order"
    """Zeroth-order: BGS, from the returns of perturbed policies. First-order: derivatives of a smooth objective through
    the simulation at the same policies; of these keys only sigma, pairs, repeats, step and average count then."""
    num_directions: NumDirections = 100
    repeats: Count = 10
    """Episodes per perturbation."""
    sigma_fall: SigmaFall | None = None
    """Smaller perturbations later on: more returned in this simulation, fewer in another world; null: none."""
    elite_fraction: EliteFraction = 1.0
    step: Step = Step()
    """From the gradient estimate to a change of the parameters."""
    ema_decay: EmaDecay = 0.98
    common_random_numbers: bool = True
    """Both members of a pair meet the same balls, latencies and noise."""
    initial_scale: Positive = 0.1
    """Standard deviation of the random first parameters."""
