"""Mergeable observation statistics and the normaliser made from them.

Every rollout yields the statistics of what it saw; they are merged after the update, so the normaliser is frozen while
members are compared (Iris; merging: Chan, Golub and LeVeque 1979).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Int, Shaped

# Constants of Iris' MeanStdBuffer: below MINIMUM_STD a component counts as constant and is normalised to 0.
MINIMUM_STD = 1e-7
STD_EPSILON = 1e-8

# The paper's settings see 1.6e10 observations, beyond int32 and far beyond the 2^24 up to which float32 counts in ones.
# Two int32 digits of this radix count exactly up to 2^61; the sum of two low digits still fits an int32.
# Mean and m2 need no such care: after 45,000 merges in float32 the deviation is off by 3e-5 of itself.
_RADIX_BITS = 30
_RADIX = 2**_RADIX_BITS


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObservationStatistics:
    """Count, mean and sum of squared deviations of a stream of observations with n components.

    count  (2,) int32, exact: count[0] * 2^30 + count[1], with 0 <= count[1] < 2^30
    mean   (n,) in the observation's units
    m2     (n,) sum of (x - mean)^2
    """

    count: Int[Array, "2"]
    mean: Float[Array, " n"]
    m2: Float[Array, " n"]


def empty(n: int, dtype: DTypeLike = jnp.float32) -> ObservationStatistics:
    """Statistics of no observations with ``n`` components: the identity of ``merge``."""
    return ObservationStatistics(jnp.zeros(2, jnp.int32), jnp.zeros(n, dtype), jnp.zeros(n, dtype))


def from_sums(
    count: Shaped[Array, ""] | float,
    shift: Float[Array, " n"],
    sum_shifted: Float[Array, " n"],
    sum_sq_shifted: Float[Array, " n"],
) -> ObservationStatistics:
    """Statistics of ``count`` observations x from the sums of (x - shift) and of (x - shift)^2, each (n,).

    ``count`` is an integer below 2^31. A shift near the mean, such as the mean merged so far, keeps float32 sums from
    cancelling. Raises TypeError for a count that is not an integer.
    """
    count = jnp.asarray(count)
    if not jnp.issubdtype(count.dtype, jnp.integer):
        raise TypeError(f"from_sums: count is {count.dtype}, allowed are integers: float32 is inexact beyond 2^24")
    n = jnp.maximum(count, 1).astype(sum_shifted.dtype)
    offset = sum_shifted / n
    digits = jnp.stack([count >> _RADIX_BITS, count & (_RADIX - 1)]).astype(jnp.int32)
    m2 = jnp.maximum(sum_sq_shifted - offset * sum_shifted, 0)
    return ObservationStatistics(digits, jnp.where(count > 0, shift + offset, 0), m2)


def total(statistics: ObservationStatistics) -> Float[Array, ""]:
    """Number of observations as a float (): correctly rounded from the exact count, for ratios and for display."""
    dtype = statistics.mean.dtype
    return statistics.count[0].astype(dtype) * _RADIX + statistics.count[1].astype(dtype)


def merge(a: ObservationStatistics, b: ObservationStatistics) -> ObservationStatistics:
    """Statistics of both streams together (Chan, Golub and LeVeque 1979, eq. 2.1)."""
    if a.mean.shape != b.mean.shape:
        raise ValueError(f"merge: statistics of {a.mean.shape} and of {b.mean.shape} components")
    low = a.count[1] + b.count[1]
    count = jnp.stack([a.count[0] + b.count[0] + (low >> _RADIX_BITS), low & (_RADIX - 1)])
    n_a, n_b = total(a), total(b)
    share_b = n_b / jnp.maximum(n_a + n_b, 1)
    delta = b.mean - a.mean
    return ObservationStatistics(count, a.mean + delta * share_b, a.m2 + b.m2 + delta**2 * (n_a * share_b))


def normaliser(statistics: ObservationStatistics) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Mean and inverse scale, each (n,), such that the policy sees (x - mean) * inv_std.

    inv_std is 1 / (std + 1e-8) with the n - 1 standard deviation, and 0 for a component whose std is below 1e-7
    (Iris). Before the second observation there is no deviation to speak of, and it is 1.
    """
    n = total(statistics)
    std = jnp.sqrt(statistics.m2 / jnp.maximum(n - 1, 1))
    inv_std = jnp.where(std < MINIMUM_STD, 0, 1 / (std + STD_EPSILON))
    return statistics.mean, jnp.where(n < 2, jnp.ones_like(std), inv_std)
