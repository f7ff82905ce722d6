"""A study's rallies with virtual players: every model with its own player and with others, in one compiled call."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from ballmodel.registry import Balls
from experiments.config import build
from experiments.config.study import Study
from experiments.study.analysis import scoring
from experiments.study.target_domain.virtual import VirtualReality
from mjx_tt.env.policy import Policy
from mjx_tt.rally import human_player
from mjx_tt.rally.simulator import Box, RallyResult

EVALUATION = 7  # purpose of a key, beside those of experiments.config.build
Pairings = Sequence[tuple[str, str, str]]  # trainer, evaluator, model


def play(
    study: Study,
    reality: VirtualReality,
    seed: int,
    pairings: Pairings,
    policies: Sequence[Policy],
    balls: Sequence[Balls],
) -> RallyResult:
    """Rallies of each pairing in ``evaluation.lanes`` parallel sessions. Arrays are NumPy, sessions last.

    balls: what each policy was trained for
    """
    sessions, settings = study.evaluation.lanes, study.evaluation
    people = human_player.stack([reality.player(evaluator) for _, evaluator, _ in pairings])
    policy, box = _stack(policies, balls, lambda stacked: jnp.repeat(stacked, sessions, axis=-1))
    result = reality.simulator.play(
        policy,
        jax.tree.map(lambda leaf: jnp.repeat(leaf, sessions), people),
        reality.known,
        build.key(seed, EVALUATION),
        settings.rallies // sessions,
        box,
        settings.max_touches,
    )
    return jax.tree.map(np.asarray, result)


def _stack(policies: Sequence[Policy], balls: Sequence[Balls], spread: Callable[[Array], Array]) -> tuple[Policy, Box]:
    """Policies and the boxes of their balls, one (..., n) array each, spread over the batch axis."""

    def stack(*arrays: ArrayLike) -> Array:
        return spread(jnp.stack([jnp.asarray(a) for a in arrays], axis=-1))

    boxes = [Box.of(one) for one in balls]
    return jax.tree.map(stack, *policies), Box(stack(*(b.low for b in boxes)), stack(*(b.high for b in boxes)))


def score(seed: int, pairings: Pairings, result: RallyResult, sessions: int) -> scoring.Rallies:
    """All rallies as scored lines; the sessions of a pairing count as one, their rallies in turn."""
    parts = []
    for i, pairing in enumerate(pairings):
        mine = slice(i * sessions, (i + 1) * sessions)
        parts.append(
            scoring.score_rallies(seed, *pairing, "", result.length[:, mine].ravel(), result.end[:, mine].ravel())
        )
    return scoring.join(parts)


def summarise(rallies: scoring.Rallies) -> dict[str, float]:
    """Mean length of the reported rallies by model, played by their own trainers."""
    own = rallies.take(rallies.own & rallies.selected)
    return {model: float(own.length[own.model == model].mean()) for model in dict.fromkeys(own.model.tolist())}
