"""State and spin of every ball from its track, as the diagnosis fits them, and its way from there with its uncertainty.

How balls spin, how bounces scatter and how far predictions miss is learnt from other flights (``learn``). The regions
are calibrated by what those flights miss (split conformal prediction: Vovk, Gammerman and Shafer 2005): no model is
quite right, and what it lacks grows with the time ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from ballmodel.state import BallState
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.cross_validation import BELIEVED
from mjx_tt.diagnosis.ball.flights import marginal, noise
from mjx_tt.diagnosis.ball.flights.fit import first_fit, fit_flights, heading, own_spins
from mjx_tt.diagnosis.ball.flights.forward_model import Flown, grid, leaves
from mjx_tt.diagnosis.ball.flights.forward_model import predict as fly
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS, SPIN, START_STEPS, BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.sim.model import SimModel

PEOPLE = SpinPrior(np.zeros(3), np.array([100.0, 60.0, 60.0]))  # [rad/s] of spins of which nothing else is known
SCATTER = np.full(3, 0.1)  # [m/s] of bounces of which nothing else is known
LEVEL = 0.90  # of regions
CLOSE = 0.02  # [s] of a sample from the moment predicted
FEWEST = 4  # flights that regions are calibrated by
ROUNDS = 3  # of fitting starts and noise in turn
LEAST = 4  # samples of a flight
LEAST_SEEN = 0.05  # [s] of a flight that something is predicted from


@dataclass(frozen=True)
class Belief:
    """What is known of balls before one is seen."""

    model: SimModel
    spins: SpinPrior | None = None  # None: balls do not spin
    scatter: Float[np.ndarray, 3] = field(default_factory=SCATTER.copy)  # [m/s] of bounces
    wider: Float[np.ndarray, "2 h"] | None = None  # seconds ahead, and the factor of the covariance there

    @classmethod
    def of(cls, model: SimModel) -> Belief:
        """By a model alone: its spins where it has any, people's where only its ball is lifted."""
        if not lift_known(model):
            return cls(model)
        known = leaves(model)
        mean, std = (np.array([known[f"ball_spin.{kind}_{axis}"] for axis in "xyz"]) for kind in ("mean", "std"))
        return cls(model, SpinPrior(mean, std) if std.any() else PEOPLE)


@dataclass(frozen=True)
class Fitted:
    """Posterior of n balls."""

    state: Float[np.ndarray, "12 n"]  # [m], [m/s]; spin [rad/s] and its bounce's own kick [m/s] in ``axes``
    covariance: Float[np.ndarray, "n 12 12"]
    axes: Float[np.ndarray, "3 3 n"]  # component, axis, ball
    noise: float  # [m] of a sample's coordinate
    seen: Float[np.ndarray, " n"]  # [s] from the first sample to the last that was used
    belief: Belief

    @property
    def start(self) -> BallState:
        """States at the first samples in the table frame, (3, n)."""
        return BallState(self.state[:3], self.state[3:6], np.einsum("can,an->cn", self.axes, self.state[SPIN]))


def fit_states(tracks: Sequence[Trajectory], belief: Belief) -> Fitted:
    """Posterior of each track's first state. Raises ValueError for tracks of fewer than LEAST samples."""
    short = [t.label for t in tracks if len(t) < LEAST]
    if not tracks or short:
        raise ValueError(f"tracks of at least {LEAST} samples are wanted, not {', '.join(short) or 'none'}")
    g = grid(tracks)
    problem, spins = BallProblem(g, belief.model, (), heading(g)), belief.spins
    nothing = np.zeros(0)
    start = first_fit(problem, spin=None if spins is None else spins.mean)
    unknowns = 6 if spins is None else 9
    own = replace(noise.nominal_noise(g), scatter=belief.scatter)
    for _ in range(ROUNDS):
        start, _, active, information, _ = fit_flights(problem, nothing, start, g, own, spins, rounds=8)
        flown = problem.fly(nothing, start)
        residual = np.where(g.mask, g.measured - flown.measured[:, :, 0], 0.0)
        frame = noise.flight_frame(flown.velocity[:, :, 0])
        own = replace(noise.estimate(residual, frame, g, unknowns), scatter=belief.scatter)
    covariance = np.zeros((g.n, 12, 12))
    size = 1.0 / np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    scaled = np.linalg.inv(information * size[:, :, None] * size[:, None])
    covariance[np.ix_(range(g.n), active, active)] = scaled * size[:, :, None] * size[:, None]
    seen = g.time[g.last, np.arange(g.n)]
    deviation = float(np.sqrt(np.mean(np.median(own.scale, axis=1) ** 2)))
    return Fitted(start, covariance, problem.axes, deviation, seen, belief)


def fly_on(fitted: Fitted, time: Float[np.ndarray, "T n"]) -> tuple[Flown, Float[np.ndarray, "n T 3 3"]]:
    """Flights at increasing times [s] since the first samples, and the covariances [m^2] of the samples there."""
    n = fitted.state.shape[1]
    tracks = [Trajectory("", str(i), np.r_[0.0, time[:, i]], np.zeros((3, len(time) + 1))) for i in range(n)]
    start = np.repeat(fitted.state[:, None], 13, axis=1)
    start[np.arange(12), 1 + np.arange(12)] += START_STEPS[:, None]
    flown = fly(fitted.belief.model, {}, start, grid(tracks), fitted.axes, states=13)
    slope = (flown.position[:, 1:, 1:] - flown.position[:, 1:, :1]) / START_STEPS[None, None, :, None]
    covariance = np.einsum("atin,nij,btjn->ntab", slope, fitted.covariance, slope) + fitted.noise**2 * np.eye(3)
    if fitted.belief.wider is not None:
        ahead, factor = fitted.belief.wider
        covariance *= np.interp(time - fitted.seen, ahead, factor).T[:, :, None, None]
    return flown, covariance


def predict(
    track: Trajectory, model: SimModel | Belief | None = None, horizon: float | Sequence[float] = 0.3
) -> tuple[Float[np.ndarray, "3 h"], Float[np.ndarray, "3 3 h"]]:
    """Places [m] of the ball ``horizon`` [s] after the track's last sample, and their covariances [m^2].

    track: samples of one flight so far, in the table frame, bounces on the table included. model: the nominal one
    without; a Belief, as ``learn`` makes it of other flights, holds spins, scatter of bounces, and calibrated regions
    as well. The covariance is that of a sample measured there. Raises ValueError for fewer than four samples or a
    horizon that is not ahead.
    """
    ahead = np.atleast_1d(np.asarray(horizon, np.float64))
    if ahead.ndim != 1 or not np.all(np.isfinite(ahead)) or np.any(ahead <= 0.0) or np.any(np.diff(ahead) <= 0.0):
        raise ValueError(f"horizon {ahead.tolist()}: increasing seconds above 0 are wanted")
    belief = model if isinstance(model, Belief) else Belief.of(model or SimModel())
    flown, covariance = fly_on(fit_states([track], belief), (track.time[-1] - track.time[0] + ahead)[:, None])
    return flown.position[:, 1:, 0, 0], np.moveaxis(covariance[0], 0, 2)


def learn(
    tracks: Sequence[Trajectory], model: SimModel, seconds: float | None = None, horizons: Sequence[float] = ()
) -> Belief:
    """How balls spin and bounces scatter, from flights, and how far predictions miss.

    seconds, horizons: [s] of a flight that a prediction will see (without: all but the longest horizon), and ahead of
    it: regions are calibrated there.
    """
    g = grid(tracks)
    problem, nothing = BallProblem(g, model, (), heading(g)), np.zeros(0)
    at, spins = Situation(nothing, first_fit(problem)), None
    if lift_known(model):
        at, spins = own_spins(problem, at)
    linear = problem.linearise(at)
    frame = noise.flight_frame(linear.base.velocity[:, :, 0])
    own = noise.estimate(linear.residual, frame, g, 6 if spins is None else 9)
    flights = marginal.starts_out(linear, at, own, noise.robust_weights(linear.residual, own, g), problem)
    spins, scatter = marginal.distributions(marginal.products(linear, flights), nothing, spins, SCATTER)
    belief = Belief(model, spins and SpinPrior(spins.mean, spins.std), scatter)
    length = [t.time[-1] - t.time[0] for t in tracks]
    used = [seconds or max(whole - max(horizons, default=0.0), LEAST_SEEN) for whole in length]
    enough = [i for i, u in enumerate(used) if u + min(horizons, default=np.inf) <= length[i] + CLOSE]
    if len(enough) < FEWEST:
        return belief
    parts = [first_part(tracks[i], used[i]) for i in enough]
    ends, places = targets([tracks[i] for i in enough], parts, horizons)
    tried = [belief]
    if spins is not None:
        # Small errors of any model pass for spin in a short flight, and grow behind it.
        tried = [replace(belief, spins=SpinPrior(spins.mean, share * spins.std)) for share in BELIEVED]
    missed = [_missed(parts, one, ends, places) for one in tried]
    best = int(np.argmin([np.nanmedian(distance) for distance, _ in missed]))
    return replace(tried[best], wider=_wider(missed[best][1], horizons))


def targets(
    tracks: Sequence[Trajectory], parts: Sequence[Trajectory], horizons: Sequence[float]
) -> tuple[Float[np.ndarray, "h n"], Float[np.ndarray, "3 h n"]]:
    """Times [s] ``horizons`` after the parts' last samples, since each flight's first, and the sample there [m].

    NaN where a flight has none.
    """
    times, places = np.zeros((len(horizons), len(tracks))), np.full((3, len(horizons), len(tracks)), np.nan)
    for i, (t, part) in enumerate(zip(tracks, parts, strict=True)):
        last = part.time[-1]
        for h, horizon in enumerate(horizons):
            times[h, i] = last + horizon - t.time[0]
            k = int(np.argmin(np.abs(t.time - last - horizon)))
            if t.time[k] > last and abs(t.time[k] - last - horizon) < CLOSE:
                times[h, i], places[:, h, i] = t.time[k] - t.time[0], t.position[:, k]
    return times, places


def squared_miss(off: Float[np.ndarray, "3 h n"], covariance: Float[np.ndarray, "n h 3 3"]) -> Float[np.ndarray, "h n"]:
    """Squares of misses [m] in units of their covariances: chi square of three where these are right."""
    rows = np.moveaxis(off, (0, 1, 2), (2, 1, 0))[..., None]
    return (rows * np.linalg.solve(covariance, rows)).sum(axis=(2, 3)).T


def _missed(
    parts: Sequence[Trajectory], belief: Belief, ends: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] of predictions from samples (h, n), and squares in units of the covariance."""
    flown, covariance = fly_on(fit_states(parts, belief), ends)
    off = places - flown.position[:, 1:, 0]
    return np.linalg.norm(off, axis=0), squared_miss(off, covariance)


def _wider(squares: Float[np.ndarray, "h n"], horizons: Sequence[float]) -> Float[np.ndarray, "2 h"] | None:
    """Factors by which regions hold LEVEL of these flights; of a horizon that few reach, that before it."""
    ahead, factors = [], []
    for horizon, square in zip(horizons, squares, strict=True):
        known = np.sort(square[np.isfinite(square)])
        if known.size >= FEWEST:
            place = min(int(np.ceil(LEVEL * (known.size + 1))), known.size) - 1
            ahead.append(horizon)
            factors.append(known[place] / chi2.ppf(LEVEL, 3))
    return np.array([ahead, factors]) if ahead else None


def first_part(t: Trajectory, seconds: float) -> Trajectory:
    """The track's first seconds, LEAST samples at least."""
    stop = int(np.searchsorted(t.time, t.time[0] + seconds + 1e-9, side="right"))
    return t.part(0, max(stop, min(LEAST, len(t))))


def lift_known(model: SimModel) -> bool:
    """True where the model's ball is lifted by spin."""
    return leaves(model)[MAGNUS] != 0.0
