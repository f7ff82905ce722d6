"""Trains the ball network on crops, and the small classifier that orders the places where the picture changes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.traverse_util import flatten_dict, unflatten_dict

from experiments.vision import network
from experiments.vision.crops import Crops, draw_shots
from robot_io.vision.detector import PLACE, QUARTER, SIZE, describe_places, find_places, shrink, widen

BATCH = 96
RATE = 3e-3
HIDDEN = 32  # of the search's classifier
PLACES = 512  # of its batches
WITHIN = 2.0  # [quarter px] of a place's middle from the ball's

Report = Callable[[int, float], object]  # hears the step and its mean cost, every 200 steps


def augment(frames: Crops, rng: np.random.Generator) -> Crops:
    """What other cameras do to the same scene: gamma, contrast, white balance, flicker, softness, noise, mirrors.

    Without it longer training finds fewer real balls.
    """
    n = len(frames)
    row = (n, 1, 1, 1)
    gamma = np.exp(rng.uniform(-0.9, 0.3, row)).astype(np.float32)
    factor = np.exp(rng.normal(0, 0.25, row) + rng.normal(0, 0.04, (n, 1, 1, 3)) * (rng.random(row) < 0.4)).astype(
        np.float32
    )
    red, blue = np.exp(rng.normal(0, 0.15, (2, *row))).astype(np.float32)
    level, strong = rng.uniform(0, 0.015, row).astype(np.float32), rng.random(n) < 0.25
    labels, mirrored = frames.labels.copy(), rng.random(n) < 0.5
    size = frames.fine.shape[2]
    parts: list[np.ndarray] = []
    for whole, colours in ((frames.fine, True), (frames.coarse, False)):
        x = whole.astype(np.float32) / 255.0
        x = x**gamma * factor
        if colours:
            x[:, ::2, ::2] *= red
            x[:, 1::2, 1::2] *= blue
        step = 2 if colours else 1  # pixels of one colour lie two apart
        y = x[strong]
        y[:, step:-step] = 0.25 * y[:, : -2 * step] + 0.5 * y[:, step:-step] + 0.25 * y[:, 2 * step :]
        y[:, :, step:-step] = 0.25 * y[:, :, : -2 * step] + 0.5 * y[:, :, step:-step] + 0.25 * y[:, :, 2 * step :]
        x[strong] = y
        x += rng.standard_normal(x.shape, np.float32) * (level if colours else level / 2)
        # A mirrored Bayer frame is one pixel off: columns 1 to the last but one keep their colours, the border repeats.
        y = x[mirrored][:, :, ::-1]
        if colours:
            y = np.concatenate([y[:, :, 1:], y[:, :, -2:-1]], 2)
        x[mirrored] = y
        parts.append(np.clip(x * 255.0, 0, 255).astype(np.uint8))
    there = mirrored & (labels[:, 0] > 0)
    labels[there, 1] = size - 2 - labels[there, 1]
    labels[there, 3] *= -1
    return Crops(parts[0], parts[1], labels)


def descend(
    params: Any,
    cost: Callable[..., Any],
    batches: Iterable[tuple],
    optimiser: optax.GradientTransformation,
    report: Report = lambda step, cost: None,
) -> Any:
    """Parameters after all batches; ``cost`` takes parameters and what a batch holds."""

    @jax.jit
    def advance(params: Any, state: Any, *batch: Any) -> Any:
        value, gradient = jax.value_and_grad(cost)(params, *batch)
        updates, state = optimiser.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, value

    state, costs = optimiser.init(params), []
    for step, batch in enumerate(batches, 1):
        params, state, value = advance(params, state, *batch)
        costs.append(value)
        if step % 200 == 0:
            report(step, float(np.mean(costs[-200:])))
    return params


def train(
    crops: Crops,
    steps: int,
    seed: int = 0,
    params: Any = None,
    rate: float = RATE,
    report: Report = lambda step, cost: None,
) -> Any:
    """Parameters after ``steps`` batches, from ``params`` on where there are any; ``report`` hears every 200 steps."""
    params, rng = network.start(jax.random.key(seed)) if params is None else params, np.random.default_rng(seed)
    schedule = optax.cosine_onecycle_schedule(steps, rate, 0.1)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=1e-4))

    def cost(params: Any, fine: Any, coarse: Any, labels: Any) -> Any:
        return network.loss(network.apply(params, fine, coarse), labels)

    def draw() -> tuple[np.ndarray, ...]:
        chosen = np.sort(rng.choice(len(crops), BATCH, replace=False))
        batch = augment(Crops(crops.fine[chosen], crops.coarse[chosen], crops.labels[chosen]), rng)
        return batch.fine, batch.coarse, batch.labels

    return descend(params, cost, (draw() for _ in range(steps)), optimiser, report)


def save(path: str | Path, params: Any) -> None:
    """Writes parameters to an NPZ."""
    np.savez(path, **flatten_dict(params, sep="/"))


def load(path: str | Path) -> Any:
    """Parameters of an NPZ that ``save`` wrote."""
    return unflatten_dict(dict(np.load(path)), sep="/")


def collect_places(count: int, tracks: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places that change in rendered crops, a quarter of them as of ordinary video.

    Args:
        count: crops.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws all.

    Returns:
        Features (k, 490) of places, and 1 for those that are balls (k,).
    """
    features, balls = [], []
    for shots in draw_shots(count, tracks, rng, video=0.25, dressed=0.4):
        low, high = shots.corner // QUARTER, (shots.corner + SIZE) // QUARTER
        small = [shrink(frame)[1] for frame in shots.frames]
        places = find_places(small)
        places = places[((places >= low[::-1]) & (places < high[::-1])).all(1)]
        if not len(places):
            continue
        features.append(describe_places([widen(s, PLACE) for s in small], places))
        spot = (shots.label[1:3] + shots.corner - (QUARTER - 1) / 2) / QUARTER
        balls.append((np.abs(places - spot[::-1]).max(1) < WITHIN) & (shots.label[0] > 0))
    return np.concatenate(features), np.concatenate(balls).astype(np.float32)


def train_search(features: np.ndarray, balls: np.ndarray, epochs: int = 12, seed: int = 0) -> Any:
    """Layers of the classifier, fitted by logistic regression's cost."""
    rng = np.random.default_rng(seed)
    layers: Any = {
        "first": {"kernel": rng.normal(0, 0.06, (features.shape[1], HIDDEN)), "bias": np.zeros(HIDDEN)},
        "second": {"kernel": rng.normal(0, 0.2, (HIDDEN, 1)), "bias": np.zeros(1)},
    }
    layers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layers)
    steps = epochs * max(len(balls) // PLACES, 1)
    optimiser = optax.adamw(optax.cosine_decay_schedule(2e-3, steps), weight_decay=1e-3)

    def cost(layers: Any, x: Any, y: Any) -> Any:
        h = jax.nn.relu(x @ layers["first"]["kernel"] + layers["first"]["bias"])
        score = (h @ layers["second"]["kernel"] + layers["second"]["bias"])[:, 0]
        return optax.sigmoid_binary_cross_entropy(score, y).mean()

    draws = (rng.integers(0, len(balls), PLACES) for _ in range(steps))
    batches = ((features[chosen], balls[chosen]) for chosen in draws)
    return jax.tree.map(np.asarray, descend(layers, cost, batches, optimiser))
