"""From the returns of antithetic pairs to one weight per direction: elites, reward normalisation, failed pairs."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

RANKS = ("abs", "signed", "max")
WEIGHTINGS = ("returns", "centered_rank")
NORMALISATIONS = ("std", "none")

# Elites that all returned the same carry no scale to divide by; the tolerance is NumPy's isclose, which Iris uses.
_ZERO_STD = 1e-8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ShapedPairs:
    """Result of ``shape``: weights of one update's directions, from their returns.

    weights       (N,) weight of each direction: the gradient estimate is directions @ weights; 0 outside the elites
    elites        (N,) bool, the pairs that contribute
    n_elites      () int32, k
    failed_pairs  () int32, pairs dropped because a return was not finite
    elite_std     () standard deviation of the 2 k elite returns, before "about 0 becomes 1"
    mean_return   () mean return of all finite pairs; NaN when there are none
    """

    weights: Float[Array, " N"]
    elites: Bool[Array, " N"]
    n_elites: Int[Array, ""]
    failed_pairs: Int[Array, ""]
    elite_std: Float[Array, ""]
    mean_return: Float[Array, ""]


def shape(
    plus: Float[Array, "..."],
    minus: Float[Array, "..."],
    elite_fraction: float = 0.3,
    rank: str = "abs",
    weighting: str = "returns",
    normalise: str = "std",
) -> ShapedPairs:
    """Weights each direction by the returns (N,) at theta + sigma delta and theta - sigma delta (higher is better).

    With D = plus - minus, k = max(1, int(elite_fraction * finite pairs)) and s the standard deviation of the 2 k elite
    returns, an elite's weight is D / (k s) and every other weight is 0 (Iris, ``ars_algorithm.py``). A pair with a
    non-finite return is dropped before anything else, exactly as if it had not been evaluated.

    rank       "abs": |D| (Iris); "signed": D (the paper's Eq. 5 as printed); "max": the better of the two (ARS, Eq. 4)
    weighting  "returns", or "centered_rank": returns are first replaced by their ranks over all members, spread evenly
               over [-0.5, 0.5], ties sharing their mean rank (Salimans et al. 2017; ties: ours)
    normalise  "std": divide by s, or by 1 where s is about 0; "none": do not divide

    Raises ValueError for arrays that are not two equal vectors or for an unknown option.
    """
    if plus.ndim != 1 or plus.shape != minus.shape:
        raise ValueError(f"shaping.shape: plus {plus.shape} and minus {minus.shape} must both be (pairs,)")
    for name, given, allowed in (
        ("rank", rank, RANKS),
        ("weighting", weighting, WEIGHTINGS),
        ("normalise", normalise, NORMALISATIONS),
    ):
        if given not in allowed:
            raise ValueError(f"shaping.shape: {name} = {given!r}, allowed are {allowed}")

    finite = jnp.isfinite(plus) & jnp.isfinite(minus)
    n_finite = jnp.sum(finite, dtype=jnp.int32)
    # Zeros in place of non-finite numbers: NaN times a zero mask would still be NaN.
    plus, minus = jnp.where(finite, plus, 0), jnp.where(finite, minus, 0)
    mean_return = jnp.sum(plus + minus) / (2 * n_finite).astype(plus.dtype)
    if weighting == "centered_rank":
        plus, minus = _centered_ranks(plus, minus, finite)

    difference = plus - minus
    score = {"abs": jnp.abs(difference), "signed": difference, "max": jnp.maximum(plus, minus)}[rank]
    place = jnp.argsort(jnp.argsort(jnp.where(finite, score, -jnp.inf), descending=True))
    # A table makes k Python's int(elite_fraction * n) for every n; a float32 product might round across a whole number.
    n_elites_of = np.array([0] + [max(1, int(elite_fraction * n)) for n in range(1, plus.shape[0] + 1)], np.int32)
    n_elites = jnp.asarray(n_elites_of)[n_finite]
    elites = place.astype(jnp.int32) < n_elites

    k = jnp.maximum(n_elites, 1).astype(plus.dtype)
    elite_std = _std_of_elites(plus, minus, elites, k)
    divisor = jnp.where(elite_std < _ZERO_STD, 1, elite_std) if normalise == "std" else 1
    weights = jnp.where(elites, difference, 0) / (k * divisor)
    return ShapedPairs(
        weights=weights,
        elites=elites,
        n_elites=n_elites,
        failed_pairs=plus.shape[0] - n_finite,
        elite_std=elite_std,
        mean_return=mean_return,
    )


def _std_of_elites(
    plus: Float[Array, " N"], minus: Float[Array, " N"], elites: Bool[Array, " N"], k: Float[Array, ""]
) -> Float[Array, ""]:
    mean = jnp.sum(jnp.where(elites, plus + minus, 0)) / (2 * k)
    squares = jnp.where(elites, (plus - mean) ** 2 + (minus - mean) ** 2, 0)
    return jnp.sqrt(jnp.sum(squares) / (2 * k))


def _centered_ranks(
    plus: Float[Array, " N"], minus: Float[Array, " N"], finite: Bool[Array, " N"]
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    # Dropped members sort to the end as infinities, so they do not move anybody else's rank.
    members = jnp.concatenate([jnp.where(finite, plus, jnp.inf), jnp.where(finite, minus, jnp.inf)])
    ordered = jnp.sort(members)
    below = jnp.searchsorted(ordered, members, side="left")
    not_above = jnp.searchsorted(ordered, members, side="right")
    mean_rank = (below + not_above - 1).astype(plus.dtype) / 2
    last_rank = jnp.maximum(2 * jnp.sum(finite) - 1, 1).astype(plus.dtype)
    centered = mean_rank / last_rank - 0.5
    first, second = (jnp.where(finite, half, 0) for half in jnp.split(centered, 2))
    return first, second
