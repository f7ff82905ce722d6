"""A study's rallies: every model with its own player and with others, in one compiled call, under code names."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from ballmodel.io.atomic_files import replacing
from ballmodel.registry import Balls
from experiments.config import build
from experiments.config.study import Study
from experiments.study.analysis import effect_costs, scoring
from experiments.study.blind import protocol
from experiments.study.target_domain import hidden_effects as realities
from experiments.study.target_domain.finetuning import VirtualReality
from mjx_tt.env.policy import Policy
from mjx_tt.rally import human_player
from mjx_tt.rally.simulator import Box, RallyResult

EVALUATIONS, LOGS = "evaluations.csv", "evaluations"
LOGGED_TOUCHES = 30  # human hits that are kept, per rally and lane on average
EVALUATION, EFFECTS = 7, 8  # purposes of keys, beside those of experiments.config.build


def play(
    study: Study,
    reality: VirtualReality,
    seed: int,
    pairings: list[tuple[str, str, str]],
    policies: list[Policy],
    boxes: list[Balls],
) -> RallyResult:
    """Rallies of each pairing (trainer, evaluator, model) in ``evaluation.lanes`` sessions side by side.

    boxes: what each policy was trained for. Arrays are NumPy.
    """
    lanes, settings = study.evaluation.lanes, study.evaluation

    def spread(arrays: Iterable[ArrayLike]) -> Array:  # one array (n, ...) per pairing -> (n, pairings x lanes)
        return jnp.repeat(jnp.stack([jnp.asarray(a) for a in arrays], axis=-1), lanes, axis=-1)

    policy = jax.tree.map(lambda *arrays: spread(arrays), *policies)
    people = human_player.stack([reality.player(evaluator) for _, evaluator, _ in pairings])
    person = jax.tree.map(lambda leaf: jnp.repeat(leaf, lanes), people)
    low, high = (spread(ends) for ends in zip(*((box.low, box.high) for box in map(Box.of, boxes)), strict=True))
    rallies = settings.rallies // lanes
    result = reality.simulator.play(
        policy,
        person,
        reality.known,
        build.key(seed, EVALUATION),
        rallies,
        Box(low, high),
        settings.max_touches,
        LOGGED_TOUCHES * rallies,
    )
    return jax.tree.map(np.asarray, result)


def play_without(
    study: Study,
    reality: VirtualReality,
    seed: int,
    models: list[tuple[str, str]],
    policies: list[Policy],
    boxes: list[Balls],
) -> list[effect_costs.Outcome]:
    """Rallies of each (player, model) in every world of ``effects.WORLDS``, ``evaluation.rallies`` each, in one call.

    boxes: what each policy was trained for. What the study's own reality
    lacks is left out of all worlds.
    """
    lanes, settings = study.evaluation.lanes, study.evaluation
    absent, everything = tuple(study.reality.without), tuple(realities.RANGES)
    special = {effect_costs.NOTHING: (), effect_costs.ALL: everything}
    left_out = [absent + special.get(world, (world,)) for world in effect_costs.WORLDS]
    outside = tuple(study.reality.outside)
    worlds = [realities.draw(seed, names, () if set(names) == set(everything) else outside) for names in left_out]
    people = [
        human_player.without_spin(person) if "spin" in names else person
        for names in left_out
        for person in (human_player.load(player) for player, _ in models)
    ]

    # Lanes: worlds x models x sessions.
    def per_model(arrays: Iterable[ArrayLike]) -> Array:
        each = jnp.stack([jnp.asarray(a) for a in arrays], axis=-1)
        return jnp.tile(jnp.repeat(each, lanes, axis=-1), len(worlds))

    policy = jax.tree.map(lambda *arrays: per_model(arrays), *policies)
    low, high = (per_model(ends) for ends in zip(*((box.low, box.high) for box in map(Box.of, boxes)), strict=True))
    person = jax.tree.map(lambda leaf: jnp.repeat(leaf, lanes), human_player.stack(people))
    world = realities.side_by_side(worlds, len(models) * lanes)
    result = reality.simulator.play(
        policy,
        person,
        world,
        build.key(seed, EFFECTS),
        settings.rallies // lanes,
        Box(low, high),
        settings.max_touches,
    )
    shape = (-1, len(worlds), len(models), lanes)
    length, end = (np.moveaxis(np.asarray(x).reshape(shape), 0, -1) for x in (result.length, result.end))
    counts = ~np.isin(end, [int(e) for e in scoring.FILTERED])
    return [
        effect_costs.Outcome(seed, player, model, without, int(counts[w, m].sum()), _mean(length[w, m][counts[w, m]]))
        for m, (player, model) in enumerate(models)
        for w, without in enumerate(effect_costs.WORLDS)
    ]


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def code_names(seed: int, pairings: list[tuple[str, str, str]]) -> list[str]:
    """A code for each pairing, one to one among the models that a player evaluates."""
    codes: dict[tuple[str, str, str], str] = {}
    for evaluator in dict.fromkeys(e for _, e, _ in pairings):
        mine = [f"{trainer}/{model}" for trainer, e, model in pairings if e == evaluator]
        drawn = protocol.draw(mine, np.random.default_rng([seed, zlib.crc32(evaluator.encode())]))
        codes |= {(t, e, m): drawn[f"{t}/{m}"] for t, e, m in pairings if e == evaluator}
    return [codes[pairing] for pairing in pairings]


def rallies_of(
    seed: int, pairings: list[tuple[str, str, str]], codes: list[str], result: RallyResult, lanes: int
) -> scoring.Rallies:
    """All rallies as scored lines; the sessions of a pairing count as one, their rallies in turn."""
    parts = []
    for i, (pairing, code) in enumerate(zip(pairings, codes, strict=True)):
        mine = slice(i * lanes, (i + 1) * lanes)
        parts.append(scoring.scored(seed, *pairing, code, result.length[:, mine].ravel(), result.end[:, mine].ravel()))
    return scoring.join(parts)


def save_logs(folder: Path, seed: int, pairings: list[tuple[str, str, str]], result: RallyResult, lanes: int) -> None:
    """Writes each pairing's balls to ``folder``/SEED_TRAINER_EVALUATOR_MODEL.npz, the balls last in every array."""
    folder.mkdir(parents=True, exist_ok=True)
    log = result.balls
    capacity = log.touch.shape[0]
    taken = np.arange(capacity)[:, None] < np.minimum(log.count, capacity)  # (capacity, L)
    for i, pairing in enumerate(pairings):
        mine = slice(i * lanes, (i + 1) * lanes)
        keep = taken[:, mine]
        # Rallies are numbered as ``rallies_of`` does: the first of each session, then the second of each, ...
        number = log.rally[:, mine] * lanes + np.arange(lanes)
        arrays = {
            "rally": number[keep],
            **{
                name: getattr(log, name)[..., mine][..., keep]
                for name in (
                    "touch",
                    "first",
                    "position",
                    "velocity",
                    "landing",
                    "hit",
                    "returned",
                    "return_landing",
                )
            },
        }
        path = folder / f"{seed}_{'_'.join(pairing)}.npz"
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)


def summary(rallies: scoring.Rallies, trainer: str | None = None) -> dict[str, float]:
    """Mean length of the reported rallies by model, played by their own trainers."""
    own = rallies.take(rallies.own & rallies.selected & (True if trainer is None else rallies.trainer == trainer))
    return {model: float(own.length[own.model == model].mean()) for model in dict.fromkeys(own.model.tolist())}
