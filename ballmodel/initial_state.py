"""Initial state of a ball from its free flight: the paper's Nelder-Mead, and Gauss-Newton for thousands at once.

Both minimise the same thing: the Euclidean distance between the measured positions and a simulated flight, over the
position and velocity at the first sample (Abeyruwan et al. 2022, "Modeling Human Ball Distributions"). The simulated
flight takes the steps of ``ballmodel.flight``: the interval between two samples is cut into the fewest equal steps that
are no longer than DT, so the flight meets every measured time exactly. All in float64.

No force depends on where the ball is, so the flight's shape depends on the velocity alone and the derivative by the
initial position is the identity: only three directions need differentiating.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
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
MAX_ITERATIONS = 50
STEP_TOLERANCE = 1e-9  # [m], [m/s] change below which a fit has converged

NELDER_MEAD = {"xatol": 1e-7, "fatol": 1e-10, "maxiter": 5000, "maxfev": 10000}
# The simplex spans the guess's likely error: a centimetre, a tenth of a metre per second.
SIMPLEX = np.vstack([np.zeros(6), np.diag([0.01] * 3 + [0.1] * 3)])


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
    """Flights of n balls, padded to T samples and to S steps between two of them."""

    spin: Float[Array, "3 n"]  # [rad/s] at the first sample
    steps: Float[Array, "gaps S n"]  # [s] lengths of the T - 1 gaps' steps; zero where there are fewer
    position: Float[Array, "3 T n"]  # [m]
    mask: Float[Array, "T n"]  # 1 for a sample, 0 for padding


def _check(trajectories: Sequence[Trajectory], spin: ArrayLike | None) -> Float[np.ndarray, "3 n"]:
    """The spins of flights that are long enough."""
    if not trajectories:
        raise ValueError("no trajectory to fit")
    n, short = len(trajectories), [t for t in trajectories if len(t) < MIN_SAMPLES]
    if short:
        raise ValueError(
            f"{len(short)} of {n} trajectories have fewer than {MIN_SAMPLES} samples of free flight, "
            f"the first is {short[0].label} with {len(short[0])}"
        )
    spins = np.zeros((3, n)) if spin is None else np.asarray(spin, np.float64)
    if spins.shape != (3, n):
        raise ValueError(f"spin has shape {spins.shape}, (3, {n}) is wanted: one spin for each trajectory")
    return spins


def _pad(
    trajectories: Sequence[Trajectory], spin: Float[np.ndarray, "3 n"]
) -> tuple[_Measured, Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"]]:
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
    return measured, coefficients[:, 0].T, coefficients[:, 1].T


def _shape(flight: FlightParams, velocity: Float[Array, "3 n"], measured: _Measured) -> Float[Array, "3 T n"]:
    """Positions (3, T, n) of a flight that starts at the origin."""

    def advance(state: BallState, dts: Array) -> tuple[BallState, Array]:
        state, _ = jax.lax.scan(lambda s, dt: (free_step(flight, s, dt), None), state, dts)
        return state, jnp.asarray(state.position)

    start = BallState(jnp.zeros_like(velocity), velocity, measured.spin)
    _, positions = jax.lax.scan(advance, start, measured.steps)
    return jnp.moveaxis(jnp.concatenate([start.position[None], positions]), 0, 1)


def _weights(distance: Array, mask: Array, huber: float | None) -> Array:
    return mask if huber is None else mask * jnp.minimum(1.0, huber / jnp.maximum(distance, 1e-12))


def _cost(distance: Array, mask: Array, huber: float | None) -> Array:
    square = distance * distance
    if huber is not None:
        square = jnp.where(distance <= huber, square, 2.0 * huber * distance - huber * huber)
    return jnp.sum(mask * square, axis=0)


def _linearise(
    flight: FlightParams,
    x0: Float[Array, "3 n"],
    v0: Float[Array, "3 n"],
    measured: _Measured,
    huber: float | None,
) -> tuple[Float[Array, " n"], Float[Array, "n 6 6"], Float[Array, "n 6"]]:
    """Cost (n,), normal matrix (n, 6, 6) and right-hand side (n, 6) of the weighted least squares at a state."""

    def shape(velocity: Array) -> Array:
        return _shape(flight, velocity, measured)

    directions = jnp.broadcast_to(jnp.eye(3)[:, :, None], (3, *v0.shape))
    relative, slopes = jax.vmap(lambda e: jax.jvp(shape, (v0,), (e,)), out_axes=(None, 0))(directions)
    residual, mask = measured.position - relative - x0[:, None], measured.mask
    distance = jnp.sqrt(jnp.sum(residual * residual, axis=0))
    weight = _weights(distance, mask, huber)
    total = jnp.sum(weight, axis=0)
    zero = jnp.zeros_like(total)
    position_velocity = [[jnp.sum(weight * slopes[k, i], axis=0) for k in range(3)] for i in range(3)]
    velocity_velocity = [
        [jnp.sum(weight[None] * slopes[k] * slopes[m], axis=(0, 1)) for m in range(3)] for k in range(3)
    ]
    rows = [[total if i == j else zero for j in range(3)] + position_velocity[i] for i in range(3)]
    rows += [[position_velocity[i][k] for i in range(3)] + velocity_velocity[k] for k in range(3)]
    normal = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    right = [jnp.sum(weight * residual[i], axis=0) for i in range(3)]
    right += [jnp.sum(weight[None] * slopes[k] * residual, axis=(0, 1)) for k in range(3)]
    return _cost(distance, mask, huber), normal, jnp.stack(right, axis=-1)


@partial(jax.jit, static_argnames="huber")
def _levenberg_marquardt(
    flight: FlightParams,
    x0: Float[Array, "3 n"],
    v0: Float[Array, "3 n"],
    measured: _Measured,
    huber: float | None,
) -> tuple[Array, Array, Array, Array, Array]:
    def linearise(x0: Array, v0: Array) -> tuple[Array, ...]:
        return x0, v0, *_linearise(flight, x0, v0, measured, huber)

    def unfinished(carry: tuple) -> Array:
        *_, converged, iteration = carry
        return (iteration < MAX_ITERATIONS) & ~jnp.all(converged)

    def iterate(carry: tuple) -> tuple:
        (x0, v0, cost, normal, right), damping, converged, iteration = carry
        diagonal = jnp.diagonal(normal, axis1=1, axis2=2)
        damped = normal + damping[:, None, None] * diagonal[:, :, None] * jnp.eye(6)[None]
        change = jnp.linalg.solve(damped, right[..., None])[..., 0]
        new = linearise(x0 + change[:, :3].T, v0 + change[:, 3:].T)
        better = (new[2] <= cost) & ~converged
        masks = better, better, better, better[:, None, None], better[:, None]
        picked = tuple(jnp.where(mask, a, b) for mask, a, b in zip(masks, new, carry[0], strict=True))
        small = jnp.max(jnp.abs(change), axis=1) < STEP_TOLERANCE
        damping = jnp.where(better, damping * 0.1, damping * 10.0)
        return picked, damping, converged | small, iteration + 1

    start = linearise(x0, v0)
    cost = start[2]
    carry = (start, jnp.full_like(cost, 1e-6), cost < 0.0, jnp.zeros((), jnp.int32))
    (x0, v0, _, normal, _), _, converged, _ = jax.lax.while_loop(unfinished, iterate, carry)
    residual, mask = measured.position - _shape(flight, v0, measured) - x0[:, None], measured.mask
    square = jnp.sum(residual * residual, axis=0)
    samples = jnp.sum(mask, axis=0)
    rms = jnp.sqrt(jnp.sum(mask * square, axis=0) / samples)
    spread = jnp.sum(_weights(jnp.sqrt(square), mask, huber) * square, axis=0) / (3.0 * samples - 6.0)
    covariance = jnp.moveaxis(jnp.linalg.inv(normal), 0, -1) * spread[None, None]
    return x0, v0, rms, covariance, converged


def fit_gauss_newton(
    trajectories: Sequence[Trajectory],
    flight: FlightParams,
    spin: ArrayLike | None = None,
    huber: float | None = None,
) -> FitResult:
    """Fits all free flights at once by damped Gauss-Newton (Levenberg-Marquardt).

    trajectories: free flights (see ``trajectory.free_flight``) of any lengths, each with at least MIN_SAMPLES samples.
    spin: known spins (3, n) [rad/s] at the first sample; without it the balls do not rotate.
    huber: distance [m] beyond which a sample counts linearly instead of by its square; None for plain least squares.
    Compiles once for each padded number of trajectories and samples and each number of steps between samples.
    Raises ValueError for too few samples or a spin of the wrong shape.
    """
    spins = _check(trajectories, spin)
    n = len(trajectories)
    extra = -n % (PAD if n <= MANY else PAD_MANY)
    padded = np.pad(spins, ((0, 0), (0, extra)), mode="edge")
    with jax.enable_x64(True):
        measured, x0, v0 = _pad([*trajectories, *[trajectories[-1]] * extra], padded)
        result = _levenberg_marquardt(without_nominal(flight), x0, v0, measured, huber)
        x0, v0, rms, covariance, converged = (np.asarray(a)[..., :n] for a in result)
    return FitResult(BallState(x0, v0, spins), rms, covariance, converged)


@jax.jit
def _rms_distance(unknowns: Float[Array, "6"], flight: FlightParams, measured: _Measured) -> Float[Array, ""]:
    flown = unknowns[:3, None, None] + _shape(flight, unknowns[3:, None], measured)
    square = jnp.sum((measured.position - flown) ** 2, axis=0)
    return jnp.sqrt(jnp.sum(measured.mask * square) / jnp.sum(measured.mask))


def fit_nelder_mead(
    trajectories: Sequence[Trajectory],
    flight: FlightParams,
    spin: ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[BallState, Float[np.ndarray, " n"]]:
    """The paper's fit, one flight after the other: states (3, n) at the first samples, root mean square distances [m].

    trajectories, spin: as of ``fit_gauss_newton``, which also raises the same errors.
    progress: called with (fitted so far, n) after each flight, which takes about a tenth of a second.
    """
    spins = _check(trajectories, spin)
    nominal, found = without_nominal(flight), []
    with jax.enable_x64(True):
        for i, trajectory in enumerate(trajectories):
            measured, *guess = _pad([trajectory], spins[:, i : i + 1])
            start = np.concatenate(guess)[:, 0]
            options = NELDER_MEAD | {"initial_simplex": start + SIMPLEX}
            result = minimize(_rms_distance, start, (nominal, measured), method="Nelder-Mead", options=options)
            found.append([*result.x, result.fun])
            if progress is not None:
                progress(i + 1, len(trajectories))
    table = np.array(found).T
    return BallState(table[:3], table[3:6], spins), table[6]
