"""Evidence of flights with spin and kick of each ball integrated out, about its own best fit: gradient and information.

An effect that makes spins show more (the coefficient k, a friction by which more balls slide) fits the same flights by
spins nearer to their middle. That is no evidence for it: it spreads the flights that it calls likely. The determinant
of the evidence says so; without its derivative k comes out too high, by 0.3 where lobs hardly spin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from mjx_tt.diagnosis.ball.flights.linearization import KICK, BallProblem, Linear, Situation, StartsOut
from mjx_tt.diagnosis.ball.flights.noise import ALIKE, LEAST_SCATTER, Noise
from mjx_tt.diagnosis.ball.flights.spin_prior import TINY, SpinPrior, learned

ALTERNATIONS = 3
LEAST_LEFT = 0.03  # of the information, when the distributions' unknowns are projected out
FARTHEST_SPREAD = 0.5  # of a spread's logarithm in one step: flights show the product of k and spin, a curved valley
FARTHEST = 4.0  # deviations at which a kick counts that lies farther off
LEAST_KICK, MOST_KICK = 1e-3, 1.0  # [m/s] deviations of kicks: a flight shows its own within some 10 mm/s
WIDE_MEAN = 100.0  # [rad/s] within which the mean of all spins lies anyway
WIDE_LOG = 1.0  # of the logarithm of a spread, about the one that was found last


@dataclass(frozen=True)
class Products:
    """Whitened products of each of n balls, its start projected out: K effects, and six unknowns, spin and kick."""

    gram: Float[np.ndarray, "n K K"]
    right: Float[np.ndarray, "n K"]
    own: Float[np.ndarray, "n 6 6"]
    own_effect: Float[np.ndarray, "n 6 K"]
    own_right: Float[np.ndarray, "n 6"]


@dataclass(frozen=True)
class Evidence:
    """Information and gradient of each ball about K effects: of all of them gram @ theta = right at the maximum."""

    gram: Float[np.ndarray, "n K K"]
    right: Float[np.ndarray, "n K"]
    follow: Float[np.ndarray, "D K"]  # by how much the distributions' unknowns go along with the effects
    spreads: int  # of these unknowns, the last: logarithms of spreads
    alone: Float[np.ndarray, "K K"]  # information of all balls about the effects' columns under given distributions
    ball_alone: Float[np.ndarray, "n K K"]  # the same of each ball: never negative

    def information(self, chosen: list[int], before: Float[np.ndarray, " c"]) -> Float[np.ndarray, "c c"]:
        """Of all balls about some effects, with the precision of what is known before.

        At least LEAST_LEFT of that under given distributions is left in every direction: it is a difference of
        expectations and of sums over balls, which need not cancel as they should.
        """
        alone = self.alone[np.ix_(chosen, chosen)] + np.diag(before)
        if not self.spreads:
            return alone
        size = np.sqrt(np.diagonal(alone))
        lower = np.linalg.cholesky(alone / size[:, None] / size + 1e-12 * np.eye(len(chosen))) * size[:, None]
        rest = self.gram.sum(axis=0)[np.ix_(chosen, chosen)] + np.diag(before)
        share, ways = np.linalg.eigh(np.linalg.solve(lower, np.linalg.solve(lower, (rest + rest.T) / 2.0).T))
        ways = lower @ ways
        return (ways * np.maximum(share, LEAST_LEFT)) @ ways.T

    def reach(self, change: Float[np.ndarray, " K"]) -> float:
        """Share of a change of the effects, 1 at most, over which no spread is changed by more than FARTHEST_SPREAD."""
        moves = np.abs(self.follow[-self.spreads :] @ change) if self.spreads else np.zeros(1)
        return float(min(1.0, FARTHEST_SPREAD / max(moves.max(), 1e-12)))

    def followed(
        self, change: Float[np.ndarray, " K"], prior: SpinPrior | None, scatter: Float[np.ndarray, 3]
    ) -> tuple[SpinPrior | None, Float[np.ndarray, 3]]:
        """Both distributions after a change of the effects."""
        if not self.spreads:
            return prior, scatter
        moves = self.follow @ change
        if prior is not None:
            mean, spread, moves = moves[:3], moves[3:6], moves[6:]
            prior = prior.moved(mean).stretched(np.exp(spread))
        if scatter.any():
            scatter = np.clip(scatter * np.exp(moves), LEAST_KICK, MOST_KICK)
        return prior, scatter


def starts_out(linear: Linear, at: Situation, noise: Noise, weight: np.ndarray, problem: BallProblem) -> StartsOut:
    """The flights with their starts alone projected out: kicks are unknowns like spins."""
    target = linear.residual + np.tensordot(at.theta, linear.effects, 1)
    return StartsOut(linear, target, at.start, replace(noise, scatter=ALIKE), weight, problem.grid)


def products(linear: Linear, flights: StartsOut) -> Products:
    """Products of the effects' columns with those of spins and kicks."""
    p, k = flights.project(np.concatenate([linear.effects, linear.starts[KICK]])), len(linear.effects)
    across = p.spin_effect[:, :, k:]
    top = np.concatenate([p.spin_gram, across], axis=2)
    low = np.concatenate([across.swapaxes(1, 2), p.gram[:, k:, k:]], axis=2)
    return Products(
        p.gram[:, :k, :k],
        p.right[:, :k],
        np.concatenate([top, low], axis=1),
        np.concatenate([p.spin_effect[:, :, :k], p.gram[:, k:, :k]], axis=1),
        np.concatenate([p.spin_right, p.right[:, k:]], axis=1),
    )


def own_unknowns_out(
    p: Products, prior: SpinPrior | None, scatter: Float[np.ndarray, 3]
) -> tuple[Float[np.ndarray, "n K"], Float[np.ndarray, "n K"]]:
    """Each ball's score about each effect and its information, spin and kick integrated out as they are distributed."""
    n, precision, middle = len(p.gram), np.zeros((len(p.gram), 6, 6)), np.zeros((len(p.gram), 6))
    precision[:, 3:, 3:] = _of_kicks(scatter)
    used = slice(3, 6)
    if prior is not None:
        mean, precision[:, :3, :3] = prior.of_balls(n, TINY)
        middle[:, :3], used = mean.T, slice(0, 6)
    own = np.linalg.inv((p.own + precision)[:, used, used])
    pulled = (p.own_right + np.einsum("nab,nb->na", precision, middle))[:, used]
    mix = p.own_effect[:, used].swapaxes(1, 2) @ own
    score = p.right - np.einsum("nka,na->nk", mix, pulled)
    information = np.einsum("nkk->nk", p.gram) - np.einsum("nka,nak->nk", mix, p.own_effect[:, used])
    return score, information


def distributions(
    p: Products, theta: Float[np.ndarray, " K"], prior: SpinPrior | None, scatter: Float[np.ndarray, 3]
) -> tuple[SpinPrior | None, Float[np.ndarray, 3]]:
    """Distribution of the spins and deviation [m/s] of the kicks under which the flights are the most likely.

    prior, scatter: of before; without spins, or without kicks, there are none. In turns: what balls do differently at
    their bounces is spin's or the bounce's own, and expectation-maximisation of the kicks would take hundreds of steps
    to see that it is not theirs.
    """
    left = p.own_right - p.own_effect @ theta
    for _ in range(ALTERNATIONS if prior is not None and scatter.any() else 1):
        if prior is not None:
            prior = learned(*_alone(p.own, left, slice(3), slice(3, 6), _of_kicks(scatter)))
        if scatter.any():
            known = np.zeros((3, 3)) if prior is None else prior.of_balls(len(left), TINY)[1]
            pulled = left.copy()
            if prior is not None:
                pulled[:, :3] += np.einsum("nab,bn->na", known, prior.of_balls(len(left), TINY)[0])
            scatter = _most_likely(*_alone(p.own, pulled, slice(3, 6), slice(3), known), scatter)
        if prior is None:
            break
    return prior, scatter


def _of_kicks(scatter: Float[np.ndarray, 3]) -> Float[np.ndarray, "3 3"]:
    """Precision of the kicks."""
    return np.diag(np.maximum(scatter, LEAST_SCATTER) ** -2.0)


def _alone(
    own: np.ndarray, left: np.ndarray, kept: slice, other: slice, precision: np.ndarray
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Information and score about three of the unknowns, the other three integrated out."""
    if not precision.any():  # there are no others
        return own[:, kept, kept], left[:, kept]
    mix = own[:, kept, other] @ np.linalg.inv(own[:, other, other] + precision)
    information = own[:, kept, kept] - mix @ own[:, other, kept]
    return information, left[:, kept] - np.einsum("nab,nb->na", mix, left[:, other])


def _most_likely(
    information: Float[np.ndarray, "n 3 3"], score: Float[np.ndarray, "n 3"], before: Float[np.ndarray, 3]
) -> Float[np.ndarray, 3]:
    """Deviation [m/s] along each axis of kicks whose mean is none."""
    total = information + _of_kicks(before)
    kick = np.linalg.solve(total, score[..., None])[..., 0]
    score = np.einsum("nab,nb->na", total, np.clip(kick, -FARTHEST * before, FARTHEST * before))

    def cost(logarithm: np.ndarray) -> float:
        spread = np.exp(logarithm)
        inner, right = np.eye(3) + spread[:, None] * information * spread, score * spread
        explained = np.linalg.solve(inner, right[..., None])[..., 0]
        return float(np.linalg.slogdet(inner)[1].sum() - (right * explained).sum())

    low, high = np.log(LEAST_KICK), np.log(MOST_KICK)
    first = np.clip(np.log(before), low, high)
    return np.exp(minimize(cost, first, method="L-BFGS-B", bounds=[(low, high)] * 3).x)


def growth(
    problem: BallProblem, flights: StartsOut, linear: Linear, at: Situation, which: list[int]
) -> Float[np.ndarray, "n 6 3 K"]:
    """Products of the columns of spins and kicks with the derivatives of the spins' by the effects; of some effects.

    The spins' columns are those beside which the starts are fitted, whose own derivatives take part.
    """
    more = problem.spins_by_effects(at, which, flights.starts_beside_spins(linear))
    out = np.zeros((problem.grid.n, 6, 3, len(problem.effects)))
    columns = flights.beside_spins_and_kicks(more.reshape(-1, *more.shape[2:]))
    out[..., which] = np.moveaxis(columns.reshape(len(columns), 6, len(which), 3), 2, 3)
    return out


def evidence(
    p: Products,
    theta: Float[np.ndarray, " K"],
    prior: SpinPrior | None,
    scatter: Float[np.ndarray, 3],
    more: Float[np.ndarray, "n 6 3 M"] | None,
) -> Evidence:
    """Evidence about changes theta. more: ``growth`` of the first M of them, where balls spin.

    The distributions were found from the same flights: the mean of the spins, and the spread of spins and kicks along
    each axis, follow theta and are projected out, so that what only their spread decides is not counted as known.
    Information is Fisher's, of a Gaussian whose mean and covariance both depend on the parameters (Kay, Fundamentals of
    Statistical Signal Processing: Estimation Theory, 1993, eq. 3.31).
    """
    used = [*([] if prior is None else range(3)), *(range(3, 6) if scatter.any() else [])]
    if not used:
        return Evidence(p.gram, p.right, np.zeros((0, p.gram.shape[1])), 0, p.gram.sum(axis=0), p.gram)
    n, k, size, spins = len(p.gram), p.gram.shape[1], len(used), 0 if prior is None else 3
    precision, middle = np.zeros((n, 6, 6)), np.zeros((n, 6))
    precision[:, 3:, 3:] = _of_kicks(scatter)
    if prior is not None:
        mean, precision[:, :3, :3] = prior.of_balls(n, TINY)
        middle[:, :3] = mean.T
    precision, middle = precision[:, used][:, :, used], middle[:, used]
    own, own_effect, own_right = p.own[:, used][:, :, used], p.own_effect[:, used], p.own_right[:, used]
    m = 0 if more is None else more.shape[-1]  # effects of which it is known, the first ones
    wide = np.zeros((n, size, size, m))
    if more is not None:
        wide[:, :, :3] = more[:, used]
    spread = np.linalg.inv(precision)
    known = np.linalg.inv(own + precision)  # covariance of each ball's own unknowns, when it has flown
    shrunk = precision @ known  # (1 + L P)^-1
    # With M the columns of the own unknowns, E those of the effects, S the covariance of a flight: M' S^-1 M and so on.
    shown, turned = shrunk @ own, np.einsum("nab,nbck,ncd->nkad", shrunk, wide, spread)
    effects = shrunk @ own_effect
    left = np.einsum("nab,nb->na", shrunk, own_right - np.einsum("nab,nb->na", own, middle))
    gram = p.gram - own_effect.swapaxes(1, 2) @ known @ own_effect
    right = p.right - np.einsum("nak,na->nk", own_effect, middle + np.einsum("nab,nb->na", spread, left))
    right[:, :m] -= np.trace(turned, axis1=2, axis2=3)
    second = np.einsum("nkab,nlba->nkl", turned, turned)  # by the covariance; the rest of that is in the gram already
    # Unknowns of the distributions: the spins' mean, and the logarithm of the spread along each axis.
    score = left - effects @ theta
    wider = np.zeros((n, size, size, size))
    for axis in range(size):
        wider[:, axis, axis] += spread[:, axis]
        wider[:, axis, :, axis] += spread[:, axis]
    weighted = shown[:, None] @ wider
    of_spread = 0.5 * (np.einsum("na,njab,nb->nj", score, wider, score) - np.trace(weighted, axis1=2, axis2=3))
    of_spreads = np.zeros((n, size, k))
    of_spreads[..., :m] = np.einsum("nkab,njba->njk", turned, weighted)
    cross = np.concatenate([effects[:, :spins], of_spreads], axis=1)
    inner = np.zeros((spins + size, spins + size))
    inner[:spins, :spins] = shown[:, :spins, :spins].sum(axis=0)
    inner[spins:, spins:] = 0.5 * np.einsum("njab,nlba->jl", weighted, weighted)
    inner += np.diag([WIDE_MEAN**-2.0] * spins + [WIDE_LOG**-2.0] * size)
    mix = np.linalg.solve(inner, cross.sum(axis=0)).T
    of_distributions = np.concatenate([score[:, :spins], of_spread], axis=1)
    right = right - (of_distributions + cross @ theta) @ mix.T
    right[:, :m] += second @ theta[:m]
    whole = gram - mix @ cross
    whole[:, :m, :m] += second
    return Evidence(whole, right, -mix.T, size, gram.sum(axis=0), gram)
