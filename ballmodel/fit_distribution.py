"""From measured balls to the human ball distribution: a box about those that land without outliers, or a mixture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from ballmodel.distribution import ROWS, BallDistribution, BallMixture
from ballmodel.flight import BallParams, step
from ballmodel.initial_state import MIN_SAMPLES, fit_gauss_newton, fit_nelder_mead
from ballmodel.io import MeasuredStates
from ballmodel.partial_params import without_nominal
from ballmodel.sampling import DT, KEPT, OUTCOMES, OWN_SIDE, ROBOT_SIDE, SECOND_BOUNCE, Throw, throw
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset, free_flight

EPS_FACTOR = 2.0
LANDED_TOGETHER = 512  # flights are simulated in multiples of it
AFTER_BOUNCE = 6  # steps after a serve's bounce on the server's side at which its ball starts: 20 ms
LONGEST_SERVE = 300  # steps until that bounce
HALF_TURN = np.array([[-1.0], [-1.0], [1.0]])  # about the table's upright axis
Fit: TypeAlias = Literal["gauss-newton", "nelder-mead"]
NUMBERS_OF_COMPONENTS = (1, 2, 3, 5, 8, 12, 16, 24)
FOLDS = 3
MOST_BALLS = 4000  # that choose the number of components
TOLERANCE = 3e-3  # of the mean log likelihood, at which a fit has converged
FEWEST_EACH = 30  # balls of a component
REGULARISATION = 1e-3  # of a standardised covariance's diagonal
LEAST_SPREAD = 1e-9  # in SI units, below which a row does not vary


@dataclass(frozen=True)
class DistributionReport:
    """Outliers and settings of ``fit_distribution``."""

    n: int  # balls given
    outlier: Bool[np.ndarray, " n"]  # taken away by DBSCAN
    eps: float  # DBSCAN radius in robust standard deviations
    min_samples: int


def fit_distribution(
    states: BallState,
    landing: Float[np.ndarray, "2 n"],
    eps: float | None = None,
    min_samples: int = 5,
    name: str = "",
    source: str = "",
) -> tuple[BallDistribution, DistributionReport]:
    """Minima and maxima of balls without their outliers.

    states: position [m] and velocity [m/s] of the balls' starts, (3, n); landing: (2, n) [m].
    A ball is an outlier when DBSCAN puts it into no cluster. Its eight coordinates are first centred on the median and
    divided by a robust standard deviation (interquartile range / 1.349), so that outliers do not set their own scale.
    The paper gives neither eps nor min_samples. Without ``eps`` it is EPS_FACTOR times the median distance of a ball
    to its (min_samples - 1)-th neighbour, after Ester et al. 1996's k-distance, so that it follows the number of balls.
    Raises ValueError for non-finite input, unequal lengths, fewer than min_samples balls, or when all are outliers.
    """
    from sklearn.cluster import DBSCAN  # sklearn takes about a second to import; only this function needs it
    from sklearn.neighbors import NearestNeighbors

    position, velocity, landing = (np.asarray(a, float) for a in (states.position, states.velocity, landing))
    points = np.concatenate([position, velocity, landing])
    if points.shape[0] != 8 or not np.all(np.isfinite(points)):
        raise ValueError(
            f"finite position (3, n), velocity (3, n) and landing (2, n) are wanted, got a stack of {points.shape}"
        )
    if points.shape[1] < max(min_samples, 2):
        raise ValueError(f"{points.shape[1]} balls are too few for clusters of min_samples={min_samples}")
    low, middle, high = np.percentile(points, [25, 50, 75], axis=1, keepdims=True)
    scale = (high - low) / 1.349
    standard = (points - middle) / np.where(scale > 0, scale, 1.0)
    if eps is None:
        neighbours = NearestNeighbors(n_neighbors=max(min_samples - 1, 1)).fit(standard.T)
        distances, _ = neighbours.kneighbors()  # of the balls themselves: each one's own distance of zero is left out
        eps = EPS_FACTOR * float(np.median(distances[:, -1]))
    outlier = DBSCAN(eps=eps, min_samples=min_samples).fit_predict(standard.T) == -1
    if np.all(outlier):
        raise ValueError(
            f"DBSCAN with eps={eps}, min_samples={min_samples} calls all {outlier.size} balls outliers; raise eps"
        )
    inside = points[:, ~outlier]
    low, high = inside.min(axis=1), inside.max(axis=1)
    distribution = BallDistribution(low[:3], high[:3], low[3:6], high[3:6], low[6:], high[6:], name, source)
    return distribution, DistributionReport(outlier.size, outlier, eps, min_samples)


@dataclass(frozen=True)
class HumanReport:
    """Counts of the measured balls on the way to a distribution."""

    measured: int
    too_short: int  # fewer than MIN_SAMPLES samples before the first bounce
    elsewhere: int  # not from the human's side towards the robot
    outcomes: dict[str, int]  # flights of the others, keys from pool.OUTCOMES
    landed: BallState  # (3, n) starts of those that land on the robot's side
    landing: np.ndarray  # (2, n) [m]
    fit_rms: np.ndarray  # (m,) [m] of each fitted flight; empty where states were measured
    outliers: DistributionReport
    serves: int = 0  # of those that landed


@jax.jit
def _after_own_bounce(params: BallParams, state: BallState) -> BallState:
    """Balls (3, n) AFTER_BOUNCE steps after their first bounce."""

    def advance(carry: tuple[BallState, jax.Array], _: None) -> tuple[tuple[BallState, jax.Array], None]:
        state, since = carry
        new, events = step(params, state, DT)
        over = since >= AFTER_BOUNCE
        state = jax.tree.map(lambda a, b: jnp.where(over, a, b), state, new)
        return (state, jnp.where((since > 0) | events.table, since + 1, 0)), None

    since = jnp.zeros(state.position.shape[1:], jnp.int32)
    (state, _), _ = jax.lax.scan(advance, (state, since), None, length=LONGEST_SERVE)
    return state


def _thrown(params: BallParams, state: BallState) -> Throw:
    """Flights of balls (3, n), simulated in numbers that similar data sets share."""
    n = state.position.shape[1]
    pad = (0, 0), (0, -n % LANDED_TOGETHER)
    padded = jax.tree.map(lambda a: jnp.asarray(np.pad(a, pad, mode="edge"), jnp.float32), state)
    return jax.tree.map(lambda a: np.asarray(a)[..., :n], throw(params, padded, *ROBOT_SIDE))


def fit_human(
    measured: Dataset | MeasuredStates,
    params: BallParams,
    eps: float | None = None,
    min_samples: int = 5,
    name: str = "",
    serves: bool = False,
    fit: Fit = "gauss-newton",
    progress: Callable[[int, int], None] | None = None,
    short_balls: bool = False,
    both_players: bool = False,
) -> tuple[BallDistribution, HumanReport]:
    """The 16 numbers of a person's balls, from trajectories or from start states.

    A ball counts when it starts on the human's side, flies towards the robot, clears the net and lands on the robot's
    side. The bounce that was measured there decides; if there is none, the flight simulated from the start does.
    eps, min_samples: see ``fit_distribution``.
    serves: balls that bounce on the human's side first count as well, from 20 ms after that bounce. Start states of a
    recording may spin; trajectories are taken not to (``mjx_tt.prediction`` estimates their spins).
    fit: of trajectories. Both minimise the same distance, "nelder-mead" as the paper does, "gauss-newton" all at once.
    both_players: strokes of the other player count as well, as if played from the human's side.
    short_balls: the distribution draws balls as well that would bounce twice on the robot's side, if the person played
    any. If False, such balls widen its bounds, but none of them is drawn.
    progress: called with (flights fitted so far, all of them) by Nelder-Mead, which takes a tenth of a second for each.
    Raises ValueError for another fit, for Nelder-Mead on start states and when no ball is left.
    """
    if fit not in get_args(Fit):
        raise ValueError(f"fit {fit!r} is not one of {get_args(Fit)}")
    rms, too_short = np.zeros(0), 0
    if isinstance(measured, MeasuredStates):
        if fit == "nelder-mead":
            raise ValueError(f"{measured.source}: holds start states; {fit} fits trajectories")
        state, bounced = measured.state, measured.landing
    else:
        flights = [free_flight(t) for t in measured]
        long_enough = [t for t in flights if len(t) >= MIN_SAMPLES]
        too_short, bounced = len(flights) - len(long_enough), None
        if fit == "nelder-mead":
            state, rms = fit_nelder_mead(long_enough, params.flight, progress=progress)
        else:
            fitted = fit_gauss_newton(long_enough, params.flight)
            state, rms = fitted.state, fitted.rms
    state = jax.tree.map(np.asarray, state)
    if bounced is None:
        bounced = np.full((2, state.position.shape[1]), np.nan)
    if both_players:
        other = (state.position[1] < 0.0) & (state.velocity[1] > 0.0)
        state = jax.tree.map(lambda a: np.where(other, HALF_TURN * a, a), state)
        bounced = np.where(other, -bounced, bounced)
    towards = (state.position[1] > 0.0) & (state.velocity[1] < 0.0)
    state, bounced = jax.tree.map(lambda a: a[:, towards], (state, bounced))
    if not towards.any():
        raise ValueError(f"{measured.source}: none of {towards.size} balls flies from the human's side to the robot's")
    thrown, served = _thrown(params, state), 0
    outcome, landing = np.asarray(thrown.outcome), np.asarray(thrown.landing)
    own = outcome == OWN_SIDE
    if serves and own.any():
        start = jax.tree.map(lambda a: jnp.asarray(a[:, own], jnp.float32), state)
        start = jax.tree.map(np.asarray, _after_own_bounce(without_nominal(params), start))
        again = _thrown(params, start)
        state, landing, outcome = jax.tree.map(
            lambda old, new: _replaced(old, own, new), (state, landing, outcome), (start, again.landing, again.outcome)
        )
        served = int(np.isin(again.outcome, (KEPT, SECOND_BOUNCE)).sum())
    # What was seen to land has landed, whatever a model that is not quite right makes of it.
    there = (np.abs(bounced[0]) < TABLE_WIDTH / 2) & (bounced[1] < 0.0) & (bounced[1] > -TABLE_LENGTH / 2)
    landing = np.where(there, bounced, landing)
    outcome = np.where(there & (outcome != SECOND_BOUNCE), KEPT, outcome)
    good = (outcome == KEPT) | (outcome == SECOND_BOUNCE)
    counts = np.bincount(outcome, minlength=len(OUTCOMES))
    outcomes = dict(zip(OUTCOMES, counts.tolist(), strict=True))
    if not good.any():
        hint = "; serves are counted with serves=True" if own.any() and not serves else ""
        raise ValueError(f"{measured.source}: none of {towards.size} balls lands on the robot's side: {outcomes}{hint}")
    landed, landing = jax.tree.map(lambda a: a[:, good], (state, landing))
    distribution, outliers = fit_distribution(landed, landing, eps, min_samples, name, measured.source)
    twice = (outcome == SECOND_BOUNCE)[good] & ~outliers.outlier
    distribution = replace(distribution, short_balls=bool(short_balls and twice.any()))
    elsewhere = int((~towards).sum())
    report = HumanReport(len(measured), too_short, elsewhere, outcomes, landed, landing, rms, outliers, served)
    return distribution, report


def _replaced(values: np.ndarray, where: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The values (..., n) with those of the chosen balls replaced."""
    out = np.array(values)
    out[..., where] = new
    return out


@dataclass(frozen=True)
class MixtureReport:
    """Choice of the number of components."""

    balls: int
    scores: dict[int, float]  # components -> mean log likelihood of held-out balls, standardised

    @property
    def chosen(self) -> int:
        """Number of components under which held-out balls are likeliest."""
        return max(self.scores, key=lambda k: self.scores[k])


def start_states(state: BallState) -> Float[np.ndarray, "n 9"]:
    """Start states of balls (3, n), a row each."""
    return np.concatenate([np.asarray(part, np.float64) for part in (state.position, state.velocity, state.spin)]).T


def fit_mixture(
    state: BallState,
    name: str = "",
    source: str = "",
    seed: int = 0,
) -> tuple[BallMixture, MixtureReport]:
    """Mixture of the balls' starts (3, n), with the number of components that held-out balls prefer.

    More components are tried until two in a row do worse. Rows that do not vary (spin, where none is known) stay at
    their value. Raises ValueError for fewer than FEWEST_EACH balls or numbers that are not finite.
    """
    from sklearn.mixture import GaussianMixture  # sklearn takes about a second to import
    from sklearn.model_selection import KFold, cross_val_score

    rows = start_states(state)
    if len(rows) < FEWEST_EACH or not np.all(np.isfinite(rows)):
        raise ValueError(f"{len(rows)} finite start states are too few for a mixture, {FEWEST_EACH} are wanted")
    varies = np.ptp(rows, axis=0) > LEAST_SPREAD
    middle, scale = rows.mean(axis=0), np.where(varies, rows.std(axis=0), 1.0)
    standard = ((rows - middle) / scale)[:, varies]

    def model(k: int, starts: int) -> GaussianMixture:
        return GaussianMixture(k, reg_covar=REGULARISATION, n_init=starts, random_state=seed, tol=TOLERANCE)

    some = standard[np.random.default_rng(seed).permutation(len(standard))[:MOST_BALLS]]
    scores: dict[int, float] = {}
    folds = KFold(FOLDS, shuffle=True, random_state=seed)
    for k in NUMBERS_OF_COMPONENTS:
        if k > 1 and k * FEWEST_EACH > len(some) * (FOLDS - 1) // FOLDS:
            break
        scores[k] = float(np.mean(cross_val_score(model(k, 1), some, cv=folds)))
        if len(scores) > 2 and max(list(scores.values())[-2:]) < max(scores.values()):
            break
    report = MixtureReport(len(rows), scores)
    fitted = model(report.chosen, 1).fit(standard)
    chosen = np.flatnonzero(varies)
    means = np.tile(middle, (report.chosen, 1))
    means[:, chosen] += fitted.means_ * scale[chosen]
    covariances = np.zeros((report.chosen, ROWS, ROWS))
    covariances[:, chosen[:, None], chosen[None]] = fitted.covariances_ * scale[chosen, None] * scale[None, chosen]
    return BallMixture(fitted.weights_, means, covariances, name, source), report
