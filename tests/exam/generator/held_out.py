"""Held-out prediction with the second physics: state from the first 30 % of a flight, predict the rest.

It judges a model by its numbers alone: an extended model's YAML is read as a World, so the gain of a diagnosis and that
of the true model are measured by the same code, on balls that the diagnosis never saw.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import yaml

from tests.exam.generator.sessions import SIGMA, Balls, Log
from tests.exam.generator.world import World, fly, seen

SHARE = 0.3  # of the samples fit the state
GUESS = 16  # samples behind the first guess of a state
ROUNDS = 6
HUBER = 3.0  # deviations beyond which a sample counts linearly
# Dotted paths of a model file and the World's numbers, where the last part is not already the name.
PATHS = {
    "ball.table.restitution": "restitution",
    "ball.table.restitution_slope": "restitution_slope",
    "ball.table.friction": "friction",
    "ball.table.tangential_restitution": "grip",
    "ball.table.height": "height",
    "ball.table.tilt_x": "tilt_x",
    "ball.table.tilt_y": "tilt_y",
    "sensing.smoothing": "smoothing",
    "sensing.jitter": "jitter",
}


@dataclass(frozen=True)
class Model:
    """A world and what is known of the balls' spins before one is seen."""

    world: World
    spin_mean: np.ndarray  # (3,) [rad/s] of balls towards -y
    spin_std: np.ndarray  # (3,)


def nominal() -> Model:
    return Model(World(), np.zeros(3), np.zeros(3))


def load(path: Path) -> Model:
    """The World that a model YAML describes. Keys that a ball in front of the racket does not feel are left out."""
    tree = yaml.safe_load(Path(path).read_text()) or {}
    flat = dict(_flatten({k: v for k, v in tree.items() if k in ("ball", "sensing", "ball_spin")}))
    known = {f.name for f in fields(World)}
    values = {}
    for key, value in flat.items():
        group = key.rsplit(".", 1)[0]
        name = PATHS.get(key) or (key.split(".")[-1] if group in ("ball.flight", "sensing") else None)
        if name in known and isinstance(value, (int, float)):
            values[name] = float(value)
    spin = [np.array([float(flat.get(f"ball_spin.{kind}_{a}", 0.0)) for a in "xyz"]) for kind in ("mean", "std")]
    return Model(replace(World(), **values), *spin)


def _flatten(tree: dict, prefix: str = ""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def errors(model: Model, log: Log, human: np.ndarray) -> np.ndarray:
    """RMS distance (B,) [m] of the later samples from their prediction; NaN where a ball has too few."""
    first = np.argmax(np.isfinite(log.position[0]), axis=0)
    ball = np.arange(human.size)
    time = log.time - log.time[first, ball]
    measured = log.position
    kept = np.all(np.isfinite(measured), axis=0)
    count = kept.sum(axis=0)
    early = kept & (np.cumsum(kept, axis=0) <= np.ceil(SHARE * count))
    start = fit_states(model, np.where(kept, time, 0.0), np.nan_to_num(measured), early, human)
    predicted = predict(model, start, time)
    later = kept & ~early & np.all(np.isfinite(predicted), axis=0)
    square = np.sum((predicted - measured) ** 2, axis=0)
    return np.sqrt(np.where(later, square, 0.0).sum(axis=0) / np.where(later.any(axis=0), later.sum(axis=0), np.nan))


def predict(model: Model, start: np.ndarray, time: np.ndarray, tiles: int = 1) -> np.ndarray:
    """Positions (3, T, B) at times (T, B) since the start; NaN after the second contact."""
    world = model.world if tiles == 1 else model.world.tiled(tiles)
    flight = fly(world, start, float(np.nanmax(time) / np.min(world.clock_rate)) + 0.05, step=4e-3)
    return seen(world, flight, np.nan_to_num(time))


def fit_states(model: Model, time, measured, early, human) -> np.ndarray:
    """States (9, B) at the first sample, from the samples (T, B) marked ``early``; spins by these and their prior.

    time: (T, B) [s] since the first sample; measured: (3, T, B) [m]; human: (B,), whether a ball flies towards -y.
    """
    balls = human.size
    # A parabola through what lies before any bounce starts the search.
    airborne = early & (np.cumsum(early, axis=0) <= GUESS)
    powers = np.where(airborne, time, 0.0)[None] ** np.arange(3)[:, None, None] * airborne
    moments = np.einsum("itb,jtb->bij", powers, powers)
    sums = np.einsum("itb,atb->bia", powers, measured * airborne)
    guess = np.linalg.solve(moments, sums)
    mean = model.spin_mean[:, None] * np.where(human, [[1.0], [1.0], [1.0]], [[-1.0], [-1.0], [1.0]])
    start = np.concatenate([guess[:, 0].T, guess[:, 1].T, mean])
    free = [*range(6), *(6 + a for a in range(3) if model.spin_std[a] > 0)]
    steps = np.array([1e-4] * 3 + [1e-3] * 3 + [0.1] * 3)
    last = np.where(early.any(axis=1))[0].max() + 1
    time, measured, early = time[:last], measured[:, :last], early[:last]
    for _ in range(ROUNDS):
        varied = np.tile(start, len(free) + 1)
        for k, unknown in enumerate(free):
            varied[unknown, (k + 1) * balls : (k + 2) * balls] += steps[unknown]
        paths = predict(model, varied, np.tile(time, len(free) + 1), len(free) + 1)
        paths = paths.reshape(3, last, len(free) + 1, balls)
        residual = measured - paths[:, :, 0]
        slopes = (paths[:, :, 1:] - paths[:, :, :1]) / steps[free][:, None]  # (3, T, K, B)
        distance = np.sqrt(np.sum(residual**2, axis=0)) / SIGMA
        weight = early * np.minimum(1.0, HUBER / np.maximum(distance, 1e-9)) / SIGMA**2
        normal = np.einsum("atkb,tb,atmb->bkm", slopes, weight, slopes)
        right = np.einsum("atkb,tb,atb->bk", slopes, weight, residual)
        for k, unknown in enumerate(free):
            if unknown >= 6:
                precision = model.spin_std[unknown - 6] ** -2
                normal[:, k, k] += precision
                right[:, k] += precision * (mean[unknown - 6] - start[unknown])
        start = start.copy()
        start[free] += np.linalg.solve(normal, right[..., None])[..., 0].T
    return start


def compare(models: dict[str, Model], log: Log, balls: Balls) -> dict[str, float]:
    """Median over balls of each model's error [mm], on the balls that every model can predict."""
    found = {name: errors(model, log, balls.human) for name, model in models.items()}
    good = np.all([np.isfinite(e) for e in found.values()], axis=0)
    return {name: 1e3 * float(np.median(e[good])) for name, e in found.items()}
