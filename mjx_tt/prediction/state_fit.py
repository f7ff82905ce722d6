"""State and spin of every ball from its track: Gauss-Newton on the simulation's own flights, under a prior of spin.

Each flight has nine unknowns, position, velocity and spin at its first sample; spin is told along the flight's axes
(topspin, against its way, sidespin). Spins have a normal prior, whose mean and spread can be learnt from the flights
themselves by expectation maximisation, and numbers of the model that all flights share can be fitted with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from ballmodel.state import BallState
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.flights.forward_model import Flown, Grid, grid, heading_axes, leaves
from mjx_tt.diagnosis.ball.flights.forward_model import predict as fly
from mjx_tt.sim.model import SimModel, with_values

STEP = np.array([1e-4] * 3 + [2e-3] * 3 + [0.5] * 3)  # of the differences, [m], [m/s], [rad/s]
WEAK = np.array([10.0] * 3 + [50.0] * 3)  # standard deviations of what is not known before, [m], [m/s]
ROUNDS = 20
SETTLED = 5  # rounds before noise and prior follow the flights
HUBER = 4.0  # deviations from which a sample counts less
LEAST_NOISE = 5e-4  # [m]
FALLBACK_NOISE = 3e-3  # [m] where a flight has too few samples to tell
LEAST_SPREAD = 5.0  # [rad/s] of a learnt prior
SHARED: dict[str, tuple[float, float, float]] = {  # path -> mean, deviation of the weak prior, step
    "ball.flight.drag_coefficient": (0.43, 0.06, 1e-3),
    "ball.flight.magnus_coefficient": (0.7, 0.35, 2e-3),
    "ball.table.restitution": (0.92, 0.04, 1e-3),
    "ball.table.friction": (0.22, 0.07, 2e-3),
    "ball.table.height": (0.0, 0.01, 1e-4),
}


@dataclass(frozen=True)
class SpinPrior:
    """Normal distribution of spins along the flights' axes."""

    mean: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))  # [rad/s]
    covariance: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.diag([100.0, 60.0, 60.0]) ** 2)

    @classmethod
    def still(cls) -> SpinPrior:
        """Balls that do not spin."""
        return cls(np.zeros(3), np.eye(3) * 1e-3)


@dataclass(frozen=True)
class Fitted:
    """Posterior of n balls."""

    state: Float[np.ndarray, "9 n"]  # position [m], velocity [m/s], spin [rad/s] along the flight's axes
    covariance: Float[np.ndarray, "n 9 9"]
    axes: Float[np.ndarray, "3 3 n"]  # component, axis, ball
    noise: float  # [m] of a sample's coordinate
    prior: SpinPrior
    model: SimModel  # with the shared numbers that were fitted
    shared: dict[str, tuple[float, float]]  # path -> estimate, standard deviation

    @property
    def start(self) -> BallState:
        """States in the table frame, (3, n)."""
        spin = np.einsum("can,an->cn", self.axes, self.state[6:])
        return BallState(self.state[:3], self.state[3:6], spin)


def first_guess(
    tracks: Sequence[Trajectory], seconds: float | None
) -> tuple[Float[np.ndarray, "6 n"], Float[np.ndarray, "3 3 n"]]:
    """Position and velocity at each first sample from a fall through its first samples, and the flights' axes."""
    out = np.zeros((6, len(tracks)))
    for i, t in enumerate(tracks):
        time = t.time - t.time[0]
        z = t.position[2]
        stop = max(int(np.searchsorted(time, min(seconds or 0.15, 0.15), side="right")), 4)
        low = int(np.argmin(z[:stop])) if z[:stop].min() < 0.06 else stop
        stop = min(stop, len(time)) if low < 4 else min(stop, low + 1, len(time))
        fall = 0.5 * 9.81 * time[:stop] ** 2
        powers = np.stack([np.ones(stop), time[:stop]], axis=1)
        lifted = t.position[:, :stop] + np.array([[0.0], [0.0], [1.0]]) * fall
        out[:, i] = np.linalg.lstsq(powers, lifted.T, rcond=None)[0].ravel()
    return out, heading_axes(out[3:])


def fit_states(
    tracks: Sequence[Trajectory],
    model: SimModel,
    prior: SpinPrior | None = None,
    seconds: float | None = None,
    learn_prior: bool = False,
    shared: Mapping[str, tuple[float, float, float]] | None = None,
    noise: float | None = None,
    rounds: int = ROUNDS,
) -> Fitted:
    """Posterior of each track's first state.

    prior: of spin; without one balls may spin as people's do. seconds: of each track that are used, all without.
    learn_prior: mean and spread of the spins follow the flights. shared: path of SimModel -> mean, deviation and step
    of what is fitted over all flights together. noise: [m] of a sample, estimated without it.
    Raises ValueError for tracks of fewer than four samples.
    """
    short = [t.label for t in tracks if len(t) < 4]
    if not tracks or short:
        raise ValueError(f"tracks of at least 4 samples are wanted, not {', '.join(short) or 'none'}")
    prior, shared = prior or SpinPrior(), dict(shared or {})
    g = grid([t if seconds is None else _first(t, seconds) for t in tracks])
    guess, axes = first_guess(tracks, seconds)
    state = np.concatenate([guess, np.repeat(prior.mean[:, None], g.n, axis=1)])
    weak = np.array([value for value, _, _ in shared.values()])
    theta, sigma = weak.copy(), noise or FALLBACK_NOISE
    damping, held = np.full(g.n, 1e-3), state.copy()
    square, off = np.full(g.n, np.inf), np.zeros(g.n)  # of the states held
    problem = _Problem(g, axes, model, list(shared))
    covariance, spread = np.tile(np.eye(9), (g.n, 1, 1)), np.zeros(len(theta))
    for round_ in range(rounds):
        residual, jacobian = problem.linearise(state, theta, np.array([s for *_, s in shared.values()]))
        if noise is None and round_ >= SETTLED:
            sigma = _noise(residual, g.mask)
        if learn_prior and round_ >= SETTLED:
            prior = _learnt(state[6:], covariance[:, 6:, 6:])
        weight = _huber(residual, sigma) * g.mask
        new = np.sum(weight * np.sum(residual**2, axis=0), axis=0), _of_prior(state, prior)
        worse = new[0] / sigma**2 + new[1] > square / sigma**2 + off + 1e-3
        if worse.any() and not shared:
            state[:, worse] = held[:, worse]
            residual, jacobian = problem.linearise(state, theta, np.zeros(0))
            weight = _huber(residual, sigma) * g.mask
            new = np.sum(weight * np.sum(residual**2, axis=0), axis=0), _of_prior(state, prior)
        damping = np.where(worse, damping * 10.0, np.maximum(damping * 0.2, 1e-9))
        held, (square, off) = state.copy(), new
        step, change, covariance, spread = _solve(
            residual, jacobian, weight, sigma, state, prior, theta, shared, damping
        )
        state, theta = state + step, theta + change
        state[6:] = np.clip(state[6:], -1500.0, 1500.0)
        if np.abs(step / STEP[:, None]).max() < 0.05 and round_ > SETTLED:
            break
    fitted = {path: (float(v), float(s)) for path, v, s in zip(shared, theta, spread, strict=True)}
    final = with_values(model, {path: v for path, (v, _) in fitted.items()})
    return Fitted(state, covariance, axes, sigma, prior, final, fitted)


def _first(t: Trajectory, seconds: float) -> Trajectory:
    """The track's first seconds, four samples at least."""
    stop = int(np.searchsorted(t.time, t.time[0] + seconds + 1e-9, side="right"))
    return t.part(0, max(stop, min(4, len(t))))


@dataclass(frozen=True)
class _Problem:
    g: Grid
    axes: Float[np.ndarray, "3 3 n"]
    model: SimModel
    paths: list[str]

    def linearise(
        self, state: Float[np.ndarray, "9 n"], theta: Float[np.ndarray, " s"], steps: Float[np.ndarray, " s"]
    ) -> tuple[Float[np.ndarray, "3 T n"], Float[np.ndarray, "k 3 T n"]]:
        """Residual [m], and the derivatives of the prediction by the nine of each ball and by what all share."""
        k = len(steps)
        variants = 1 + 9 + k
        start = np.repeat(state[:, None], variants, axis=1)
        for i in range(9):
            start[i, 1 + i] += STEP[i]
        values = {}
        for j, path in enumerate(self.paths):
            value = np.full((variants, 1), theta[j])
            if k:
                value[10 + j] += steps[j]
            values[path] = value
        flown = fly(self.model, values, start, self.g, self.axes).measured
        size = np.concatenate([STEP, steps])
        jacobian = (flown[:, :, 1:] - flown[:, :, :1]) / size[None, None, :, None]
        return self.g.measured - flown[:, :, 0], np.moveaxis(jacobian, 2, 0)


def _solve(
    residual: Float[np.ndarray, "3 T n"],
    jacobian: Float[np.ndarray, "k 3 T n"],
    weight: Float[np.ndarray, "T n"],
    sigma: float,
    state: Float[np.ndarray, "9 n"],
    prior: SpinPrior,
    theta: Float[np.ndarray, " s"],
    shared: Mapping[str, tuple[float, float, float]],
    damping: Float[np.ndarray, " n"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Change of the states and of what all share, the states' covariance and the shared numbers' deviations."""
    scaled = np.sqrt(weight) / sigma
    j = (jacobian * scaled).transpose(3, 0, 1, 2).reshape(jacobian.shape[3], jacobian.shape[0], -1)
    r = (residual * scaled).transpose(2, 0, 1).reshape(jacobian.shape[3], -1)
    normal, right = j @ j.transpose(0, 2, 1), np.einsum("nkm,nm->nk", j, r)
    inverse = np.linalg.inv(prior.covariance)
    own, both, common = normal[:, :9, :9].copy(), normal[:, :9, 9:], normal[:, 9:, 9:].sum(axis=0)
    own[:, range(6), range(6)] += 1e-9 / WEAK**2
    own[:, 6:, 6:] += inverse
    pull = right[:, :9].copy()
    pull[:, 6:] -= (inverse @ (state[6:] - prior.mean[:, None])).T
    covariance = np.linalg.inv(own)
    damped = own + damping[:, None, None] * own * np.eye(9)
    if not shared:
        return np.linalg.solve(damped, pull[..., None])[..., 0].T, np.zeros(0), covariance, np.zeros(0)
    means, deviations, _ = np.array(list(shared.values())).T
    solved = np.linalg.solve(damped, np.concatenate([both, pull[..., None]], axis=2))
    schur = common + np.diag(1.0 / deviations**2) - np.einsum("nks,nkt->st", both, solved[:, :, :-1])
    target = right[:, 9:].sum(axis=0) - (theta - means) / deviations**2
    target = target - np.einsum("nks,nk->s", both, solved[:, :, -1])
    change = np.linalg.solve(schur, target)
    change = np.clip(change, -deviations, deviations)
    step = (solved[:, :, -1] - np.einsum("nks,s->nk", solved[:, :, :-1], change)).T
    return step, change, covariance, np.sqrt(np.diagonal(np.linalg.inv(schur)))


def _of_prior(state: Float[np.ndarray, "9 n"], prior: SpinPrior) -> Float[np.ndarray, " n"]:
    off = state[6:] - prior.mean[:, None]
    return np.sum(off * (np.linalg.inv(prior.covariance) @ off), axis=0)


def _learnt(spin: Float[np.ndarray, "3 n"], covariance: Float[np.ndarray, "n 3 3"]) -> SpinPrior:
    """Mean and spread of spins that are known up to their own covariance; robust against a few wild ones."""
    mean = np.median(spin, axis=1)
    off = spin - mean[:, None]
    scale = np.median(np.abs(off), axis=1, keepdims=True) / 0.6745 + LEAST_SPREAD
    off = np.clip(off, -4.0 * scale, 4.0 * scale)
    own = np.median(covariance, axis=0)
    return SpinPrior(mean, off @ off.T / spin.shape[1] + 0.5 * (own + own.T) + np.eye(3) * LEAST_SPREAD**2)


def _huber(residual: Float[np.ndarray, "3 T n"], sigma: float) -> Float[np.ndarray, "T n"]:
    distance = np.sqrt(np.sum(residual**2, axis=0))
    return np.minimum(1.0, HUBER * sigma / np.maximum(distance, 1e-12))


def _noise(residual: Float[np.ndarray, "3 T n"], mask: Bool[np.ndarray, "T n"]) -> float:
    """Deviation [m] of a coordinate from the median residual, with the nine numbers that each ball spent."""
    samples = mask.sum(axis=0)
    if not mask.any():
        return FALLBACK_NOISE
    spent = np.sqrt(max(1.0 - 9.0 / (3.0 * max(float(np.mean(samples)), 4.0)), 0.2))
    spread = float(np.median(np.abs(residual[:, mask]))) / 0.6745 / spent
    return float(np.clip(spread, LEAST_NOISE, 0.05))


def fly_on(fitted: Fitted, time: Float[np.ndarray, "T n"]) -> tuple[Flown, Float[np.ndarray, "3 T 9 n"]]:
    """Flights of the fitted balls at times [s] since their first samples, and the derivatives by each state."""
    n = fitted.state.shape[1]
    tracks = [Trajectory("", str(i), np.r_[0.0, time[:, i]], np.zeros((3, len(time) + 1))) for i in range(n)]
    g = grid(tracks)
    start = np.repeat(fitted.state[:, None], 10, axis=1)
    for i in range(9):
        start[i, 1 + i] += STEP[i]
    flown = fly(fitted.model, {}, start, g, fitted.axes, states=start.shape[1])
    derivative = (flown.position[:, 1:, 1:] - flown.position[:, 1:, :1]) / STEP[None, None, :, None]
    return flown, derivative


def lift_known(model: SimModel) -> bool:
    """True where the model's ball is lifted by spin."""
    return leaves(model)["ball.flight.magnus_coefficient"] != 0.0
