"""Trains the ball network on crops, by JAX on this machine's processor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from experiments.vision import network
from experiments.vision.crops import Crops

BATCH = 96
RATE = 3e-3


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


def draw_batches(crops: Crops, rng: np.random.Generator) -> Iterator[Crops]:
    """Random batches for ever."""
    while True:
        chosen = np.sort(rng.choice(len(crops), BATCH, replace=False))
        yield augment(Crops(crops.fine[chosen], crops.coarse[chosen], crops.labels[chosen]), rng)


def train(
    crops: Crops,
    steps: int,
    seed: int = 0,
    params: Any = None,
    rate: float = RATE,
    report: Callable[[int, float, Any], object] = lambda step, cost, params: None,
) -> Any:
    """Parameters after ``steps`` batches, from ``params`` on where there are any; ``report`` hears every 200 steps."""
    params = network.start(jax.random.key(seed)) if params is None else params
    schedule = optax.cosine_onecycle_schedule(steps, rate, 0.1)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=1e-4))

    @jax.jit
    def advance(params: Any, state: Any, fine: Any, coarse: Any, labels: Any) -> Any:
        cost = lambda p: network.loss(network.apply(p, fine, coarse), labels)  # noqa: E731
        value, gradient = jax.value_and_grad(cost)(params)
        updates, state = optimiser.update(gradient, state, params)
        return optax.apply_updates(params, updates), state, value

    state, costs = optimiser.init(params), []
    for step, batch in zip(range(1, steps + 1), draw_batches(crops, np.random.default_rng(seed)), strict=False):
        params, state, value = advance(params, state, batch.fine, batch.coarse, batch.labels)
        costs.append(value)
        if step % 200 == 0:
            report(step, float(np.mean(costs[-200:])), params)
    return params


def save(path: str | Path, params: Any) -> None:
    """Writes parameters to an NPZ."""
    flat = jax.tree_util.tree_leaves_with_path(params)
    np.savez(path, **{"/".join(k.key for k in keys): np.asarray(value) for keys, value in flat})  # type: ignore[arg-type]


def load(path: str | Path) -> Any:
    """Parameters of an NPZ that ``save`` wrote."""
    params: dict[str, Any] = {}
    for name, value in np.load(path).items():
        layer, leaf = name.split("/")
        params.setdefault(layer, {})[leaf] = value
    return params
