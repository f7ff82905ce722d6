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
from mjx_tt.rally.simulator import Box

EVALUATION = 7  # purpose of a key, beside those of experiments.config.build


def play(
    study: Study,
    reality: VirtualReality,
    seed: int,
    pairings: Sequence[tuple[str, str, str]],
    policies: Sequence[Policy],
    balls: Sequence[Balls],
) -> scoring.Rallies:
    """Rallies of each pairing (trainer, evaluator, model) in ``evaluation.lanes`` parallel sessions, in turn.

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
    # (rallies of a session, sessions of all pairings): those of a pairing count as one session.
    each = zip(*(np.split(np.asarray(x), len(pairings), axis=1) for x in (result.length, result.end)), strict=True)
    return scoring.join(
        scoring.score_rallies(seed, *pairing, "", length.ravel(), end.ravel())
        for pairing, (length, end) in zip(pairings, each, strict=True)
    )


def _stack(policies: Sequence[Policy], balls: Sequence[Balls], spread: Callable[[Array], Array]) -> tuple[Policy, Box]:
    """Policies and the boxes of their balls, one (..., n) array each, spread over the batch axis."""

    def stack(*arrays: ArrayLike) -> Array:
        return spread(jnp.stack([jnp.asarray(a) for a in arrays], axis=-1))

    boxes = [Box.of(one) for one in balls]
    return jax.tree.map(stack, *policies), Box(stack(*(b.low for b in boxes)), stack(*(b.high for b in boxes)))
