"""Scores of sets of causes: every subset of effects is scored from one Gram matrix.

Gains are reductions of the whitened squared error (about twice the log likelihood ratio) of the linearised model.
Per-ball spin is a random effect: it is judged by its marginal likelihood, spins integrated out, never by fitting each
ball as it likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.ball.effects import Effect
from mjx_tt.diagnosis.ball.flights.linearization import Projected
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR, TINY, SpinPrior, learned

LARGEST_SUBSET = 3  # of which every set is tried
MOST_CAUSES = 8
SPIN_ROUNDS = 8
FREEDOM = 4.0  # degrees of Student's distribution of an effect's size
Subset = tuple[int, ...]  # columns of a Gram matrix, of effects or of all


@dataclass(frozen=True)
class Scores:
    """Sums over the balls for one treatment of spin; with spin the last three columns are its mean."""

    gram: Float[np.ndarray, "K K"]
    right: Float[np.ndarray, " K"]
    ball_gram: Float[np.ndarray, "n K K"]
    ball_right: Float[np.ndarray, "n K"]
    base: float  # gain of the random spread alone
    always: Subset  # columns that every subset holds: the mean spin, and the Magnus coefficient
    scale: Float[np.ndarray, " K"] | None = None  # ordinary sizes of the effects, infinite for what has none

    def weighted(self, weight: Float[np.ndarray, " n"]) -> Scores:
        """The same with each ball counted ``weight`` times; a prior, which no ball brings, stays as it is."""
        prior = self.gram - self.ball_gram.sum(axis=0), self.right - self.ball_right.sum(axis=0)
        gram = np.tensordot(weight, self.ball_gram, 1) + prior[0]
        return replace(self, gram=gram, right=weight @ self.ball_right + prior[1])


def without_spin(p: Projected) -> Scores:
    """Balls that do not spin."""
    return Scores(p.gram.sum(axis=0), p.right.sum(axis=0), p.gram, p.right, 0.0, ())


def with_spin(p: Projected, prior: SpinPrior) -> Scores:
    """Balls whose spin is Gaussian, each with its own spread, about a mean of all that is fitted.

    Where the nominal model has no Magnus force its coefficient comes along: the bounce spins every ball.
    """
    middle, precision = prior.of_balls(len(p.gram), TINY)
    offset = (middle - prior.mean[:, None]).T  # (n, 3) of each ball's own mean from that of all
    full = np.concatenate([p.spin_effect, p.spin_gram], axis=2)  # (n, 3, K + 3) spins against effects and mean spin
    top = np.concatenate([p.gram, p.spin_effect.swapaxes(1, 2)], axis=2)
    gram = np.concatenate([top, full], axis=1)
    spin_right = p.spin_right - (p.spin_gram @ offset[..., None])[..., 0]
    right = np.concatenate([p.right, p.spin_right], axis=1) - np.einsum("nak,na->nk", full, offset)
    inner = p.spin_gram + precision
    gram = gram - full.swapaxes(1, 2) @ np.linalg.solve(inner, full)
    solved = np.linalg.solve(inner, spin_right[..., None])
    right = right - (full.swapaxes(1, 2) @ solved)[..., 0]
    explained = float((spin_right[..., None] * solved).sum())
    explained += float((2.0 * p.spin_right * offset).sum() - np.einsum("na,nab,nb->", offset, p.spin_gram, offset))
    _, spread = np.linalg.slogdet(np.eye(3) + np.linalg.solve(precision, p.spin_gram))
    k = p.gram.shape[1]
    return Scores(
        gram.sum(axis=0),
        right.sum(axis=0),
        gram,
        right,
        explained - float(spread.sum()),
        (k, k + 1, k + 2) + (() if p.coefficient is None else (p.coefficient,)),
    )


def with_own_spins(p: Projected, prior: SpinPrior) -> Scores:
    """Balls whose derivatives were taken about spins of their own.

    There the column of an effect that grows with spin (the coefficient k, the spin's decay) is made of the very spins
    that the prior draws to its mean: to a random effect a larger k and smaller spins would look like a better fit, by
    as much as the spins spread (the regressor correlates with the random effect: Mundlak, Econometrica 46, 1978). So a
    spin that its flight shows well is an unknown of its own, without a prior, and the prior counts by how little the
    flight shows.
    """
    middle, precision = prior.of_balls(len(p.gram), TINY)
    inner = p.spin_gram + loosened(precision, p.spin_gram)
    left = p.spin_right - np.einsum("nab,bn->na", p.spin_gram, middle)
    gram = p.gram - p.spin_effect.swapaxes(1, 2) @ np.linalg.solve(inner, p.spin_effect)
    solved = np.linalg.solve(inner, left[..., None])
    right = p.right - np.einsum("nak,an->nk", p.spin_effect, middle)
    right = right - (p.spin_effect.swapaxes(1, 2) @ solved)[..., 0]
    total, sums = gram.sum(axis=0), right.sum(axis=0)
    if p.coefficient is not None:
        mean, std = MAGNUS_PRIOR
        total[p.coefficient, p.coefficient] += std**-2
        sums[p.coefficient] += mean * std**-2
    return Scores(total, sums, gram, right, 0.0, () if p.coefficient is None else (p.coefficient,))


def loosened(
    precision: Float[np.ndarray, "n 3 3"], information: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """P (P + L)^-1 P: a prior's precision P where the flight's information L is small, next to none where it is not."""
    return precision @ np.linalg.solve(precision + information, precision)


def under(p: Projected, prior: SpinPrior | None) -> Scores:
    """Scores of balls with spins of this distribution; of balls that do not spin where there is none."""
    if prior is None:
        return without_spin(p)
    return with_own_spins(p, prior) if prior.conditional else with_spin(p, prior)


def priced(rated: Scores, effects: Sequence[Effect]) -> Scores:
    """The same scores where the size of each effect has a price, but of those that every set holds."""
    scale = np.full(len(rated.gram), np.inf)
    scale[: len(effects)] = [e.scale for e in effects]
    scale[list(rated.always)] = np.inf
    return replace(rated, scale=scale)


def fit_spin(p: Projected, effects: Subset, prior: SpinPrior | None = None) -> SpinPrior:
    """Maximum likelihood distribution of the spins beside the given effects. prior: to start from."""
    effects = tuple(e for e in effects if e != p.coefficient)
    prior = SpinPrior(np.zeros(3), np.full(3, 30.0)) if prior is None else prior
    for _ in range(SPIN_ROUNDS):
        rated = with_spin(p, prior)
        chosen = (*effects, *rated.always)
        theta = solve(rated, chosen)
        others = [*effects, *rated.always[3:]]
        change = np.delete(theta, range(len(effects), len(effects) + 3))
        before, prior = prior, learned(p.spin_gram, p.spin_right - p.spin_effect[:, :, others] @ change)
        if np.all(np.abs(prior.mean - before.mean) + np.abs(prior.std - before.std) < 0.02 * before.std + 0.02):
            break
    return prior


def _sub(scores: Scores, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    return scores.gram[np.ix_(chosen, chosen)], scores.right[list(chosen)]


def solve(scores: Scores, chosen: Sequence[int]) -> Float[np.ndarray, " c"]:
    """Estimates of the chosen columns."""
    gram, right = _sub(scores, chosen)
    scale = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    return np.linalg.lstsq(gram / scale[:, None] / scale, right / scale, rcond=1e-10)[0] / scale


def price(theta: Float[np.ndarray, "*sets c"], scale: Float[np.ndarray, "*sets c"]) -> Float[np.ndarray, "*sets"]:
    """Evidence that sizes cost which would surprise: -2 times Student's log density of each.

    Two effects that undo each other fit as well at any size; without a price the largest would win by a digit.
    """
    return (FREEDOM + 1.0) * np.log1p((theta / scale) ** 2 / FREEDOM).sum(axis=-1)


def gain(scores: Scores, subset: Sequence[int]) -> float:
    """Reduction of the squared error by a subset of effects, less the price of their sizes where they have one."""
    chosen = [*subset, *scores.always]
    if not chosen:
        return scores.base
    theta = solve(scores, chosen)
    cost = 0.0 if scores.scale is None else float(price(theta, scores.scale[chosen]))
    return scores.base + float(_sub(scores, chosen)[1] @ theta) - cost


def all_gains(scores: Scores, candidates: Subset, largest: int = LARGEST_SUBSET) -> dict[Subset, float]:
    """Gains of all subsets of the candidates up to a size."""
    out: dict[Subset, float] = {(): gain(scores, ())}
    for size in range(1, min(largest, len(candidates)) + 1):
        out |= _gains(scores, list(combinations(candidates, size)))
    return out


def _gains(scores: Scores, subsets: Sequence[Subset]) -> dict[Subset, float]:
    """Gains of subsets of one size."""
    index = np.array([(*s, *scores.always) for s in subsets])
    gram = scores.gram[index[:, :, None], index[:, None, :]]
    right = scores.right[index]
    scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-300))
    unit = gram / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(index.shape[1])
    x = np.linalg.solve(unit, (right / scale)[..., None])[..., 0] / scale
    gains = scores.base + (x * right).sum(axis=1)
    if scores.scale is not None:
        gains = gains - price(x, scores.scale[index])
    return dict(zip(subsets, gains.tolist(), strict=True))


def neighbours(scores: Scores, subset: Subset, candidates: Subset) -> dict[Subset, float]:
    """Gains of a subset and of all that differ from it by one member: one more, one less, or another in its place."""
    others = [c for c in candidates if c not in subset]
    less = [subset[:i] + subset[i + 1 :] for i in range(len(subset))]
    out = {subset: gain(scores, subset)} | {rest: gain(scores, rest) for rest in less}
    for near in ([(*subset, c) for c in others], [(*rest, c) for rest in less for c in others]):
        if near:
            out |= _gains(scores, [tuple(sorted(s)) for s in near])
    return out


def widened(
    scores: Scores, gains: dict[Subset, float], candidates: Subset, threshold: float, most: int = MOST_CAUSES
) -> dict[Subset, float]:
    """Gains of larger sets as well, where the best of those at hand is as large as any: one member at a time.

    threshold: gain that one more member must bring.
    """

    def worth(subset: Subset) -> float:
        return out[subset] - threshold * len(subset)

    out = dict(gains)
    best = max(out, key=worth)
    while LARGEST_SUBSET <= len(best) < most:
        out |= neighbours(scores, best, candidates)
        better = max(out, key=worth)
        if better == best:
            break
        best = better
    return out


def sandwich(scores: Scores, chosen: Sequence[int]) -> Float[np.ndarray, "c c"]:
    """Covariance of the estimates of the chosen columns, from the spread between balls."""
    chosen = list(chosen)
    theta = solve(scores, chosen)
    inverse = np.linalg.pinv(scores.gram[np.ix_(chosen, chosen)])
    left = scores.ball_right[:, chosen] - scores.ball_gram[:, chosen][:, :, chosen] @ theta
    n = len(left)
    return inverse @ (left.T @ left) @ inverse * (n / max(n - len(chosen), 1))


def unexplained_scores(
    scores: Scores, chosen: Sequence[int], extra: Sequence[int], pull: Float[np.ndarray, " C"] | None = None
) -> tuple[Float[np.ndarray, "n E"], Float[np.ndarray, "E E"]]:
    """Ball-by-ball scores (n, E) of extra columns beside the chosen ones, and their Gram matrix (E, E).

    pull: precision of each chosen column's prior about zero; without, they are free.
    """
    chosen, extra = list(chosen), list(extra)
    if not chosen:
        return scores.ball_right[:, extra], scores.gram[np.ix_(extra, extra)]
    known = scores.gram[np.ix_(chosen, chosen)]
    if pull is None:
        theta = solve(scores, chosen)
    else:
        known = known + np.diag(pull)
        theta = np.linalg.lstsq(known, scores.right[chosen], rcond=1e-12)[0]
    mix = np.linalg.pinv(known) @ scores.gram[np.ix_(chosen, extra)]  # (C, E)
    left = scores.ball_right[:, chosen] - scores.ball_gram[:, chosen][:, :, chosen] @ theta
    own = scores.ball_right[:, extra] - scores.ball_gram[:, extra][:, :, chosen] @ theta
    gram = scores.gram[np.ix_(extra, extra)] - scores.gram[np.ix_(extra, chosen)] @ mix
    return own - left @ mix, gram


def undo(scores: Scores, subset: Subset, theta: Float[np.ndarray, " C"], alike: float) -> bool:
    """True if two members with one pattern, beyond a cosine of ``alike``, take away what the other adds.

    theta: sizes of the members and of what every set holds. Of such a pair flights show the small difference alone,
    which a law of either that is slightly wrong imitates: balls that all fly one way at one speed cannot tell more drag
    and a wind from behind from the drag of a spinning ball.
    """
    for i, j in combinations(range(len(subset)), 2):
        rest = [subset[k] for k in range(len(subset)) if k not in (i, j)]
        _, gram = unexplained_scores(scores, [*rest, *scores.always], [subset[i], subset[j]])
        together = np.sign(theta[i] * theta[j]) * gram[0, 1]
        if together < -alike * np.sqrt(gram[0, 0] * gram[1, 1]):
            return True
    return False


def flip_threshold(
    scores: Scores,
    chosen: Sequence[int],
    extra: Sequence[int],
    rng: np.random.Generator,
    draws: int = 400,
    level: float = 0.995,
) -> float:
    """Gain that the best single extra effect reaches by chance: scores of whole balls with random signs."""
    own, gram = unexplained_scores(scores, chosen, extra)
    own = own - own.mean(axis=0)
    signs = rng.choice([-1.0, 1.0], (draws, len(own)))
    gains = (signs @ own) ** 2 / np.maximum(np.diagonal(gram), 1e-12)
    return float(np.quantile(gains.max(axis=1), level))
