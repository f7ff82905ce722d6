"""Blackbox Gradient Sensing as init / ask / tell (Abeyruwan et al. 2022, appendix "Details on the BGS Algorithm").

One update, maximising the mean return F:

    population = ask(key, state, config)                      # members theta +/- sigma delta_i, the columns of (d, 2N)
    ... evaluate every member m times with frozen observation statistics, average ...
    state, info = tell(state, population, returns, config)    # theta += alpha / (k s) sum_elites D_i delta_i

Where the paper is silent or its Eq. 3 cannot be meant literally, the defaults follow the authors' library Iris. The
observation statistics (``bgs.normalizer``) are not part of the state: the function being maximised may have no
observations, and whoever evaluates the members both reads and extends them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float, Int, PRNGKeyArray

from bgs import directions as direction_sampling
from bgs import optimizers as steps
from bgs import shaping


@dataclass(frozen=True)
class BGSConfig:
    """Settings of the optimiser; the defaults are the paper's simulation settings (appendix, BGS hyper-parameters).

    num_directions  N, antithetic pairs per update
    sigma           perturbation scale: members are theta +/- sigma delta; a number or a schedule over updates
                    (``bgs.optimizers``)
    elite_fraction  fraction of the pairs that become elites, in (0, 1]
    rank            how elites are chosen: "abs", "signed" or "max" (``shaping.shape``)
    weighting       "returns" or "centered_rank" (``shaping.shape``)
    normalise       "std" or "none": division by the elites' standard deviation (``shaping.shape``)
    orthogonal      orthogonal or independent Gaussian directions (``directions.sample``)
    scale           "sqrt_d" or "chi": norms of orthogonal directions (``directions.sample``)
    step            optax transformation, from ``bgs.optimizers.make`` or optax itself
    ema_decay       decay per update of the moving average of theta, in [0, 1); 0 makes the average theta itself

    Raises ValueError naming the key, what was given and what is allowed.
    """

    num_directions: int = 200
    sigma: float | steps.Schedule = 0.025
    elite_fraction: float = 0.3
    rank: str = "abs"
    weighting: str = "returns"
    normalise: str = "std"
    orthogonal: bool = True
    scale: str = "sqrt_d"
    step: optax.GradientTransformation = field(default_factory=steps.make)
    ema_decay: float = 0.0

    def __post_init__(self) -> None:
        choices = {
            "rank": shaping.RANKS,
            "weighting": shaping.WEIGHTINGS,
            "normalise": shaping.NORMALISATIONS,
            "scale": direction_sampling.SCALES,
        }
        for key, allowed in choices.items():
            self._require(key, getattr(self, key) in allowed, f"one of {allowed}")
        self._require(
            "num_directions",
            isinstance(self.num_directions, int) and self.num_directions >= 1,
            "a whole number of at least 1",
        )
        number = callable(self.sigma) or 0 < self.sigma < float("inf")
        self._require("sigma", number, "a positive finite number or a schedule")
        self._require("elite_fraction", 0 < self.elite_fraction <= 1, "a number in (0, 1]")
        self._require("ema_decay", 0 <= self.ema_decay < 1, "a number in [0, 1)")
        self._require("step", isinstance(self.step, optax.GradientTransformation), "an optax.GradientTransformation")

    def _require(self, key: str, allowed: bool, wanted: str) -> None:
        if not allowed:
            raise ValueError(f"BGSConfig.{key} = {getattr(self, key)!r}, allowed is {wanted}")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BGSState:
    """State between updates.

    theta      (d,) the parameters
    average    (d,) moving average of theta after each update
    opt_state  state of the optax step
    updates    () int32, number of ``tell`` calls
    """

    theta: Float[Array, " d"]
    average: Float[Array, " d"]
    opt_state: optax.OptState
    updates: Int[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Population:
    """The antithetic pairs of an update.

    members     (d, 2N) to evaluate: columns 0..N-1 are theta + sigma delta_i, columns N..2N-1 theta - sigma delta_i
    directions  (d, N) delta_i
    """

    members: Float[Array, "d 2*N"]
    directions: Float[Array, "d N"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class BGSInfo:
    """Measures of one update, each a scalar.

    gradient_norm  norm of sum_elites D_i delta_i / (k s)
    update_norm    norm of the change of theta
    failed_pairs   int32, pairs dropped for a non-finite return
    elites         int32, k
    elite_std      standard deviation s of the 2 k elite returns, before "about 0 becomes 1"
    mean_return    mean return of the members of all finite pairs; NaN when there are none
    """

    gradient_norm: Float[Array, ""]
    update_norm: Float[Array, ""]
    failed_pairs: Int[Array, ""]
    elites: Int[Array, ""]
    elite_std: Float[Array, ""]
    mean_return: Float[Array, ""]


def init(theta: ArrayLike, config: BGSConfig) -> BGSState:
    """State before the first update from the initial parameters theta (d,), float32 or float64."""
    theta = jnp.asarray(theta)
    if theta.ndim != 1 or not jnp.issubdtype(theta.dtype, jnp.floating):
        raise ValueError(f"init: theta must be a vector of floats, got shape {theta.shape} of {theta.dtype}")
    return BGSState(theta, theta, config.step.init(theta), jnp.zeros((), jnp.int32))


def ask(key: PRNGKeyArray, state: BGSState, config: BGSConfig) -> Population:
    """The members to evaluate for the next update, in theta's precision."""
    return perturb(state, _sample(key, state, config), config)


@partial(jax.jit, static_argnames="config")
def _sample(key: PRNGKeyArray, state: BGSState, config: BGSConfig) -> Float[Array, "d N"]:
    d, dtype = state.theta.shape[0], state.theta.dtype
    return direction_sampling.sample(key, d, config.num_directions, config.orthogonal, config.scale, dtype)


def perturb(state: BGSState, directions: Float[Array, "d N"], config: BGSConfig) -> Population:
    """The members along given directions (d, N): ``ask`` without its sampling."""
    with jax.numpy_dtype_promotion("standard"):  # optax's schedules divide integers by floats
        sigma = config.sigma(state.updates) if callable(config.sigma) else config.sigma
    theta, offsets = state.theta[:, None], jnp.asarray(sigma, state.theta.dtype) * directions
    return Population(jnp.concatenate([theta + offsets, theta - offsets], axis=1), directions)


@partial(jax.jit, static_argnames="config")
def tell(
    state: BGSState, population: Population, returns: Float[Array, "..."], config: BGSConfig
) -> tuple[BGSState, BGSInfo]:
    """One ascent step from the members' returns (2N,), each averaged over its repeats.

    A non-finite return marks a failed evaluation and drops its pair. When every pair failed, theta, the average and the
    optax state stay as they were (a step such as Adam's would otherwise move on momentum alone) and only ``updates``
    advances. Raises ValueError when population and returns do not fit together.
    """
    directions = population.directions
    expected = (state.theta.shape[0], returns.shape[0] // 2)
    if directions.shape != expected or returns.shape != (2 * expected[1],):
        raise ValueError(f"tell: directions {directions.shape}, but theta and returns {returns.shape} need {expected}")
    plus, minus = returns[: expected[1]], returns[expected[1] :]
    shaped = shaping.shape(plus, minus, config.elite_fraction, config.rank, config.weighting, config.normalise)
    # Accelerators would otherwise multiply float32 in a shorter format.
    gradient = jnp.matmul(directions, shaped.weights, precision=jax.lax.Precision.HIGHEST)
    after = apply_gradient(state, gradient, config)
    after = jax.tree.map(lambda new, old: jnp.where(shaped.n_elites > 0, new, old), after, _later(state))
    info = BGSInfo(
        gradient_norm=jnp.linalg.norm(gradient),
        update_norm=jnp.linalg.norm(after.theta - state.theta),
        failed_pairs=shaped.failed_pairs,
        elites=shaped.n_elites,
        elite_std=shaped.elite_std,
        mean_return=shaped.mean_return,
    )
    return after, info


def apply_gradient(state: BGSState, gradient: Float[Array, " d"], config: BGSConfig) -> BGSState:
    """The state after one ascent step along a gradient, wherever that comes from."""
    # optax descends, returns are to rise.
    with jax.numpy_dtype_promotion("standard"):  # optax raises floats to an integer count
        change, opt_state = config.step.update(-gradient, state.opt_state, state.theta)
    theta = optax.apply_updates(state.theta, change)
    average = config.ema_decay * state.average + (1 - config.ema_decay) * theta
    return replace(_later(state), theta=theta, average=average, opt_state=opt_state)


def _later(state: BGSState) -> BGSState:
    """The state after an update that changed nothing."""
    return replace(state, updates=state.updates + 1)
