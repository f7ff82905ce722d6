"""Fits of the balls' starts: position, velocity and spin of each under given changes of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mjx_tt.diagnosis.ball.flights import noise
from mjx_tt.diagnosis.ball.flights.forward_model import Grid, picked, predict
from mjx_tt.diagnosis.ball.flights.linearization import KICK, SPIN, START_STEPS, BallProblem, Situation, project
from mjx_tt.diagnosis.ball.flights.noise import (
    HUBER,
    LEAST_SCATTER,
    Noise,
    Whitening,
    nominal_noise,
    robust_weights,
    weights_at,
)
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR, SpinPrior, learned

WINDOWS = (0.1, 0.2, 0.3, 0.4)  # [s] of a flight that the first fit takes in turn
LEAST_DAMPING = 1e-9
SPINS_TO_TRY = ((0.0, 0.0, 0.0), (100.0, 0.0, 0.0), (-100.0, 0.0, 0.0))  # [rad/s] for each ball
OTHER_SPINS = (*SPINS_TO_TRY, (0.0, 0.0, 100.0), (0.0, 0.0, -100.0), (0.0, 100.0, 0.0), (0.0, -100.0, 0.0))
WORST = 1.35  # times the median cost of a sample beyond which a ball is tried again
BROAD = SpinPrior(np.zeros(3), np.array([80.0, 60.0, 80.0]))  # [rad/s] of spins before anything is known of them


def fit_starts(
    problem: BallProblem,
    theta: np.ndarray,
    start: np.ndarray,
    g: Grid,
    noise: Noise | None = None,
    prior: SpinPrior | None = None,
    rounds: int = 4,
    keep: np.ndarray | None = None,
) -> np.ndarray:
    """Starts (12, n) of all balls for given changes theta, (K,) or (K, n), by damped Gauss-Newton with robust weights.

    prior: distribution of the spins; without it the balls do not spin (or keep the spin given).
    keep: (T, n) samples that count, all by default.
    """
    return fit_flights(problem, theta, start, g, noise, prior, rounds, keep).start


def log_evidence(
    problem: BallProblem,
    theta: np.ndarray,
    start: np.ndarray,
    g: Grid,
    noise: Noise,
    prior: SpinPrior | None,
    rounds: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Starts (12, n) as of ``fit_starts``, and -2 log of each ball's evidence (n,) but for a constant.

    Spin and kick are integrated out by Laplace's approximation. The best fit alone would do without the determinant,
    and prefer what makes spins show more, such as a larger lift: the same flights by smaller spins.
    """
    f = fit_flights(problem, theta, start, g, noise, prior, rounds)
    spread = np.linalg.slogdet(f.information)[1] - np.linalg.slogdet(f.information[:, :6, :6])[1]
    return f.start, f.cost + spread - np.linalg.slogdet(f.known[:, 6:, 6:])[1]


class Fit(NamedTuple):
    """Fits of n balls' own unknowns."""

    start: np.ndarray  # (12, n)
    cost: np.ndarray  # (n,) whitened squares, and the prior's pull
    active: list[int]  # the a rows of ``start`` that were fitted
    information: np.ndarray  # (n, a, a) about these, with what was known before
    known: np.ndarray  # (n, a, a) of that, what was known before


def fit_flights(
    problem: BallProblem,
    theta: np.ndarray,
    start: np.ndarray,
    g: Grid,
    noise: Noise | None = None,
    prior: SpinPrior | None = None,
    rounds: int = 4,
    keep: np.ndarray | None = None,
) -> Fit:
    """Fits of all balls; arguments as of ``fit_starts``."""
    noise = nominal_noise(g) if noise is None else noise
    mask = g.mask if keep is None else g.mask & keep
    g = replace(g, mask=mask)
    whitening = Whitening(noise, g)
    active = [*range(6), *([] if prior is None else range(6, 9)), *(range(9, 12) if noise.scatter.any() else [])]
    size = len(active)
    damping = np.full(g.n, LEAST_DAMPING)
    theta_v = np.repeat(theta[:, None], 1 + size, axis=1) if theta.ndim == 1 else theta[:, None]
    if theta.ndim == 1:
        theta_v = theta_v[:, :, None]
    best_cost, best = np.full(g.n, np.inf), start
    normal, right = np.zeros((g.n, size, size)), np.zeros((g.n, size))  # at the best place
    middle, precision = np.zeros((12, g.n)), np.zeros((g.n, 12, 12))  # of what is known of a start beforehand
    if prior is not None:
        middle[SPIN], precision[:, SPIN, SPIN] = prior.of_balls(g.n)
    if noise.scatter.any():
        precision[:, KICK, KICK] = np.diag(np.maximum(noise.scatter, LEAST_SCATTER) ** -2.0)
    for _ in range(rounds + 1):
        variants = np.repeat(start[:, None], 1 + size, axis=1)
        for k, i in enumerate(active):
            variants[i, 1 + k] += START_STEPS[i]
        flown = predict(
            problem.model,
            problem.values(np.broadcast_to(theta_v, (len(theta_v), 1 + size, g.n))),
            variants,
            g,
            problem.axes,
        )
        base = flown.measured[:, :, 0]
        columns = np.moveaxis(flown.measured[:, :, 1:] - base[:, :, None], 2, 0) / START_STEPS[active, None, None, None]
        residual = np.where(mask, g.measured - base, 0.0)
        distance = whitening.distance(residual)
        # Huber's own cost: with weights that follow the residual a step away from outliers would look like a gain.
        cost = np.where(distance <= HUBER, distance**2, 2.0 * HUBER * distance - HUBER**2).sum(axis=0)
        pull = np.einsum("nab,bn->na", precision, start - middle)
        cost = cost + ((start - middle) * pull.T).sum(axis=0)
        better = cost <= best_cost * (1.0 + 1e-9)
        weight = weights_at(distance)
        white, j = whitening.rows(residual[None], weight)[..., 0], whitening.rows(columns, weight)
        here, slope = j.swapaxes(1, 2) @ j, (j.swapaxes(1, 2) @ white[..., None])[..., 0]
        here += precision[:, active][:, :, active]
        slope -= pull[:, active]
        normal, right = np.where(better[:, None, None], here, normal), np.where(better[:, None], slope, right)
        best_cost, best = np.where(better, cost, best_cost), np.where(better, start, best)
        damping = np.where(better, np.maximum(damping * 0.1, LEAST_DAMPING), np.maximum(damping * 30.0, 1e-3))
        scale = np.sqrt(np.diagonal(normal, axis1=1, axis2=2)) + 1e-12
        damped = normal / scale[:, :, None] / scale[:, None, :] + damping[:, None, None] * np.eye(size)
        change = np.linalg.solve(damped + 1e-12 * np.eye(size), (right / scale)[..., None])[..., 0] / scale
        start = best.copy()
        start[active] += change.T
    return Fit(best, best_cost, active, normal, precision[:, active][:, :, active])


def fit_spins(
    problem: BallProblem,
    theta: np.ndarray,
    start: np.ndarray,
    g: Grid,
    noise: Noise | None = None,
    prior: SpinPrior = BROAD,
    tries: Sequence[tuple[float, float, float]] = SPINS_TO_TRY,
) -> np.ndarray:
    """Starts (12, n) with a spin of each ball's own, of any size: the best of fits from several spins.

    A ball may slide or roll at the bounce, and each is a valley of its own: from balls that do not spin the other one
    is not always found. prior: wide, so that only what the flight does not show is drawn to it.
    """
    count = len(tries)
    tried = of_some(problem, np.tile(np.arange(g.n), count))
    many = tried.grid
    begin = np.tile(start, count)
    begin[SPIN] = np.repeat(np.array(tries, float).T, g.n, axis=1)
    changes = theta if theta.ndim == 1 else np.tile(theta, count)
    tiled = None
    if noise is not None:
        tiled = replace(noise, frame=np.tile(noise.frame, count), scale=np.tile(noise.scale, count))
    fitted, cost, *_ = fit_flights(tried, changes, begin, many, tiled, prior, rounds=8)
    best = np.argmin(np.where(np.isfinite(cost), cost, np.inf).reshape(count, g.n), axis=0)
    return fitted.reshape(12, count, g.n)[:, best, np.arange(g.n)]


def refit_worst(
    problem: BallProblem, theta: np.ndarray, start: np.ndarray, g: Grid, noise: Noise, prior: SpinPrior
) -> np.ndarray:
    """Starts (12, n); those of balls that fit worst are tried again from other spins, and kept where that is better.

    A ball whose fit ended in the wrong valley would look like one that flies unlike the others.
    """
    cost = fit_flights(problem, theta, start, g, noise, prior, rounds=0).cost
    per_sample = cost / np.maximum(g.mask.sum(axis=0), 1)
    worst = np.flatnonzero(per_sample > WORST * np.median(per_sample))
    if not worst.size:
        return start
    some = of_some(problem, worst)
    few = some.grid
    own = replace(noise, frame=noise.frame[..., worst], scale=noise.scale[:, worst])
    again = fit_spins(some, theta, start[:, worst], few, own, prior.of_some(worst), OTHER_SPINS)
    again, new, *_ = fit_flights(some, theta, again, few, own, prior.of_some(worst))
    out = start.copy()
    out[:, worst] = np.where(new < cost[worst], again, start[:, worst])
    return out


def of_some(problem: BallProblem, index: Int[np.ndarray, " m"]) -> BallProblem:
    """The problem of the balls with these indices alone, which may repeat."""
    g = picked(problem.grid, index)
    return BallProblem(g, problem.model, problem.effects, heading(g))


def heading(g: Grid) -> np.ndarray:
    """(3, n) way of each ball over its first samples."""
    k = np.minimum(g.last, 8)
    return g.measured[:, k, np.arange(g.n)] - g.measured[:, 0]


def first_fit(
    problem: BallProblem,
    theta: np.ndarray | None = None,
    spin: np.ndarray | None = None,
    part: np.ndarray | None = None,
) -> np.ndarray:
    """(12, n) starts: a parabola through the first samples, then ever longer parts of the flight.

    A flight that bounces has other minima for a start that is far off; growing windows keep the bounce where it is.
    theta: (K,) or (K, n) changes of the effects, none by default. spin: (3,) or (3, n) [rad/s] of the balls, in
    their own axes. part: (T, n) samples that count.
    """
    g = problem.grid if part is None else replace(problem.grid, mask=problem.grid.mask & part)
    theta = np.zeros(len(problem.effects)) if theta is None else theta
    early = g.mask & (g.time <= WINDOWS[0])
    early[:8] |= g.mask[:8]
    start = np.zeros((12, g.n))
    for i in range(g.n):
        time, place = g.time[early[:, i], i], g.measured[:, early[:, i], i]
        fall = np.array([0.0, 0.0, -4.9])[:, None] * time**2
        line = np.polynomial.polynomial.polyfit(time, (place - fall).T, 1)
        start[:3, i], start[3:6, i] = line
    if spin is not None:
        start[SPIN] = spin[:, None] if spin.ndim == 1 else spin
    for window in WINDOWS:
        keep = (g.time <= window) | (np.arange(len(g.time)) < 8)[:, None]
        start = fit_starts(problem, theta, start, g, rounds=2, keep=keep)
    return fit_starts(problem, theta, start, g, rounds=4)


def own_spins(problem: BallProblem, nominal: Situation) -> tuple[Situation, SpinPrior]:
    """Situation with a spin of each ball's own under the nominal model, and the distribution of all.

    Where the nominal model has no Magnus force, under a coefficient k of the middle of what is known of it.
    """
    g, theta = problem.grid, nominal.theta.copy()
    if problem.coefficient is not None:
        theta[problem.coefficient] = MAGNUS_PRIOR[0]
    start = fit_spins(problem, theta, nominal.start, g)
    for _ in range(2):
        at = Situation(theta, start)
        linear = problem.linearise(at)
        frame = noise.flight_frame(linear.base.velocity[:, :, 0])
        own = noise.without_memory(noise.estimate(linear.residual, frame, g, 9))
        p = project(linear, Situation(np.zeros_like(theta), start), own, robust_weights(linear.residual, own, g), g)
        prior = learned(p.spin_gram, p.spin_right)
        start = fit_starts(problem, theta, start, g, own, prior)
    return Situation(theta, start), prior
