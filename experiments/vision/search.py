"""Trains the small classifier that orders the places where the picture changes."""

from __future__ import annotations

from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.vision.crops import draw_shots
from robot_io.vision.detector import PLACE, QUARTER, SIZE, describe_places, find_places, shrink

HIDDEN = 32
BATCH = 512
WITHIN = 2.0  # [quarter px] of a place's middle from the ball's


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
        features.append(
            describe_places([cv2.copyMakeBorder(s, *(PLACE,) * 4, cv2.BORDER_REPLICATE) for s in small], places)
        )
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
    steps = epochs * max(len(balls) // BATCH, 1)
    optimiser = optax.adamw(optax.cosine_decay_schedule(2e-3, steps), weight_decay=1e-3)

    @jax.jit
    def advance(layers: Any, state: Any, x: Any, y: Any) -> Any:
        def cost(layers: Any) -> Any:
            h = jax.nn.relu(x @ layers["first"]["kernel"] + layers["first"]["bias"])
            score = (h @ layers["second"]["kernel"] + layers["second"]["bias"])[:, 0]
            return optax.sigmoid_binary_cross_entropy(score, y).mean()

        value, gradient = jax.value_and_grad(cost)(layers)
        updates, state = optimiser.update(gradient, state, layers)
        return optax.apply_updates(layers, updates), state, value

    state = optimiser.init(layers)
    for _ in range(steps):
        chosen = rng.integers(0, len(balls), BATCH)
        layers, state, _ = advance(layers, state, features[chosen], balls[chosen])
    return jax.tree.map(np.asarray, layers)
