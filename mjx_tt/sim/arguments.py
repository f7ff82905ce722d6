"""The numbers of a simulation as a compiled program's arguments: compiled once, it serves other numbers as well.

Arguments are all numbers that differ from the nominal model's and the samples that others are drawn from. What is left
decides the program: which numbers these are, what stays nominal, ranges, how flights are integrated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_tt.pytrees import pytree
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Drawing, Randomised, Samples


@pytree
class Arguments:
    """A simulation's numbers by dotted path, and what is drawn for every episode."""

    numbers: dict[str, Float[Array | np.ndarray, ""]]
    drawing: tuple[Drawing, ...]


def arguments(model: SimModel, randomise: tuple[Randomised, ...]) -> Arguments:
    """Arguments of a program that draws from these."""
    numbers: dict[str, Array | np.ndarray] = {
        path: np.asarray(value, np.float32) for path, value in _changed(model, randomise).items()
    }
    return Arguments(numbers, tuple(one.rows() if isinstance(one, Samples) else one for one in randomise))


def structure(model: SimModel, randomise: tuple[Randomised, ...]) -> dict[str, Any]:
    """All that decides the program, as plain data: equal for models whose arguments one program takes."""
    return {
        "changed": sorted(_changed(model, randomise)),
        "words": {path: value for path, value in models.paths(model).items() if isinstance(value, str)},
        "drives": model.drives is not None,
        "joints": model.joints,
        "drawn": [
            {p: len(one.weight) for p in one.paths} if isinstance(one, Samples) else one.ends() for one in randomise
        ],
    }


def _changed(model: SimModel, randomise: tuple[Randomised, ...]) -> dict[str, float]:
    """Numbers by path that are used, for nothing is drawn in their place, and not nominal."""
    nominal = models.paths(SimModel(joints=model.joints))
    drawn = {path for one in randomise for path in one.paths}
    given = {path: value for path, value in models.paths(model).items() if not isinstance(value, str)}
    return {path: value for path, value in given.items() if path not in drawn and value != nominal[path]}
