"""The step: from a gradient estimate to a change of theta, as optax transformations.

Every function here is cached: the same arguments return the same object, so two equal configurations hash alike and
share one compilation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import jax
import optax

Schedule = Callable[[jax.Array], jax.Array | float]  # of the number of updates so far

KINDS = ("sgd", "adam")
PAPER_LEARNING_RATE = 0.00375  # Abeyruwan et al. 2022, appendix, table of BGS hyper-parameters: step size alpha


@cache
def make(
    kind: str = "sgd",
    learning_rate: float | Schedule = PAPER_LEARNING_RATE,
    b1: float = 0.9,
    b2: float = 0.999,
    weight_decay: float = 0.0,
) -> optax.GradientTransformation:
    """The transformation of kind "sgd" (plain step, the paper's) or "adam" (decay rates b1 and b2; unused by "sgd").

    weight_decay: every update also shrinks the parameters by learning_rate x weight_decay (Loshchilov & Hutter 2019,
    "Decoupled weight decay regularization"). Without it the noise of the gradient estimates lets their norm grow for
    ever, until perturbations of a fixed sigma change little (Salimans et al. 2017, "Evolution strategies as a scalable
    alternative to reinforcement learning").

    ``learning_rate`` is a positive number or a schedule: ``cosine``, ``piecewise`` or any optax schedule over updates.
    Raises ValueError naming the argument, what was given and what is allowed.
    """
    if kind not in KINDS:
        raise ValueError(f"optimizers.make: kind = {kind!r}, allowed are {KINDS}")
    if not callable(learning_rate):
        _positive("make", "learning_rate", learning_rate)
    for name, value in (("b1", b1), ("b2", b2)):
        if not 0 <= value < 1:
            raise ValueError(f"optimizers.make: {name} = {value}, allowed is [0, 1)")
    if not 0 <= weight_decay < float("inf"):
        raise ValueError(f"optimizers.make: weight_decay = {weight_decay}, allowed are finite numbers from 0 on")
    direction = optax.identity() if kind == "sgd" else optax.scale_by_adam(b1=b1, b2=b2)
    decay = [optax.add_decayed_weights(weight_decay)] if weight_decay else []
    return optax.chain(direction, *decay, optax.scale_by_learning_rate(learning_rate))


@cache
def cosine(value: float, final: float, updates: int, hold: float = 0.5) -> Schedule:
    """Stays at ``value`` for the first ``hold`` fraction of ``updates``, then falls to ``final`` along half a cosine.

    Raises ValueError for a rate that is not positive, hold outside [0, 1) or fewer than 1 update.
    """
    _positive("cosine", "value", value)
    _positive("cosine", "final", final)
    if updates < 1:
        raise ValueError(f"optimizers.cosine: updates = {updates}, at least 1 is needed")
    if not 0 <= hold < 1:
        raise ValueError(f"optimizers.cosine: hold = {hold}, allowed is [0, 1)")
    held = int(hold * updates)
    fall = optax.cosine_decay_schedule(value, decay_steps=updates - held, alpha=final / value)
    return optax.join_schedules([optax.constant_schedule(value), fall], [held])


@cache
def piecewise(value: float, changes: tuple[tuple[int, float], ...]) -> Schedule:
    """``value`` until the first change; each change (update, new value) holds from that update on.

    Raises ValueError for a rate that is not positive or for updates that do not increase from at least 1.
    """
    starts, values = [0, *(start for start, _ in changes)], [value, *(new for _, new in changes)]
    if any(later <= earlier for earlier, later in pairwise(starts)):
        raise ValueError(
            f"optimizers.piecewise: changes at updates {starts[1:]}, allowed are increasing ones from 1 on"
        )
    for given in values:
        _positive("piecewise", "value", given)
    return optax.join_schedules([optax.constant_schedule(v) for v in values], starts[1:])


def _positive(function: str, name: str, value: float) -> None:
    if not 0 < value < float("inf"):
        raise ValueError(f"optimizers.{function}: {name} = {value}, allowed are positive finite numbers")
