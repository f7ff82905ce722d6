"""Averages over sets of causes: how much an estimate owes to what else is taken to be wrong.

The chosen set is the smallest that explains the data. An effect too small to be chosen, or one that does nearly what a
chosen one does, still pulls at the others' sizes, and an interval that takes the set for the truth does not know it. So
sets are drawn by their posterior probability (Gibbs steps and exchanges over the linearised model, with conjugate
priors: George and McCulloch, Statistica Sinica 7, 1997) and a cause's interval is that of its size over all drawn sets
that hold it (Hoeting et al., Statistical Science 14, 1999).

An effect's size is Gaussian with the catalogue's ``scale``; how many effects there are is as likely to be any number,
which is what keeps many candidates from being found by chance (Scott and Berger, Annals of Statistics 38, 2010). The
likelihood's curvature is that of the sandwich over balls, not of the noise's model (Ribatet, Cooley and Davison,
Statistica Sinica 22, 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.special import betaln

from mjx_tt.diagnosis.ball.scores import Scores, Subset

SWEEPS = 250  # over all candidates
SETTLING = 50  # of them, before a set counts
RANK = 1e-9  # of the largest eigenvalue, below which a direction shows nothing


def adjusted(rated: Scores, columns: Sequence[int]) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, " c"]]:
    """Gram matrix and right side of the columns, as if the estimates' covariance were that from ball to ball."""
    columns = list(columns)
    gram, right = rated.gram[np.ix_(columns, columns)], rated.right[columns]
    if not columns:
        return gram, right
    size = 1.0 / np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram * size[:, None] * size)
    shown = values > RANK * values.max()
    white = size[:, None] * vectors[:, shown] / np.sqrt(values[shown])  # W with W' gram W = 1
    estimate = white.T @ right
    left = (rated.ball_right[:, columns] - rated.ball_gram[:, columns][:, :, columns] @ (white @ estimate)) @ white
    n, c = left.shape
    spread = left.T @ left * (n / max(n - c, n / 4))
    share = c / (c + n)  # by which few balls' covariance of many columns is drawn to that of columns all alike
    spread = (1.0 - share) * spread + share * np.trace(spread) / c * np.eye(c)
    back = gram @ white
    precise = back @ np.linalg.inv(spread)
    return precise @ back.T, precise @ estimate


@dataclass
class Sets:
    """Evidence of sets of columns under Gaussian priors of their sizes.

    scale: of each column's prior, infinite for those that every set holds; candidates: those that a set may hold.
    """

    gram: Float[np.ndarray, "c c"]
    right: Float[np.ndarray, " c"]
    scale: Float[np.ndarray, " c"]
    candidates: Subset
    _known: dict[Subset, float] = field(default_factory=dict)

    def evidence(self, subset: Subset) -> float:
        """Twice the log posterior probability of a set, up to a constant."""
        if subset not in self._known:
            count, of = len(subset), len(self.candidates)
            prior = 2.0 * float(betaln(count + 1, of - count + 1))
            chosen, size, root = self._factor(subset)
            z = np.linalg.solve(root, self.right[chosen] * size)
            determinant = 2.0 * float(np.log(np.diagonal(root) / size).sum())
            width = 2.0 * float(np.log(self.scale[list(subset)]).sum())
            self._known[subset] = prior + float(z @ z) - determinant - width
        return self._known[subset]

    def drawn(
        self, subset: Subset, count: int, rng: np.random.Generator, freedom: float = np.inf
    ) -> Float[np.ndarray, "count c"]:
        """Sizes drawn from the posterior of a set, of Student's type; zero for columns outside of it."""
        chosen, size, root = self._factor(subset)
        mean = np.linalg.solve(root.T, np.linalg.solve(root, self.right[chosen] * size))
        noise = np.linalg.solve(root.T, rng.standard_normal((len(chosen), count)))
        if np.isfinite(freedom):
            noise = noise * np.sqrt(freedom / rng.chisquare(freedom, count))
        out = np.zeros((count, len(self.scale)))
        out[:, chosen] = ((mean[:, None] + noise) * size[:, None]).T
        return out

    def _factor(self, subset: Subset) -> tuple[list[int], np.ndarray, np.ndarray]:
        """A set's columns, and the Cholesky factor of its precision between unit columns of these sizes."""
        chosen = [*subset, *np.flatnonzero(np.isinf(self.scale)).tolist()]
        precision = self.gram[np.ix_(chosen, chosen)] + np.diag(self.scale[chosen] ** -2.0)
        size = 1.0 / np.sqrt(np.maximum(np.diagonal(precision), 1e-300))
        return chosen, size, np.linalg.cholesky(precision * size[:, None] * size + 1e-12 * np.eye(len(chosen)))


def visited(
    sets: Sets, start: Subset, rng: np.random.Generator, held: Subset = (), sweeps: int = SWEEPS
) -> dict[Subset, int]:
    """Sets drawn by their posterior probability, each with the number of times. held: members of every set."""
    current, counts = frozenset((*start, *held)), dict[Subset, int]()
    free = [c for c in sets.candidates if c not in held]

    def accepted(proposal: frozenset[int]) -> bool:
        gained = sets.evidence(tuple(sorted(proposal))) - sets.evidence(tuple(sorted(current)))
        return bool(2.0 * np.log(rng.random()) < gained)

    for sweep in range(sweeps):
        for candidate in rng.permutation(free).tolist():
            if accepted(proposal := current ^ {candidate}):
                current = proposal
        for _ in free:  # one in another's place: through either alone the way is barred
            inside, outside = [c for c in free if c in current], [c for c in free if c not in current]
            if not inside or not outside:
                break
            one, other = inside[rng.integers(len(inside))], outside[rng.integers(len(outside))]
            if accepted(proposal := (current - {one}) | {other}):
                current = proposal
        if sweep >= SETTLING:
            key = tuple(sorted(current))
            counts[key] = counts.get(key, 0) + 1
    return counts


@dataclass(frozen=True)
class Averaged:
    """Sets of effects with the number of times that each was drawn, and the sizes within them."""

    columns: tuple[int, ...]  # of the scores, that the sets' columns stand for
    effects: int  # how many there are: changes of those that no set holds are zero
    sets: Sets
    counts: dict[Subset, int]
    freedom: float  # of Student's distribution, by the number of balls

    def intervals(
        self, chosen: Subset, level: float, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
        """Lower and upper ends of the interval of each chosen effect over all sets that hold it."""
        at = tuple(self.columns.index(j) for j in chosen)
        ends = []
        for i in at:
            holding = {s: n for s, n in self.counts.items() if i in s}
            if sum(holding.values()) < (SWEEPS - SETTLING) // 4:
                holding = visited(self.sets, at, rng, (i,))
            sizes = [self.sets.drawn(s, 20 * n, rng, self.freedom)[:, i] for s, n in holding.items()]
            ends.append(np.quantile(np.concatenate(sizes), [0.5 - level / 2, 0.5 + level / 2]))
        low, high = np.array(ends).reshape(-1, 2).T
        return low, high

    def draws(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count K"]:
        """Changes of all effects together, each row from a set drawn by its probability."""
        every = list(self.counts)
        share = np.array([self.counts[s] for s in every]) / sum(self.counts.values())
        drawn = np.zeros((count, max(self.effects, max(self.columns, default=-1) + 1)))
        row = 0
        for subset, number in zip(every, rng.multinomial(count, share), strict=True):
            drawn[row : row + number, self.columns] = self.sets.drawn(subset, number, rng, self.freedom)
            row += number
        return drawn[:, : self.effects]


def averaged(
    rated: Scores,
    candidates: Sequence[int],
    chosen: Subset,
    scale: Float[np.ndarray, " K"],
    freedom: float,
    rng: np.random.Generator,
) -> Averaged:
    """Sets drawn by their probability, from the chosen one on.

    candidates: effects that a set may hold, the chosen ones among them. scale: of every effect. freedom: of Student's
    distribution, by the number of balls.
    """
    columns = (*candidates, *rated.always)
    width = np.concatenate([scale[list(candidates)], np.full(len(rated.always), np.inf)])
    sets = Sets(*adjusted(rated, columns), width, tuple(range(len(candidates))))
    counts = visited(sets, tuple(columns.index(j) for j in chosen), rng)
    return Averaged(columns, len(scale), sets, counts, freedom)
