"""Posterior of all effects that a prior names, from flights before a hit: draws for training, and the balls' spins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ballmodel.constants import BALL_RADIUS, TABLE_LENGTH, TABLE_WIDTH
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball import posterior
from mjx_tt.diagnosis.ball.diagnose import FEWEST_BALLS, flights
from mjx_tt.diagnosis.ball.effects import EFFECTS, Numbers
from mjx_tt.diagnosis.ball.flights.fit import first_fit, heading, of_some, own_spins
from mjx_tt.diagnosis.ball.flights.forward_model import grid
from mjx_tt.diagnosis.ball.flights.linearization import SPIN, BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.diagnosis.ball.posterior import Posterior
from mjx_tt.diagnosis.ball.search import SCATTER
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Samples

DRAWS = 256
# A ball that met what the model does not have may decide the spread of all spins by itself, and then all else. Left out
# are bounces at the table's edge, deviations of so many medians before and after all is fitted, and spins that nobody
# plays: the fastest loops have some 9,000 turns a minute, 940 rad/s.
EDGE, NEAR_TABLE = 0.03, 0.06  # [m] from the edge; of the lowest sample from where a ball touches the table
WORST, WORST_FITTED = 5.0, 2.0
FASTEST = 1000.0  # [rad/s]
LEFT_OUT = "left out, for no ball flies like that: {}"
FEW = 60  # balls, at most, that say where to begin
LIFT_HELD = 2  # rounds in which the coefficient of lift stays as it is believed, until all else is about right
LIFT = "ball.flight.magnus_coefficient"
LIFT_ERROR = 0.1  # of the coefficient k, beside what the posterior has: see ``BallsTogether.along_lift``
Prior = Mapping[str, tuple[float, float]]  # mean and standard deviation by dotted path


@dataclass(frozen=True)
class BallsTogether:
    """The posterior of the flights under a model."""

    problem: BallProblem
    posterior: Posterior

    @property
    def spins(self) -> SpinPrior | None:
        """Distribution of the balls' spins in axes of their own heading; None in a model whose air lifts no ball."""
        return self.posterior.prior

    def model(self) -> SimModel:
        """The model with the balls' spins, for balls that come towards the robot."""
        if self.spins is None:
            return self.problem.model
        spread = zip("xyz", self.spins.mean, self.spins.std, strict=True)
        values = {
            f"ball_spin.{kind}_{axis}": float(value)
            for axis, mean, std in spread
            for kind, value in (("mean", mean), ("std", std))
        }
        return models.with_values(self.problem.model, values)

    def along_lift(self, error: Numbers) -> Float[np.ndarray, "K ..."]:
        """Changes of all effects when the coefficient of lift is off by ``error``, a number or an array.

        How much balls curve shows the product of k and spin, and the two come apart by small differences between the
        flight before and after the bounce, in which a law of lift or bounce that is not quite the model's shows as
        well. So k has LIFT_ERROR besides, and the others go along as the flights want it, as far as air lifts at all.
        """
        paths, found = [e.path for e in self.problem.effects], self.posterior
        theta = np.reshape(found.theta, (-1,) + (1,) * np.ndim(error))
        if LIFT not in paths:
            return theta + np.zeros_like(error)
        lift = paths.index(LIFT)
        way = found.covariance[lift] / found.covariance[lift, lift]
        return theta + np.multiply.outer(way, np.maximum(error, -self.problem.nominal[LIFT] - found.theta[lift]))

    def samples(self, lift: Float[np.ndarray, " S"], seed: int = 0) -> Samples:
        """Draws of the parameters by dotted path. lift: error of the coefficient in each of them."""
        found, free, rng = self.posterior, list(self.posterior.free), np.random.default_rng(seed)
        changes = self.along_lift(lift)
        covariance = found.covariance[np.ix_(free, free)]
        changes[free] += rng.multivariate_normal(np.zeros(len(free)), covariance, len(lift), method="eigh").T
        values = self.problem.values(changes)
        paths = tuple(effect.path for effect in self.problem.effects)
        columns = [np.clip(values[path], *models.bounds(path)) for path in paths]
        return Samples(paths, np.stack(columns, axis=1), np.ones(len(lift)))


def fit(
    balls: Sequence[Trajectory], model: SimModel, prior: Prior, say: Callable[[str], None] = lambda text: None
) -> BallsTogether:
    """The posterior of those parameters that the prior has and flights before a hit show.

    Every ball has a spin of its own, unless neither model nor prior has a lift by which it would show.
    Raises ValueError where fewer than FEWEST_BALLS flights can be used, or where nothing of the prior shows in them.
    """
    strokes, _ = clean(balls, True)
    flown = flights(strokes)
    kept = [t for t in flown if clear_of_the_edge(t)]
    if len(kept) < len(flown):
        say(f"left out, for they bounced at the table's edge: {len(flown) - len(kept)}")
    usual = models.paths()
    # An effect's least change is one from the nominal model; here changes are from the middle of its prior.
    effects = tuple(
        replace(e, scale=prior[e.path][1], express=None, low=e.low + usual[e.path] - prior[e.path][0])
        for e in EFFECTS
        if e.fit and not e.at_paddle and e.path in prior and not e.made_of
    )
    if not effects:
        raise ValueError(f"nothing that flights show is in the prior, which has {', '.join(prior)}")
    model = models.with_values(model, {e.path: prior[e.path][0] for e in effects})
    first: Posterior | None = None  # of a few balls
    while True:
        if len(kept) < FEWEST_BALLS:
            raise ValueError(f"{len(kept)} usable flights of {len(balls)}, at least {FEWEST_BALLS} are needed")
        g = grid(kept)
        problem = BallProblem(g, model, effects, heading(g))
        theta = np.zeros(len(effects))
        if problem.nominal[LIFT] == 0.0 and LIFT not in prior:
            nominal = Situation(theta, first_fit(problem))
            return BallsTogether(problem, posterior.fit(problem, nominal, None, (), say, SCATTER))
        lift = [i for i, effect in enumerate(effects) if effect.path == LIFT]
        besides = (lift[0], LIFT_ERROR) if lift else None
        if lift and first is None:
            first = _of_few(problem, lift[0], say)
        say(f"fitting the spins of {g.n} balls")
        situation, spins, ordinary = _begun(problem, theta if first is None else first.theta)
        if not ordinary.all():
            say(LEFT_OUT.format(g.n - ordinary.sum()))
            kept = [t for t, real in zip(kept, ordinary, strict=True) if real]
            continue
        found, index = _fitted(problem, situation, spins, besides, first, say)
        if found is not None:
            return found
        kept = [kept[i] for i in index]


def _begun(problem: BallProblem, theta: Float[np.ndarray, " K"]) -> tuple[Situation, SpinPrior, Bool[np.ndarray, " n"]]:
    """Balls with spins of their own under changes theta, the distribution of these, and which balls are ordinary."""
    situation, spins = own_spins(problem, Situation(theta, first_fit(problem, theta)))
    deviation = _deviation(problem, situation)
    return situation, spins, deviation <= WORST * np.median(deviation)


def _of_few(problem: BallProblem, lift: int, say: Callable[[str], None]) -> Posterior:
    """The posterior of a few of the balls: the better of two fits, from the lift that is believed and from hardly any.

    Under a lift that the air does not have the balls' own spins come out as no ball spins, all else goes astray with
    them, and Gauss-Newton does not find back.
    """
    few = of_some(problem, np.unique(np.linspace(0, problem.grid.n - 1, FEW).round().astype(int)))
    say(f"{few.grid.n} balls first, as if air lifted them and as if it did not")
    hardly = np.zeros(len(problem.effects))
    hardly[lift] = posterior.LEAST_LIFT - problem.nominal[LIFT]
    fits = []
    for theta, held in ((np.zeros_like(hardly), LIFT_HELD), (hardly, 0)):
        at, spins, ordinary = _begun(few, theta)
        stay = np.flatnonzero(ordinary)
        some = of_some(few, stay)
        at = Situation(theta, at.start[:, stay])
        found = posterior.fit(some, at, spins.of_some(stay), (), say, SCATTER, (lift, LIFT_ERROR), held)
        of_all = posterior.misfit(some, found.at, found.prior or spins, found.noise.scatter)
        fits.append((of_all / some.grid.mask.sum(), found))
    return min(fits, key=lambda one: np.nan_to_num(one[0], nan=np.inf))[1]


def _fitted(
    problem: BallProblem,
    at: Situation,
    spins: SpinPrior,
    besides: tuple[int, float] | None,
    first: Posterior | None,
    say: Callable[[str], None],
) -> tuple[BallsTogether | None, Int[np.ndarray, " m"]]:
    """The posterior of the balls with these indices, which fly like each other; None where all has to begin anew.

    first: of a few of them, where the fit begins. A fit that settled is gone on with when some of its balls are left
    out; one that did not is no place to begin.
    """
    index, near = np.arange(problem.grid.n), first is not None
    scatter = SCATTER if first is None else first.noise.scatter
    while True:
        whole = posterior.fit(problem, at, spins, (), say, scatter, besides, near=near)
        deviation = _deviation(problem, whole.at)
        ordinary = deviation <= WORST_FITTED * np.median(deviation)
        ordinary &= np.linalg.norm(whole.at.start[SPIN], axis=0) <= FASTEST
        if ordinary.all():
            return BallsTogether(problem, whole), index
        say(LEFT_OUT.format(np.sum(~ordinary)))
        index, stay = index[ordinary], np.flatnonzero(ordinary)
        if not whole.converged or whole.prior is None or len(index) < FEWEST_BALLS:
            return None, index
        problem, spins = of_some(problem, stay), whole.prior.of_some(stay)
        at, scatter, near = Situation(whole.at.theta, whole.at.start[:, stay]), whole.noise.scatter, True


def clear_of_the_edge(ball: Trajectory) -> bool:
    """False for a ball whose first bounce is so near to the table's edge that the edge may have been hit."""
    x, y, z = ball.position
    inner = z[1:-1]
    low = np.flatnonzero((inner <= z[:-2]) & (inner < z[2:]) & (np.abs(inner - BALL_RADIUS) < NEAR_TABLE)) + 1
    if not low.size:
        return True
    inside = TABLE_WIDTH / 2 - np.abs(x[low[0]]), TABLE_LENGTH / 2 - np.abs(y[low[0]])
    return bool(min(inside) > EDGE or min(inside) < -EDGE)


def _deviation(problem: BallProblem, situation: Situation) -> Float[np.ndarray, " n"]:
    """Root mean square [m] of each ball's measured positions less the model's."""
    left = np.asarray(problem.linearise(situation).residual)
    return np.sqrt((left**2).sum(axis=(0, 1)) / np.maximum(problem.grid.mask.sum(axis=0), 1))
