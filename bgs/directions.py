"""Perturbation directions for antithetic sampling.

Orthogonal ensembles lower the variance of the gradient estimate (Choromanski et al. 2018, "Structured evolution with
compact architectures"; used by BGS: Abeyruwan et al. 2022, appendix "Details on the BGS Algorithm").
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, PRNGKeyArray

SCALES = ("sqrt_d", "chi")


def sample(
    key: PRNGKeyArray,
    d: int,
    num_directions: int,
    orthogonal: bool = True,
    scale: str = "sqrt_d",
    dtype: DTypeLike = jnp.float32,
) -> Float[Array, "d num_directions"]:
    """Draws the directions of one update, shape (d, num_directions), one direction per column.

    orthogonal=True gives blocks of up to ``d`` mutually orthogonal columns, each block Haar-distributed and independent
    of the others. ``scale`` then sets the column norms: "sqrt_d" makes each exactly sqrt(d) (the authors' Iris);
    "chi" draws them from the chi distribution with d degrees of freedom, which makes every column a standard Gaussian
    vector (the paper's text). orthogonal=False gives independent standard Gaussian columns and does not use ``scale``.

    Raises ValueError for a size below 1 or an unknown scale.
    """
    if d < 1 or num_directions < 1:
        raise ValueError(f"directions.sample: d = {d} and num_directions = {num_directions} must both be at least 1")
    if scale not in SCALES:
        raise ValueError(f"directions.sample: scale = {scale!r}, allowed are {SCALES}")
    if not orthogonal:
        return jax.random.normal(key, (d, num_directions), dtype)
    key_basis, key_norm = jax.random.split(key)
    widths = [min(d, num_directions - start) for start in range(0, num_directions, d)]
    block_keys = jax.random.split(key_basis, len(widths))
    basis = jnp.concatenate([_haar(k, d, width, dtype) for k, width in zip(block_keys, widths, strict=True)], axis=1)
    if scale == "sqrt_d":
        return math.sqrt(d) * basis
    return jnp.sqrt(jax.random.chisquare(key_norm, d, (num_directions,), dtype))[None] * basis


def _haar(key: PRNGKeyArray, d: int, width: int, dtype: DTypeLike) -> Float[Array, "d width"]:
    """``width`` orthonormal columns of a Haar-distributed orthogonal matrix, shape (d, width)."""
    q, r = jnp.linalg.qr(jax.random.normal(key, (d, width), dtype))
    # LAPACK's sign convention is not uniform; a positive diagonal of R makes Q exactly Haar (Mezzadri 2007, section 5).
    return q * jnp.where(jnp.diagonal(r) < 0, -1, 1).astype(dtype)[None]
