"""Trains the small classifier that orders the places where the picture changes."""

from __future__ import annotations

from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.vision.crops import Crops
from robot_io.vision.detector import AROUND, PLACE, QUARTER, SIZE, describe_places, find_places

HIDDEN = 32
BATCH = 512
WITHIN = 2.0  # [quarter px] of a place's middle from the ball's


def collect_places(crops: Crops) -> tuple[np.ndarray, np.ndarray]:
    """Features (n, 245) of the places that change within the crops' fine windows, and which are balls (n,)."""
    features, balls = [], []
    offset = AROUND / QUARTER - (QUARTER - 1) / 2 / QUARTER
    for coarse, label in zip(crops.coarse, crops.labels, strict=True):
        small = [cv2.resize(coarse[..., t], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for t in range(3)]
        places = find_places(small)
        low, high = AROUND // QUARTER, (AROUND + SIZE) // QUARTER
        places = places[((places >= low) & (places < high)).all(1)]
        if not len(places):
            continue
        small = [cv2.copyMakeBorder(s, *(PLACE,) * 4, cv2.BORDER_REPLICATE) for s in small]
        features.append(describe_places(small, places))
        away = np.abs(places - (label[2:0:-1] / QUARTER + offset)).max(1)
        balls.append((away < WITHIN) & (label[0] > 0))
    return np.concatenate(features), np.concatenate(balls).astype(np.float32)


def train_search(features: np.ndarray, balls: np.ndarray, epochs: int = 12, seed: int = 0) -> Any:
    """Layers of the classifier, fitted by logistic regression's cost."""
    rng = np.random.default_rng(seed)
    layers: Any = {
        "first": {"kernel": rng.normal(0, 0.06, (features.shape[1], HIDDEN)), "bias": np.zeros(HIDDEN)},
        "second": {"kernel": rng.normal(0, 0.2, (HIDDEN, 1)), "bias": np.zeros(1)},
    }
    layers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layers)
    steps = epochs * (len(balls) // BATCH)
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
