"""Distribution of the balls' spins, learned from the flights themselves: a Gaussian, or a mixture of a few.

Each flight says about its spin omega, its start projected out, exp(-omega' L omega / 2 + b' omega). Given the
components of a mixture its posterior under each is Gaussian and so is its evidence: expectation-maximisation
(Dempster, Laird and Rubin 1977) over balls whose spins are never seen. The number of components is chosen by the
Bayesian information criterion.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

MAGNUS_PRIOR = (0.6, 0.4)  # mean and deviation of the coefficient k, where the nominal model has none
MAGNUS_RANGE = (0.1, 2.0)  # that any source reports, with a margin
ROUNDS = 120
TINY = 1e-3  # [rad/s] spread of balls that do not spin
LEAST_STD = 1.0  # [rad/s] of a component about each axis: below it no flight shows a spread
# Where the air hardly lifts, balls that slide through their bounce could have any spin: it shows no more than its sign.
# The fastest strokes of professionals lie at some 900 rad/s.
WIDEST_STD = 300.0  # [rad/s]
MOST_COMPONENTS = 3
FEWEST_BALLS = 40  # of a component
NUMBERS = 10  # of a component: its share, mean and covariance


@dataclass(frozen=True)
class SpinPrior:
    """Distribution of the spins [rad/s] of n balls: of all together, and of each where a mixture places it."""

    mean: Float[np.ndarray, 3]
    std: Float[np.ndarray, 3]
    own_mean: Float[np.ndarray, "3 n"] | None = field(default=None, repr=False)
    own_covariance: Float[np.ndarray, "n 3 3"] | None = field(default=None, repr=False)
    components: int = 1

    def of_balls(self, n: int, least: float = LEAST_STD) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, "n 3 3"]]:
        """Mean and precision of the spin of each of n balls. least: standard deviation that none falls below."""
        if self.own_mean is not None and self.own_covariance is not None and len(self.own_covariance) == n:
            return self.own_mean, np.linalg.inv(self.own_covariance + least**2 * np.eye(3))
        precision = np.diag(1.0 / np.maximum(self.std, least) ** 2)
        return np.repeat(self.mean[:, None], n, axis=1), np.broadcast_to(precision, (n, 3, 3))

    def moved(self, change: Float[np.ndarray, 3]) -> SpinPrior:
        """The same distribution about a mean that lies elsewhere by ``change``."""
        own = None if self.own_mean is None else self.own_mean + change[:, None]
        return replace(self, mean=self.mean + change, own_mean=own)

    def stretched(self, factor: Float[np.ndarray, 3]) -> SpinPrior:
        """The same distribution, wider by a factor about each axis."""
        own = None if self.own_covariance is None else self.own_covariance * np.multiply.outer(factor, factor)
        return replace(self, std=self.std * factor, own_covariance=own)

    def of_some(self, index: np.ndarray) -> SpinPrior:
        """The distribution of some of the balls."""
        if self.own_mean is None or self.own_covariance is None:
            return self
        return replace(self, own_mean=self.own_mean[:, index], own_covariance=self.own_covariance[index])


@dataclass(frozen=True)
class _Mixture:
    share: Float[np.ndarray, " c"]
    mean: Float[np.ndarray, "c 3"]
    covariance: Float[np.ndarray, "c 3 3"]


def learned(
    information: Float[np.ndarray, "n 3 3"], score: Float[np.ndarray, "n 3"], most: int = MOST_COMPONENTS
) -> SpinPrior:
    """Maximum likelihood distribution of the spins, from each flight's information L and score b about its own."""
    n = len(score)
    estimate = np.linalg.solve(information + np.eye(3) / 60.0**2, score[..., None])[..., 0]
    spread = np.cov(estimate.T) + 5.0**2 * np.eye(3)
    mixture = _Mixture(np.ones(1), estimate.mean(axis=0)[None], spread[None])
    best, best_cost = mixture, np.inf
    for count in range(1, most + 1):
        if count > 1:
            if n < FEWEST_BALLS * count:
                break
            mixture = _split(mixture)
        mixture, likelihood = _maximised(mixture, information, score)
        cost = -2.0 * likelihood + NUMBERS * count * np.log(n)
        if cost < best_cost:
            best, best_cost = mixture, cost
    return _placed(best, information, score)


def _split(mixture: _Mixture) -> _Mixture:
    """The mixture with its widest component cut in two along its longest axis."""
    widest = int(np.argmax(mixture.share * np.linalg.eigvalsh(mixture.covariance)[:, -1]))
    values, vectors = np.linalg.eigh(mixture.covariance[widest])
    step = 0.7 * np.sqrt(values[-1]) * vectors[:, -1]
    share, mean, covariance = mixture.share.copy(), mixture.mean.copy(), mixture.covariance
    share[widest] *= 0.5
    mean[widest] -= step
    return _Mixture(
        np.append(share, share[widest]),
        np.concatenate([mean, (mean[widest] + 2.0 * step)[None]]),
        np.concatenate([covariance, covariance[widest][None]]),
    )


def _posteriors(
    mixture: _Mixture, information: np.ndarray, score: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log evidence (n, c) of balls under components, and mean (n, c, 3), covariance (n, c, 3, 3) of their spins."""
    precision, size = _inverse(mixture.covariance)
    pull = np.einsum("cab,cb->ca", precision, mixture.mean)
    right = score[:, None] + pull
    covariance, inner_size = _inverse(information[:, None] + precision)
    mean = (covariance @ right[..., None])[..., 0]
    spread = np.log(inner_size * size)  # of 1 + C L, which is C (C^-1 + L)
    evidence = 0.5 * ((right * mean).sum(axis=-1) - (pull * mixture.mean).sum(axis=-1) - spread)
    return np.log(mixture.share) + evidence, mean, covariance


def _inverse(m: Float[np.ndarray, "*batch 3 3"]) -> tuple[Float[np.ndarray, "*batch 3 3"], Float[np.ndarray, "*batch"]]:
    """Inverses of small matrices by their cofactors, many times as fast as LAPACK one by one; and determinants."""
    rows = np.cross(np.roll(m, -1, axis=-2), np.roll(m, -2, axis=-2))  # cofactors, row by row
    determinant = (m[..., 0, :] * rows[..., 0, :]).sum(axis=-1)
    return rows.swapaxes(-1, -2) / determinant[..., None, None], determinant


def _maximised(mixture: _Mixture, information: np.ndarray, score: np.ndarray) -> tuple[_Mixture, float]:
    """The mixture after expectation-maximisation, and its log likelihood."""
    before = -np.inf
    for _ in range(ROUNDS):
        evidence, mean, covariance = _posteriors(mixture, information, score)
        top = evidence.max(axis=1, keepdims=True)
        weight = np.exp(evidence - top)
        total = weight.sum(axis=1, keepdims=True)
        likelihood = float((top + np.log(total)).sum())
        weight = weight / total
        count = np.maximum(weight.sum(axis=0), 1e-9)
        middle = np.einsum("nc,nca->ca", weight, mean) / count[:, None]
        away = mean - middle
        spread = np.einsum("nc,nca,ncb->cab", weight, away, away) + np.einsum("nc,ncab->cab", weight, covariance)
        # As if one more ball of the least spread stood with each component: none closes in on a single ball.
        spread = _at_most((spread + LEAST_STD**2 * np.eye(3)) / (count + 1.0)[:, None, None])
        mixture = _Mixture(count / len(score), middle, spread)
        if likelihood - before < 1e-5 * len(score):
            break
        before = likelihood
    return mixture, likelihood


def _at_most(covariance: Float[np.ndarray, "c 3 3"]) -> Float[np.ndarray, "c 3 3"]:
    """The same, no deviation above WIDEST_STD."""
    values, vectors = np.linalg.eigh(covariance)
    if values.max() <= WIDEST_STD**2:
        return covariance
    return (vectors * np.minimum(values, WIDEST_STD**2)[:, None]) @ vectors.swapaxes(-1, -2)


def _placed(mixture: _Mixture, information: np.ndarray, score: np.ndarray) -> SpinPrior:
    """Moments of all balls, and of each ball's own share of the components."""

    def moments(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean = weight @ mixture.mean
        away = mixture.mean - mean[..., None, :]
        spread = np.einsum("...c,...ca,...cb->...ab", weight, away, away)
        return mean, spread + np.tensordot(weight, mixture.covariance, 1)

    mean, covariance = moments(mixture.share)
    evidence = _posteriors(mixture, information, score)[0]
    weight = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    own_mean, own = moments(weight / weight.sum(axis=1, keepdims=True))
    std = np.sqrt(np.diagonal(covariance))
    return SpinPrior(mean, std, own_mean.T, own, len(mixture.share))
