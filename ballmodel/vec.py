"""Three-vectors with the component axis first.

Written out over the three components so that the compiler sees element-wise operations only and fuses them into one
loop over the batch; a reduction over an axis of three would end each fusion.
"""

from __future__ import annotations

import jax.numpy as jnp

TINY = 1e-12  # keeps the gradient and the direction of a zero vector finite


def dot(a, b):
    """a . b over the first axis: (3, ...), (3, ...) -> (...)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    """a x b over the first axis: (3, ...), (3, ...) -> (3, ...)."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def norm(a):
    """Euclidean length over the first axis, at least TINY: (3, ...) -> (...)."""
    return jnp.sqrt(jnp.maximum(dot(a, a), TINY * TINY))
