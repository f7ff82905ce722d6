"""Perturbations measured by what they change of a function of the parameters, not by the parameters' own numbers.

A policy's parameters differ by orders of magnitude in what they do to its actions: some directions of theta move every
action, others none. Perturbations that are alike in all directions spend what the return tolerates on the few that move
everything and hardly try the rest. With J the Jacobian of the outputs, the mean of J^T J over typical inputs is the
metric F of the outputs in parameter space (for outputs with independent noise it is their Fisher information). Drawing
perturbations with the covariance (F + e I)^-1 makes every direction change the outputs alike, and a step along them is
the natural gradient (Amari 1998, "Natural gradient works efficiently in learning"; of search distributions: Wierstra
et al. 2014, "Natural evolution strategies").
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float


def factor(metric: Float[Array, "d d"], damping: float) -> Float[Array, "d d"]:
    """Upper triangular L (d, d): L L^T = c (F + e I)^-1 for the metric F (d, d), symmetric and positive semi-definite.

    damping: e over F's mean eigenvalue, positive. c is such that L z of a standard Gaussian z changes the outputs by
    the same mean square as z itself: sigma keeps its meaning. A metric that is no number or zero (a policy that does
    not answer to its parameters) gives the identity.
    """
    if not 0 < damping < float("inf"):
        raise ValueError(f"metric.factor: damping = {damping}, allowed are positive finite numbers")
    d = metric.shape[0]
    identity = jnp.eye(d, dtype=metric.dtype)
    mean = jnp.trace(metric) / d
    usable = jnp.isfinite(mean) & (mean > 0)
    relative = jnp.where(usable, metric / jnp.where(usable, mean, 1.0), identity)  # trace d
    lower = jnp.linalg.cholesky(relative + damping * identity)
    # (A A^T)^-1 = A^-T A^-1
    inverse = solve_triangular(lower, identity, lower=True, trans="T")
    changed = jnp.sum(inverse * (relative @ inverse))  # trace of L^T F L
    found = inverse * jnp.sqrt(d / changed)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, identity)
