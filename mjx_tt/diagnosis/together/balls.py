"""Posterior of all effects that a prior names, from flights before a hit: draws for training, and the balls' spins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball import posterior
from mjx_tt.diagnosis.ball.diagnose import FEWEST_BALLS, flights
from mjx_tt.diagnosis.ball.effects import EFFECTS, Numbers
from mjx_tt.diagnosis.ball.flights.fit import first_fit, heading, own_spins
from mjx_tt.diagnosis.ball.flights.forward_model import grid
from mjx_tt.diagnosis.ball.flights.linearization import SPIN, BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.diagnosis.ball.posterior import Posterior
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.sim import bounds
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Samples

DRAWS = 256
# [rad/s] beyond what anybody plays: the fastest loops have some 9,000 turns a minute, 940 rad/s. A ball that seems to
# spin faster met what the model does not have, such as the table's edge, and it alone would decide the spread of all.
FASTEST = 1000.0
LIFT = "ball.flight.magnus_coefficient"
LIFT_ERROR = 0.2  # of the coefficient k, beside what the posterior has: see ``BallsTogether.along_lift``
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

        How much balls curve shows the product of k and spin; that the spins' own spread is learned under one k makes
        the posterior too sure of it. So k has LIFT_ERROR besides, and the others go along as the flights want it.
        """
        paths, found = [e.path for e in self.problem.effects], self.posterior
        theta = np.reshape(found.theta, (-1,) + (1,) * np.ndim(error))
        if LIFT not in paths:
            return theta + np.zeros_like(error)
        lift = paths.index(LIFT)
        way = found.covariance[lift] / found.covariance[lift, lift]
        return theta + np.multiply.outer(way, error)

    def samples(self, lift: Float[np.ndarray, " S"], seed: int = 0) -> Samples:
        """Draws of the parameters by dotted path. lift: error of the coefficient in each of them."""
        found, free, rng = self.posterior, list(self.posterior.free), np.random.default_rng(seed)
        changes = self.along_lift(lift)
        covariance = found.covariance[np.ix_(free, free)]
        changes[free] += rng.multivariate_normal(np.zeros(len(free)), covariance, len(lift), method="eigh").T
        values = self.problem.values(changes)
        paths = tuple(effect.path for effect in self.problem.effects)
        return Samples(paths, np.stack([np.clip(values[p], *bounds.of(p)) for p in paths], axis=1), np.ones(len(lift)))


def fit(
    balls: Sequence[Trajectory], model: SimModel, prior: Prior, say: Callable[[str], None] = lambda text: None
) -> BallsTogether:
    """The posterior of those parameters that the prior has and flights before a hit show.

    Every ball has a spin of its own, unless neither model nor prior has a lift by which it would show.
    Raises ValueError where fewer than FEWEST_BALLS flights can be used, or where nothing of the prior shows in them.
    """
    strokes, _ = clean(balls, True)
    kept = flights(strokes)
    if len(kept) < FEWEST_BALLS:
        raise ValueError(f"{len(kept)} usable flights of {len(balls)}, at least {FEWEST_BALLS} are needed")
    effects = tuple(
        replace(e, scale=prior[e.path][1], express=None)
        for e in EFFECTS
        if e.fit and not e.at_paddle and e.path in prior and not e.made_of
    )
    if not effects:
        raise ValueError(f"nothing that flights show is in the prior, which has {', '.join(prior)}")
    model = models.with_values(model, {e.path: prior[e.path][0] for e in effects})
    while True:
        g = grid(kept)
        problem = BallProblem(g, model, effects, heading(g))
        nominal = Situation(np.zeros(len(effects)), first_fit(problem))
        if problem.nominal[LIFT] == 0.0 and LIFT not in prior:
            return BallsTogether(problem, posterior.fit(problem, nominal, None, (), say))
        say(f"fitting the spins of {g.n} balls")
        found = BallsTogether(problem, posterior.fit(problem, *own_spins(problem, nominal), (), say))
        turning = np.linalg.norm(found.posterior.at.start[SPIN], axis=0) <= FASTEST
        if turning.all() or turning.sum() < FEWEST_BALLS:
            return found
        say(f"left out, for no ball spins as fast: {g.n - turning.sum()}")
        kept = [t for t, real in zip(kept, turning, strict=True) if real]
