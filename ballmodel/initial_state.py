"""Initial state of a ball from its free flight: the paper's Nelder-Mead, and Levenberg-Marquardt for thousands at once.

Both minimise the same thing: the Euclidean distance between the measured positions and a simulated flight, over the
position and velocity at the first sample (Abeyruwan et al. 2022, "Modeling Human Ball Distributions"). The simulated
flight takes the steps of ``ballmodel.flight``: the interval between two samples is cut into the fewest equal steps that
are no longer than DT, so the flight meets every measured time exactly. All in float64.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from ballmodel.aerodynamics import FlightParams
from ballmodel.flight import free_step
from ballmodel.partial_params import without_nominal
from ballmodel.state import BallState
from ballmodel.trajectory import Trajectory

DT = 1.0 / 300.0  # [s] longest step of the simulated flight
MIN_SAMPLES = 4  # 12 numbers for 6 unknowns
PAD = 32  # numbers of samples and of trajectories are rounded up to it, so that similar batches share one compiled fit
MANY, PAD_MANY = 256, 512  # and more than MANY trajectories to this
SOLVER = optimistix.LevenbergMarquardt(rtol=1e-9, atol=1e-9, linear_solver=lineax.Normal(lineax.Cholesky()))
MAX_ITERATIONS = 50


@dataclass(frozen=True)
class FitResult:
    """Fitted initial states, as float64 NumPy arrays."""

    state: BallState  # (3, n) at each trajectory's first sample
    rms: Float[np.ndarray, " n"]  # [m] root mean square distance of the samples from the fitted flight
    covariance: Float[np.ndarray, "6 6 n"]  # of position [m] and velocity [m/s], from the residuals' own spread
    converged: Bool[np.ndarray, " n"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Measured:
    """Flights of n balls, padded to T samples and to S steps between two of them; of one ball inside ``vmap``."""

    spin: Float[Array, "3 *n"]  # [rad/s] at the first sample
    steps: Float[Array, "gaps S *n"]  # [s] lengths of the T - 1 gaps' steps; zero where there are fewer
    position: Float[Array, "3 T *n"]  # [m]
    mask: Float[Array, "T *n"]  # 1 for a sample, 0 for padding


def _check(trajectories: Sequence[Trajectory]) -> None:
    if not trajectories:
        raise ValueError("no trajectory to fit")
    short = [t for t in trajectories if len(t) < MIN_SAMPLES]
    if short:
        raise ValueError(
            f"{len(short)} of {len(trajectories)} trajectories have fewer than {MIN_SAMPLES} samples of free flight, "
            f"the first is {short[0].label} with {len(short[0])}"
        )


def _pad(
    trajectories: Sequence[Trajectory], spin: Float[np.ndarray, "3 n"]
) -> tuple[_Measured, Float[np.ndarray, "6 n"]]:
    """The padded flights, and position and velocity at the first sample of a parabola through each one's samples."""
    n = len(trajectories)
    length = -(-max(map(len, trajectories)) // PAD) * PAD
    time, position, mask = np.zeros((n, length)), np.zeros((n, 3, length)), np.zeros((n, length))
    for i, trajectory in enumerate(trajectories):
        k = len(trajectory)
        time[i, :k] = trajectory.time - trajectory.time[0]
        time[i, k:] = time[i, k - 1]
        position[i, :, :k] = trajectory.position
        mask[i, :k] = 1.0
    gap = np.diff(time, axis=1).T
    counts = np.maximum(np.ceil(gap / DT * (1.0 - 1e-9)), 1.0)
    rows = np.arange(int(counts.max()))[None, :, None]
    steps = np.where(rows < counts[:, None], (gap / counts)[:, None], 0.0)
    powers = time.T[None] ** np.arange(3)[:, None, None] * mask.T
    moments = np.einsum("itn,jtn->nij", powers, powers)
    sums = np.einsum("itn,atn->nia", powers, np.moveaxis(position, 0, -1))
    coefficients = np.linalg.solve(moments, sums)
    measured = _Measured(*map(jnp.asarray, (spin, steps, np.moveaxis(position, 0, -1), mask.T)))
    return measured, np.concatenate([coefficients[:, 0].T, coefficients[:, 1].T])


def _residual(unknowns: Float[Array, "6"], flight: FlightParams, measured: _Measured) -> Float[Array, "3 T"]:
    """Measured minus simulated positions [m] of one ball that starts with position and velocity ``unknowns``."""

    def advance(state: BallState, dts: Array) -> tuple[BallState, Array]:
        state, _ = jax.lax.scan(lambda s, dt: (free_step(flight, s, dt), None), state, dts)
        return state, jnp.asarray(state.position)

    start = BallState(unknowns[:3], unknowns[3:], measured.spin)
    _, positions = jax.lax.scan(advance, start, measured.steps)
    flown = jnp.concatenate([unknowns[None, :3], positions]).T
    return measured.mask[None] * (measured.position - flown)


def _soften(residual: Float[Array, "3 T"], huber: float | None) -> Float[Array, "3 T"]:
    """Residuals whose square is Huber's loss of the distance."""
    if huber is None:
        return residual
    square = jnp.maximum(jnp.sum(residual * residual, axis=0), 1e-24)
    distance = jnp.sqrt(square)
    loss = jnp.where(distance <= huber, square, 2.0 * huber * distance - huber * huber)
    return residual * jnp.sqrt(loss / square)[None]


@partial(jax.jit, static_argnames="huber")
@partial(jax.vmap, in_axes=(None, -1, -1, None), out_axes=-1)
def _fit(
    flight: FlightParams, guess: Float[Array, "6"], measured: _Measured, huber: float | None
) -> tuple[Float[Array, "6"], Float[Array, ""], Float[Array, "6 6"], Bool[Array, ""]]:
    """Unknowns, rms distance [m], covariance and whether the fit converged."""
    found = optimistix.least_squares(
        lambda unknowns, _: _soften(_residual(unknowns, flight, measured), huber),
        SOLVER,
        guess,
        options={"jac": "fwd"},
        max_steps=MAX_ITERATIONS,
        throw=False,
    )
    residual = _residual(found.value, flight, measured)
    slopes = jax.jacfwd(_residual)(found.value, flight, measured).reshape(-1, 6)
    square, samples = jnp.sum(residual * residual, axis=0), jnp.sum(measured.mask)
    weight = measured.mask  # of Huber's loss, as iteratively reweighted least squares has it
    if huber is not None:
        weight = weight * jnp.minimum(1.0, huber / jnp.maximum(jnp.sqrt(square), 1e-12))
    normal = slopes.T @ (jnp.tile(weight, 3)[:, None] * slopes)
    spread = jnp.sum(weight * square) / (3.0 * samples - 6.0)
    converged = found.result == optimistix.RESULTS.successful
    return found.value, jnp.sqrt(jnp.sum(square) / samples), jnp.linalg.inv(normal) * spread, converged


def fit_gauss_newton(
    trajectories: Sequence[Trajectory],
    flight: FlightParams,
    spin: ArrayLike | None = None,
    huber: float | None = None,
) -> FitResult:
    """Fits all free flights at once by damped Gauss-Newton (Levenberg-Marquardt).

    Compiles once for each padded number of trajectories and samples and each number of steps between samples.

    Args:
        trajectories: free flights (see ``trajectory.free_flight``) of any lengths, each with MIN_SAMPLES samples.
        flight: what moves the balls.
        spin: known spins (3, n) [rad/s] at the first sample; without it the balls do not rotate.
        huber: distance [m] beyond which a sample counts linearly instead of by its square; None for least squares.

    Raises:
        ValueError: there are too few samples, or the spin has the wrong shape.
    """
    _check(trajectories)
    n = len(trajectories)
    extra = -n % (PAD if n <= MANY else PAD_MANY)
    spin = np.zeros((3, n)) if spin is None else np.asarray(spin, np.float64)
    if spin.shape != (3, n):
        raise ValueError(f"spin has shape {spin.shape}, (3, {n}) is wanted: one spin for each trajectory")
    spins = np.pad(spin, ((0, 0), (0, extra)), mode="edge")
    with jax.enable_x64(True):
        measured, guess = _pad([*trajectories, *[trajectories[-1]] * extra], spins)
        result = _fit(without_nominal(flight), guess, measured, huber)
        unknowns, rms, covariance, converged = (np.asarray(a)[..., :n] for a in result)
    return FitResult(BallState(unknowns[:3], unknowns[3:], spin), rms, covariance, converged)


@jax.jit
def _rms_distance(unknowns: Float[Array, "6"], flight: FlightParams, measured: _Measured) -> Float[Array, ""]:
    residual = _residual(unknowns, flight, measured)
    return jnp.sqrt(jnp.sum(residual * residual) / jnp.sum(measured.mask))


def fit_nelder_mead(
    trajectory: Trajectory, flight: FlightParams, spin: ArrayLike | None = None
) -> tuple[BallState, float]:
    """The paper's fit of one free flight: state, (3,), at the first sample and root mean square distance [m].

    spin: (3,) [rad/s], zero without it. Raises ValueError when there are fewer than MIN_SAMPLES samples.
    """
    _check([trajectory])
    spin = np.zeros(3) if spin is None else np.asarray(spin, np.float64)
    with jax.enable_x64(True):
        padded, guess = _pad([trajectory], spin[:, None])
        measured, start = jax.tree.map(lambda x: x[..., 0], (padded, guess))
    # The simplex spans the guess's likely error: a centimetre, a tenth of a metre per second.
    simplex = start + np.vstack([np.zeros(6), np.diag([0.01] * 3 + [0.1] * 3)])
    nominal = without_nominal(flight)
    with jax.enable_x64(True):
        result = minimize(
            lambda unknowns: float(_rms_distance(unknowns, nominal, measured)),
            start,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-7, "fatol": 1e-10, "maxiter": 5000, "maxfev": 10000},
        )
    return BallState(result.x[:3], result.x[3:], spin), float(result.fun)


def fit_all_nelder_mead(
    trajectories: Sequence[Trajectory], flight: FlightParams, progress: Callable[[int, int], None] | None = None
) -> tuple[BallState, Float[np.ndarray, " n"]]:
    """The paper's fit of flights without spin, one after the other: states (3, n) and root mean square distances [m].

    A flight takes about a tenth of a second. progress: called with (fitted so far, n) after each one.
    Raises ValueError as ``fit_gauss_newton`` does.
    """
    _check(trajectories)
    states, rms = [], []
    for i, trajectory in enumerate(trajectories):
        state, distance = fit_nelder_mead(trajectory, flight)
        states.append(state)
        rms.append(distance)
        if progress is not None:
            progress(i + 1, len(trajectories))
    return jax.tree.map(lambda *components: np.stack(components, axis=-1), *states), np.array(rms)
