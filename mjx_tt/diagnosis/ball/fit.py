"""Fits of the balls' starts: position, velocity and spin of each under given changes of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjx_tt.diagnosis.ball import noise
from mjx_tt.diagnosis.ball.forward_model import Grid, picked, predict
from mjx_tt.diagnosis.ball.linearization import SPIN, START_STEPS, BallProblem, Situation, rows
from mjx_tt.diagnosis.ball.noise import Noise, nominal_noise, robust_weights
from mjx_tt.diagnosis.ball.scores import SpinPrior
from mjx_tt.diagnosis.robust import GAUSSIAN

WINDOWS = (0.1, 0.2, 0.3, 0.4)  # [s] of a flight that the first fit takes in turn
# Coefficient k and mean spin [rad/s] (topspin, gyro, side) to start from where balls may spin fast. In flight only
# their product shows, at the bounce the spin alone.
FAST_SPINS = tuple(
    (k, tuple(sign * w * (a == axis) for a in range(3)))
    for k, w in ((0.6, 100.0), (0.3, 200.0))
    for axis in (0, 2)
    for sign in (1.0, -1.0)
)
FAST_STD = np.full(3, 80.0)  # [rad/s] how far a ball's own spin may then be from it
FEW = 24  # balls on which the spins are tried


def fit_starts(
    problem: BallProblem,
    theta: np.ndarray,
    start: np.ndarray,
    g: Grid,
    noise: Noise | None = None,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    rounds: int = 4,
    keep: np.ndarray | None = None,
) -> np.ndarray:
    """Starts (9, n) of all balls for given changes theta, (K,) or (K, n), by damped Gauss-Newton with robust weights.

    prior: mean and standard deviation (3,) of the spin; without it the balls do not spin (or keep the spin given).
    keep: (T, n) samples that count, all by default.
    """
    noise = nominal_noise(g) if noise is None else noise
    mask = g.mask if keep is None else g.mask & keep
    g = replace(g, mask=mask)
    size = 6 if prior is None else 9
    damping = np.full(g.n, 1e-9)
    theta_v = np.repeat(theta[:, None], 1 + size, axis=1) if theta.ndim == 1 else theta[:, None]
    if theta.ndim == 1:
        theta_v = theta_v[:, :, None]
    best_cost, best = np.full(g.n, np.inf), start
    for _ in range(rounds + 1):
        variants = np.repeat(start[:, None], 1 + size, axis=1)
        for i in range(size):
            variants[i, 1 + i] += START_STEPS[i]
        flown = predict(
            problem.model,
            problem.values(np.broadcast_to(theta_v, (len(theta_v), 1 + size, g.n))),
            variants,
            g,
            problem.axes,
        )
        base = flown.measured[:, :, 0]
        columns = np.moveaxis(flown.measured[:, :, 1:] - base[:, :, None], 2, 0) / START_STEPS[:size, None, None, None]
        residual = np.where(mask, g.measured - base, 0.0)
        weight = robust_weights(residual, noise, g)
        white = rows(residual[None], noise, weight, g)[..., 0]
        cost = (white**2).sum(axis=1)
        if prior is not None:
            pull = (start[SPIN] - prior[0][:, None]) / prior[1][:, None]
            cost = cost + (pull**2).sum(axis=0)
        worse = ~(cost <= best_cost * (1.0 + 1e-9))
        start = np.where(worse, best, start)
        damping = np.where(worse, damping * 100.0 + 1e-6, damping * 0.1)
        best_cost, best = np.where(worse, best_cost, cost), start
        j = rows(columns, noise, weight, g)
        normal, right = j.swapaxes(1, 2) @ j, (j.swapaxes(1, 2) @ white[..., None])[..., 0]
        if prior is not None:
            precision = 1.0 / prior[1] ** 2
            normal[:, SPIN, SPIN] += np.diag(precision)
            right[:, SPIN] -= (precision[:, None] * (start[SPIN] - prior[0][:, None])).T
        scale = np.sqrt(np.diagonal(normal, axis1=1, axis2=2)) + 1e-12
        damped = normal / scale[:, :, None] / scale[:, None, :] + damping[:, None, None] * np.eye(size)
        change = np.linalg.solve(damped + 1e-12 * np.eye(size), (right / scale)[..., None])[..., 0] / scale
        # A ball that was just set back waits: its derivatives belong to the rejected place.
        start = start.copy()
        start[:size] += np.where(worse[:, None], 0.0, change).T
    return best


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
    """(9, n) starts: a parabola through the first samples, then ever longer parts of the flight.

    A flight that bounces has other minima for a start that is far off; growing windows keep the bounce where it is.
    theta: (K,) or (K, n) changes of the effects, none by default. spin: (3,) or (3, n) [rad/s] of the balls, in
    their own axes. part: (T, n) samples that count.
    """
    g = problem.grid if part is None else replace(problem.grid, mask=problem.grid.mask & part)
    theta = np.zeros(len(problem.effects)) if theta is None else theta
    early = g.mask & (g.time <= WINDOWS[0])
    early[:8] |= g.mask[:8]
    start = np.zeros((9, g.n))
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


def fast_spin(problem: BallProblem, start: np.ndarray) -> tuple[Situation, SpinPrior]:
    """Situation and prior about the fast spin, common to all balls, under which the flights fit best.

    From a few spins either way of topspin and sidespin, each with starts of its own, on some of the balls.
    """
    g = problem.grid
    few = np.linspace(0, g.n - 1, min(g.n, FEW)).astype(int)
    count = len(FAST_SPINS)
    many = picked(g, np.tile(few, count))
    tried = BallProblem(many, problem.model, problem.effects, heading(many))
    tried_theta = np.zeros((len(problem.effects), many.n))
    tried_theta[problem.coefficient] = np.repeat([k for k, _ in FAST_SPINS], len(few))
    fitted = first_fit(tried, tried_theta, np.repeat(np.array([w for _, w in FAST_SPINS], float).T, len(few), axis=1))
    left = many.measured - tried.fly(tried_theta, fitted).measured[:, :, 0]
    cost = np.sqrt(np.where(many.mask, (left**2).sum(axis=0), 0.0).sum(axis=0) / many.mask.sum(axis=0))
    best = int(np.argmin(np.median(cost.reshape(count, -1), axis=1)))
    theta, mean = np.zeros(len(problem.effects)), np.array(FAST_SPINS[best][1], float)
    theta[problem.coefficient] = FAST_SPINS[best][0]
    start = first_fit(problem, theta, mean)
    for _ in range(3):
        frame = noise.flight_frame(problem.fly(theta, start).velocity[:, :, 0])
        left = np.where(g.mask, g.measured - problem.fly(theta, start).measured[:, :, 0], 0.0)
        start = fit_starts(problem, theta, start, g, noise.estimate(left, frame, g, 9), (mean, FAST_STD), rounds=3)
        mean = np.median(start[SPIN], axis=1)
    std = np.clip(GAUSSIAN * np.median(np.abs(start[SPIN] - mean[:, None]), axis=1), 1.0, FAST_STD)
    start[SPIN] = mean[:, None]
    return Situation(theta, start), SpinPrior(mean, std)
