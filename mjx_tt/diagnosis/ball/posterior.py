"""All effects of the catalogue at once: their posterior under what is known of them before a ball is measured.

Real set-ups are wrong in many places by ordinary amounts, and the best change of one number depends on all others. An
identification therefore fits all together: Gauss-Newton on the nonlinear model towards the maximum of the evidence,
each ball's start projected out, spins and kicks integrated out about its own best fit (the conditional linearisation of
Lindstrom and Bates, Biometrics 46, 1990), until nothing moves. An effect's prior is Student's: ordinary sizes cost
little, a large one is not forbidden. Intervals take their spread from ball to ball; of a fit that did not settle, its
last step as well.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.ball.effects import FLIGHT, TABLE
from mjx_tt.diagnosis.ball.flights import marginal, noise
from mjx_tt.diagnosis.ball.flights.fit import fit_starts, log_evidence, refit_worst
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS, BallProblem, Linear, Situation
from mjx_tt.diagnosis.ball.flights.marginal import Evidence
from mjx_tt.diagnosis.ball.flights.noise import Noise
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR, MAGNUS_RANGE, SpinPrior

ROUNDS = 7
SETTLED = 0.2  # of a standard deviation by which nothing moves any more
NEARLY_SETTLED = 1.0  # the same, where no share of the step is any better: it was Laplace's approximation that pulled
MEMORY = (0.0, 0.0, 0.3, 0.6, 0.9)  # of the noise, at most, round by round
# Where air lifts no ball spins hardly show, and could be of any size: no air that anybody measured lifts so little.
LEAST_LIFT = 0.03
SHARES = (1.0, 0.5, 0.25, 0.1)  # of a step that are tried in turn
LONGEST_MOVE = 3.0  # scales by which an effect may change in a round
FREEDOM = 4.0  # degrees of Student's distribution of an effect's size


@dataclass(frozen=True)
class Posterior:
    """Changes of all effects together, and the situation about which they were found."""

    theta: Float[np.ndarray, " K"]
    covariance: Float[np.ndarray, "K K"]
    free: tuple[int, ...]  # effects that were fitted; the others stay at zero
    at: Situation
    linear: Linear
    noise: Noise
    prior: SpinPrior | None
    converged: bool

    @property
    def std(self) -> Float[np.ndarray, " K"]:
        """Standard deviations of the changes."""
        return np.sqrt(np.diagonal(self.covariance))


def fit(
    problem: BallProblem,
    at: Situation,
    prior: SpinPrior | None,
    left_out: Container[int],
    say: Callable[[str], None],
    scatter: Float[np.ndarray, 3] = noise.ALIKE,
    besides: tuple[int, float] | None = None,
    held: int = 0,
    near: bool = False,
) -> Posterior:
    """Maximum of the posterior of all effects that are not left out, from a situation with or without spins.

    scatter: [m/s] of the bounces from ball to ball, to start from; zero where they are alike
    besides: an effect and the error of it that the caller will state beside the posterior's; what moves by little of
    that has settled
    held: rounds besides in which the coefficient of lift stays as it is
    near: the situation is a maximum already, of nearly the same balls: all of the noise's memory counts
    """
    g, effects = problem.grid, problem.effects
    free = [
        i
        for i, e in enumerate(effects)
        if i not in left_out and not e.made_of and not (prior is None and (e.needs_spin or i == problem.coefficient))
    ]
    mean, scale = np.zeros(len(effects)), np.array([e.scale for e in effects])
    if problem.coefficient is not None:
        mean[problem.coefficient], scale[problem.coefficient] = MAGNUS_PRIOR
    covariance = np.diag(scale**2)
    converged, stalled = False, 0
    for round_ in range(ROUNDS + held):
        linear = problem.linearise(at)
        most = MEMORY[-1] if near else MEMORY[min(round_, len(MEMORY) - 1)]
        own = _noise(linear, g, prior, most, scatter)
        shown, own, prior = _evidence(problem, linear, at, own, prior, free)
        # Lift and spins are told apart by small differences: not before all else is about right.
        moving = [i for i in free if round_ >= held or effects[i].path != MAGNUS]
        theta, covariance = _solved(shown, at.theta, moving, mean, scale, problem)
        change = theta - at.theta
        # An effect that starts with a threshold has no derivative to settle on.
        smooth = [i for i in free if effects[i].step is None]
        errors = stated(covariance, besides)
        moved = float(np.max(np.abs(change[smooth]) / errors[smooth], initial=0.0))
        before, at = at, _stepped(problem, at, theta, shown, own, prior, mean, scale, free)
        scatter = own.scatter
        say(f"all effects at once, round {round_ + 1}: moved by {moved:.1f} deviations")
        stalled = stalled + 1 if at is before else 0
        if round_ >= held and (moved < SETTLED or stalled >= 2):
            converged = moved < NEARLY_SETTLED
            break
    if not converged:
        covariance += np.outer(change, change)  # where it would go on to it may be as well
    if prior is not None:
        start = refit_worst(problem, at.theta, at.start, g, own, prior)
        at = Situation(at.theta, fit_starts(problem, at.theta, start, g, own, prior))
    linear = problem.linearise(at)
    return Posterior(at.theta, covariance, tuple(free), at, linear, own, prior, converged)


def price_of(theta: Float[np.ndarray, " c"], scale: Float[np.ndarray, " c"]) -> float:
    """Evidence that sizes cost which would surprise: -2 times Student's log density of each."""
    return float((FREEDOM + 1.0) * np.log1p((theta / scale) ** 2 / FREEDOM).sum())


def misfit(problem: BallProblem, at: Situation, spins: SpinPrior, scatter: Float[np.ndarray, 3]) -> float:
    """-2 log of all flights' evidence and the effects' price, but for a constant, under the noise that they show."""
    g, linear = problem.grid, problem.linearise(at)
    own = _noise(linear, g, spins, 0.0, scatter)
    flights = marginal.starts_out(linear, at, own, noise.robust_weights(linear.residual, own, g), problem)
    prior, scatter = marginal.distributions(marginal.products(linear, flights), at.theta, spins, scatter)
    cost = log_evidence(problem, at.theta, at.start, g, replace(own, scatter=scatter), prior, 2)[1]
    spread = 2.0 * np.log(own.scale).sum(axis=0) * g.mask.sum(axis=0)
    return float((cost + spread).sum() + price_of(at.theta, np.array([e.scale for e in problem.effects])))


def _noise(linear: Linear, g: Grid, spins: SpinPrior | None, memory: float, scatter: Float[np.ndarray, 3]) -> Noise:
    frame = noise.flight_frame(linear.base.velocity[:, :, 0])
    own = noise.estimate(linear.residual, frame, g, 6 if spins is None else 9)
    return replace(noise.without_memory(own, memory), scatter=scatter)


def _evidence(
    problem: BallProblem, linear: Linear, at: Situation, own: Noise, prior: SpinPrior | None, free: list[int]
) -> tuple[Evidence, Noise, SpinPrior | None]:
    """Evidence about all effects, with the most likely distributions of kicks, in the noise, and of spins."""
    flights = marginal.starts_out(linear, at, own, noise.robust_weights(linear.residual, own, problem.grid), problem)
    p = marginal.products(linear, flights)
    prior, scatter = marginal.distributions(p, at.theta, prior, own.scatter)
    physical = [i for i in free if problem.effects[i].path.startswith((FLIGHT, TABLE))]  # all others are the cameras'
    more = None if prior is None else marginal.growth(problem, flights, linear, at, physical)
    return marginal.evidence(p, at.theta, prior, scatter, more), replace(own, scatter=scatter), prior


def stated(covariance: Float[np.ndarray, "K K"], besides: tuple[int, float] | None = None) -> Float[np.ndarray, " K"]:
    """Standard deviations, where one effect has an error besides, along which the others go as they must."""
    variances = np.diagonal(covariance)
    if besides is None:
        return np.sqrt(variances)
    which, error = besides
    return np.sqrt(variances + (covariance[which] / covariance[which, which] * error) ** 2)


def _stepped(
    problem: BallProblem,
    at: Situation,
    theta: Float[np.ndarray, " K"],
    shown: Evidence,
    own: Noise,
    prior: SpinPrior | None,
    mean: np.ndarray,
    scale: np.ndarray,
    free: list[int],
) -> Situation:
    """Situation as far on the way to theta as flights and priors together get better, and where they are the best.

    A ball that slides through its bounce grips the table a little further on: a whole step across that corner lands
    where the derivatives lead straight back.
    """

    def price(changes: np.ndarray) -> float:
        return price_of((changes - mean)[free], scale[free])

    g = problem.grid
    best, least = at, float(log_evidence(problem, at.theta, at.start, g, own, prior, 0)[1].sum()) + price(at.theta)
    reach = shown.reach(theta - at.theta)
    for share in SHARES:
        there = at.theta + share * reach * (theta - at.theta)
        spins, scatter = shown.followed(there - at.theta, prior, own.scatter)
        start, cost = log_evidence(problem, there, at.start, g, replace(own, scatter=scatter), spins, 3)
        total = float(cost.sum()) + price(there)
        if total >= least and best is not at:
            break
        if total < least:
            best, least = Situation(there, start), total
            if share == 1.0:
                break
    return best


def _solved(
    flights: Evidence,
    before: np.ndarray,
    free: list[int],
    mean: np.ndarray,
    scale: np.ndarray,
    problem: BallProblem,
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K K"]]:
    """Changes of all effects from the evidence, and their covariance by the sandwich over balls."""
    count, low = len(scale), np.array([e.low for e in problem.effects])
    away = (before - mean) / scale
    precision = (FREEDOM + 1.0) / (FREEDOM + away**2) / scale**2
    held: list[int] = []
    while True:
        chosen = [i for i in free if i not in held]
        pull = precision[chosen]
        gram = flights.information(chosen, pull)
        right = flights.right.sum(axis=0)[chosen] + pull * mean[chosen]
        size = 1.0 / np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
        inverse = np.linalg.pinv(gram * size[:, None] * size, hermitian=True) * size[:, None] * size
        found = inverse @ right
        below = [i for i, value in zip(chosen, found, strict=True) if value < low[i]]
        if not below:
            break
        held += below
    lift = [k for k, i in enumerate(chosen) if problem.effects[i].path == MAGNUS]
    if lift:
        missing = max(LEAST_LIFT - problem.nominal[MAGNUS] - found[lift[0]], 0.0)
        found = found + inverse[lift[0]] / inverse[lift[0], lift[0]] * missing  # the others as is best beside it
    left = flights.right[:, chosen] - flights.gram[:, chosen][:, :, chosen] @ found
    spread = left.T @ left + np.diag(pull)
    full = inverse @ spread @ inverse
    theta = np.zeros(count)
    theta[chosen] = found
    theta[held] = low[held]
    step = LONGEST_MOVE * scale
    theta = before + np.clip(theta - before, -step, step)
    if problem.coefficient is not None and problem.coefficient in free:
        theta[problem.coefficient] = np.clip(theta[problem.coefficient], *MAGNUS_RANGE)
    covariance = np.diag(scale**2)
    covariance[np.ix_(chosen, chosen)] = full
    return theta, covariance
