"""The evidence of flights whose spins and kicks nobody saw, beside SciPy's density of the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.effects import EFFECTS
from mjx_tt.diagnosis.ball.flights import marginal
from mjx_tt.diagnosis.ball.flights.fit import heading
from mjx_tt.diagnosis.ball.flights.forward_model import grid
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS, BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.marginal import Products
from mjx_tt.diagnosis.ball.flights.noise import nominal_noise
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.sim.model import SimModel, with_values
from tests.exam.generator.world import World, fly

BALLS, ROWS, STARTS = 500, 14, 2
TRUTH = np.array([0.6, -0.4])  # by how much spins show; of a column without spin
SPREAD = np.array([2.0, 1.0, 1.5, 0.4, 0.6, 0.3])  # deviations of spins and kicks
MEAN = np.array([1.0, 0.0, -0.5])


class Bilinear:
    """y = N start + (1 + theta_0) M spin + L spin + K kick + c theta_1 + noise, each ball with rows of its own."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.starts = rng.normal(size=(BALLS, ROWS, STARTS))
        self.flown, self.bounced, self.kicked = (0.7 * rng.normal(size=(BALLS, ROWS, 3)) for _ in range(3))
        self.column = 0.1 * rng.normal(size=(BALLS, ROWS)) + 0.1 * self.flown[..., 0]
        spin = MEAN + SPREAD[:3] * rng.normal(size=(BALLS, 3))
        kick = SPREAD[3:] * rng.normal(size=(BALLS, 3))
        own = (self.of_own(TRUTH[0]) @ np.concatenate([spin, kick], axis=1)[..., None])[..., 0]
        start = (self.starts @ rng.normal(0.0, 5.0, (BALLS, STARTS, 1)))[..., 0]
        self.seen = start + own + TRUTH[1] * self.column + rng.normal(size=(BALLS, ROWS))
        # Rows in which no start shows.
        self.rest = np.linalg.qr(self.starts, mode="complete")[0][:, :, STARTS:].swapaxes(1, 2)

    def of_own(self, lift: float) -> np.ndarray:
        return np.concatenate([(1.0 + lift) * self.flown + self.bounced, self.kicked], axis=2)

    def moments(self, theta: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of what is seen in the rows in which no start shows: less its mean (n, m), and covariance (n, m, m)."""
        own = self.rest @ self.of_own(theta[0])
        middle = own[:, :, :3] @ mean + (self.rest @ self.column[..., None])[..., 0] * theta[1]
        seen = (self.rest @ self.seen[..., None])[..., 0]
        return seen - middle, own @ (spread[:, None] ** 2 * own.swapaxes(1, 2)) + np.eye(ROWS - STARTS)

    def log_density(self, theta: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """(n,) of each ball."""
        left, covariance = self.moments(theta, mean, spread)
        explained = (left * np.linalg.solve(covariance, left[..., None])[..., 0]).sum(axis=1)
        return -0.5 * (np.linalg.slogdet(2.0 * np.pi * covariance)[1] + explained)

    def products(self, theta: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> tuple[Products, np.ndarray]:
        """Linearised about theta and each ball's own best spin and kick."""
        own = self.rest @ self.of_own(theta[0])
        left = self.rest @ (self.seen - self.column * theta[1])[..., None] - (own[:, :, :3] @ mean)[..., None]
        precision = np.diag(spread**-2.0)
        best = np.linalg.solve(own.swapaxes(1, 2) @ own + precision, own.swapaxes(1, 2) @ left)[..., 0]
        best[:, :3] += mean
        lifted = self.rest @ self.flown
        effects = np.stack([(lifted @ best[:, :3, None])[..., 0], (self.rest @ self.column[..., None])[..., 0]], axis=2)
        target = (self.rest @ self.seen[..., None])[..., 0] + effects[..., 0] * theta[0]
        more = np.zeros((BALLS, 6, 3, 2))
        more[..., 0] = own.swapaxes(1, 2) @ lifted
        p = Products(
            effects.swapaxes(1, 2) @ effects,
            np.einsum("nrk,nr->nk", effects, target),
            own.swapaxes(1, 2) @ own,
            own.swapaxes(1, 2) @ effects,
            np.einsum("nra,nr->na", own, target),
        )
        return p, more

    def most_likely(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean and spread of spins and kicks under which the balls are the most likely, and the log likelihood."""

        def cost(x: np.ndarray) -> float:
            return -float(self.log_density(theta, x[:3], np.exp(x[3:])).sum())

        found = minimize(cost, np.r_[MEAN, np.log(SPREAD)], method="BFGS", options={"gtol": 0.05, "maxiter": 25})
        return found.x[:3], np.exp(found.x[3:]), -float(found.fun)


def one_gaussian(mean: np.ndarray, spread: np.ndarray) -> SpinPrior:
    own = np.repeat(mean[:, None], BALLS, axis=1)
    return SpinPrior(mean, spread, own, np.broadcast_to(np.diag(spread**2), (BALLS, 3, 3)))


@pytest.fixture(scope="module")
def balls() -> Bilinear:
    return Bilinear(3)


def test_density_is_scipys(balls):
    left, covariance = balls.moments(TRUTH, MEAN, SPREAD)
    expected = [multivariate_normal.logpdf(x, cov=c) for x, c in zip(left[:20], covariance[:20], strict=True)]
    np.testing.assert_allclose(balls.log_density(TRUTH, MEAN, SPREAD)[:20], expected, rtol=1e-9)


@pytest.mark.parametrize("theta", [TRUTH, np.array([0.45, -0.2])])
def test_gradient_is_that_of_the_density(balls, theta):
    """At the most likely mean and spread, which follow theta without a cost of first order."""
    mean, spread, _ = balls.most_likely(theta)
    p, more = balls.products(theta, mean, spread)
    found = marginal.evidence(p, theta, one_gaussian(mean, spread[:3]), spread[3:], more)
    gradient = found.right.sum(axis=0) - found.gram.sum(axis=0) @ theta
    for k in range(2):
        step = np.eye(2)[k] * 1e-4
        up, down = (balls.log_density(theta + s, mean, spread).sum() for s in (step, -step))
        # Of the largest sum of single balls' shares that is taken away in it.
        assert gradient[k] == pytest.approx((up - down) / 2e-4, abs=0.01 * np.sqrt(found.gram.sum(axis=0)[k, k]) + 0.5)


@pytest.fixture(scope="module")
def information(balls) -> np.ndarray:
    """(2, 2) by differences of the likelihood with mean and spread the most likely at each place."""
    h = np.array([0.1, 0.1])

    def at(i: float, j: float) -> float:
        return balls.most_likely(TRUTH + h * np.array([i, j]))[2]

    middle = at(0, 0)
    own = [-(at(*e) - 2.0 * middle + at(*(-np.array(e)))) / s**2 for e, s in zip(np.eye(2), h, strict=True)]
    mixed = -(at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)) / (4.0 * h[0] * h[1])
    return np.array([[own[0], mixed], [mixed, own[1]]])


def test_information_is_the_curvature_of_what_is_left_when_mean_and_spread_follow(balls, information):
    """Nothing that only the spins' unknown spread decides is counted as known."""
    mean, spread, _ = balls.most_likely(TRUTH)
    p, more = balls.products(TRUTH, mean, spread)
    found = marginal.evidence(p, TRUTH, one_gaussian(mean, spread[:3]), spread[3:], more)
    error, expected = (np.sqrt(np.diagonal(np.linalg.inv(m))) for m in (found.gram.sum(axis=0), information))
    np.testing.assert_allclose(error, expected, rtol=0.2)


def test_spins_and_kicks_are_told_apart(balls):
    """Their distributions, from one far off, as the whole likelihood has them."""
    mean, spread, _ = balls.most_likely(TRUTH)
    prior, scatter = one_gaussian(np.zeros(3), np.full(3, 5.0)), np.full(3, 2.0)
    for _ in range(6):
        p, _ = balls.products(TRUTH, prior.mean, np.r_[prior.std, scatter])
        prior, scatter = marginal.distributions(p, TRUTH, prior, scatter)
    np.testing.assert_allclose(scatter, spread[3:], rtol=0.1)
    np.testing.assert_allclose(prior.std, spread[:3], rtol=0.1)
    np.testing.assert_allclose(prior.mean, mean, atol=0.15)


def test_growth_is_the_derivative_of_what_flights_say_about_spins():
    """By differences of the information itself, starts projected out at each place, on flights of other code."""
    rng = np.random.default_rng(5)
    position = rng.uniform([[-0.4], [1.0], [0.2]], [[0.4], [1.6], [0.4]], (3, 24))
    velocity = rng.uniform([[-0.6], [-5.0], [0.5]], [[0.6], [-4.0], [1.5]], (3, 24))
    spins = rng.normal(0.0, 20.0, (3, 24))
    time = np.arange(60) / 125.0
    path = fly(World(magnus_coefficient=0.6), np.concatenate([position, velocity, spins]), time[-1] + 0.01)
    seen = path.at(np.repeat(time[:, None], 24, axis=1))
    effects = tuple(e for e in EFFECTS if e.name in ("magnus_coefficient", "drag_coefficient"))
    g = grid([Trajectory("day", str(i), time, seen[:, :, i]) for i in range(24)])
    problem = BallProblem(g, with_values(SimModel(), {MAGNUS: 0.6}), effects, heading(g))
    start = np.concatenate([position, velocity, spins, np.zeros((3, 24))])
    weight = np.ones((24, len(time)))

    def flights(theta: np.ndarray):
        at = Situation(theta, start)
        linear = problem.linearise(at)
        return at, linear, marginal.starts_out(linear, at, nominal_noise(g), weight, problem)

    at, linear, out = flights(np.zeros(2))
    more = marginal.growth(problem, out, linear, at, [0, 1])
    precision = np.eye(3) / 20.0**2
    known = np.linalg.inv(marginal.products(linear, out).own[:, :3, :3] + precision)
    for k, effect in enumerate(effects):
        step = 0.05 * effect.scale * np.eye(2)[k]
        up, down = (marginal.products(*flights(s)[1:]).own[:, :3, :3] for s in (step, -step))
        size = [np.linalg.slogdet(m + precision)[1] for m in (up, down)]
        expected = (size[0] - size[1]) / (2.0 * step[k])
        found = 2.0 * np.einsum("nab,nba->n", known, more[:, :3, :, k])
        assert np.median(np.abs(found - expected)) < 0.03 * np.median(np.abs(expected))
