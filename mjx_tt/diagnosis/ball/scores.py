"""Scores of sets of causes: every subset of effects is scored from one Gram matrix.

Gains are reductions of the whitened squared error (about twice the log likelihood ratio) of the linearised model.
Per-ball spin is a random effect: it is judged by its marginal likelihood, spins integrated out, never by fitting each
ball as it likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.ball.linearization import Projected

LARGEST_SUBSET = 3
SPIN_ROUNDS = 25
Subset = tuple[int, ...]  # columns of a Gram matrix, of effects or of all


@dataclass(frozen=True)
class SpinPrior:
    """Gaussian distribution of the balls' spins [rad/s]."""

    mean: Float[np.ndarray, 3]
    std: Float[np.ndarray, 3]


@dataclass(frozen=True)
class Scores:
    """Sums over the balls for one treatment of spin; with spin the last three columns are its mean."""

    gram: Float[np.ndarray, "K K"]
    right: Float[np.ndarray, " K"]
    ball_gram: Float[np.ndarray, "n K K"]
    ball_right: Float[np.ndarray, "n K"]
    base: float  # gain of the random spread alone
    always: Subset  # columns that every subset holds: the mean spin, and the Magnus coefficient


def without_spin(p: Projected) -> Scores:
    """Balls that do not spin."""
    return Scores(p.gram.sum(axis=0), p.right.sum(axis=0), p.gram, p.right, 0.0, ())


def with_spin(p: Projected, std: np.ndarray) -> Scores:
    """Balls whose spin is Gaussian with standard deviation (3,) about a mean that is fitted.

    Where the nominal model has no Magnus force its coefficient comes along: the bounce spins every ball.
    """
    full = np.concatenate([p.spin_effect, p.spin_gram], axis=2)  # (n, 3, K + 3) spins against effects and mean spin
    top = np.concatenate([p.gram, p.spin_effect.swapaxes(1, 2)], axis=2)
    gram = np.concatenate([top, full], axis=1)
    right = np.concatenate([p.right, p.spin_right], axis=1)
    inner = p.spin_gram + np.diag(1.0 / np.maximum(std, 1e-6) ** 2)
    gram = gram - full.swapaxes(1, 2) @ np.linalg.solve(inner, full)
    solved = np.linalg.solve(inner, p.spin_right[..., None])
    right = right - (full.swapaxes(1, 2) @ solved)[..., 0]
    explained = float((p.spin_right[..., None] * solved).sum())
    _, spread = np.linalg.slogdet(np.eye(3) + p.spin_gram * (np.maximum(std, 1e-6) ** 2)[None, None, :])
    k = p.gram.shape[1]
    return Scores(
        gram.sum(axis=0),
        right.sum(axis=0),
        gram,
        right,
        explained - float(spread.sum()),
        (k, k + 1, k + 2) + (() if p.coefficient is None else (p.coefficient,)),
    )


def under(p: Projected, prior: SpinPrior | None) -> Scores:
    """Scores of balls with spins of this distribution; of balls that do not spin where there is none."""
    return without_spin(p) if prior is None else with_spin(p, prior.std)


def fit_spin(p: Projected, effects: Subset, std: np.ndarray | None = None) -> SpinPrior:
    """Maximum likelihood mean and spread of the spins beside the given effects, by expectation-maximisation."""
    effects = tuple(e for e in effects if e != p.coefficient)
    std = np.full(3, 30.0) if std is None else np.maximum(std, 1.0)
    for _ in range(SPIN_ROUNDS):
        scores = with_spin(p, std)
        chosen = (*effects, *scores.always)
        theta = solve(scores, chosen)
        mean, others = theta[len(effects) : len(effects) + 3], [*effects, *scores.always[3:]]
        left = p.spin_right - p.spin_effect[:, :, others] @ np.delete(theta, range(len(effects), len(effects) + 3))
        left = left - p.spin_gram @ mean
        inner = np.linalg.inv(p.spin_gram + np.diag(1.0 / np.maximum(std, 1e-6) ** 2))
        omega = (inner @ left[..., None])[..., 0]
        std = np.sqrt((omega**2 + np.diagonal(inner, axis1=1, axis2=2)).mean(axis=0))
    return SpinPrior(mean, std)


def _sub(scores: Scores, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    return scores.gram[np.ix_(chosen, chosen)], scores.right[list(chosen)]


def solve(scores: Scores, chosen: Sequence[int]) -> Float[np.ndarray, " c"]:
    """Estimates of the chosen columns."""
    gram, right = _sub(scores, chosen)
    scale = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    return np.linalg.lstsq(gram / scale[:, None] / scale, right / scale, rcond=1e-10)[0] / scale


def gain(scores: Scores, subset: Sequence[int]) -> float:
    """Reduction of the squared error by a subset of effects."""
    chosen = (*subset, *scores.always)
    return scores.base + (float(_sub(scores, chosen)[1] @ solve(scores, chosen)) if chosen else 0.0)


def all_gains(scores: Scores, candidates: Subset, largest: int = LARGEST_SUBSET) -> dict[Subset, float]:
    """Gains of all subsets of the candidates up to a size."""
    out: dict[Subset, float] = {(): gain(scores, ())}
    for size in range(1, min(largest, len(candidates)) + 1):
        subsets = list(combinations(candidates, size))
        index = np.array([(*s, *scores.always) for s in subsets])
        gram = scores.gram[index[:, :, None], index[:, None, :]]
        right = scores.right[index]
        scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-300))
        unit = gram / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(index.shape[1])
        x = np.linalg.solve(unit, (right / scale)[..., None])[..., 0]
        out.update(zip(subsets, (scores.base + (x * right / scale).sum(axis=1)).tolist(), strict=True))
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
    scores: Scores, chosen: Sequence[int], extra: Sequence[int]
) -> tuple[Float[np.ndarray, "n E"], Float[np.ndarray, "E E"]]:
    """Ball-by-ball scores (n, E) of extra columns beside the chosen ones, and their Gram matrix (E, E)."""
    chosen, extra = list(chosen), list(extra)
    if not chosen:
        return scores.ball_right[:, extra], scores.gram[np.ix_(extra, extra)]
    theta = solve(scores, chosen)
    mix = np.linalg.pinv(scores.gram[np.ix_(chosen, chosen)]) @ scores.gram[np.ix_(chosen, extra)]  # (C, E)
    left = scores.ball_right[:, chosen] - scores.ball_gram[:, chosen][:, :, chosen] @ theta
    own = scores.ball_right[:, extra] - scores.ball_gram[:, extra][:, :, chosen] @ theta
    gram = scores.gram[np.ix_(extra, extra)] - scores.gram[np.ix_(extra, chosen)] @ mix
    return own - left @ mix, gram


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
