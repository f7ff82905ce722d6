"""Which causes are in the model: a linear Gaussian model of all logged pieces, and the evidence of every set of causes.

A piece is a ball's flight, a hit or a window of a joint's log. At the best fit so far pieces are linear in what is
unknown. Every effect of the catalogue is somewhat off: the chosen ones by ordinary amounts (the catalogue's ``scale``),
the others by as much as nobody would name (spike and slab: George and McCulloch, J. Am. Stat. Assoc. 88, 1993). Beside
them smooth functions stand for what no effect explains (the discrepancy: Kennedy and O'Hagan, J. R. Stat. Soc. B 63,
2001), orthogonal to the chosen effects, so that it takes nothing from their sizes (Plumlee, J. Am. Stat. Assoc. 112,
2017). Each family of functions has an amplitude, which the evidence decides (MacKay, Neural Computation 4, 1992): one
that is not needed goes to zero.

Real noise is not quite the model's: the evidence is divided by how much more the pieces' scores scatter than it says.
Evidence proposes causes; each is worth its name by the share of the error that it takes away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg.lapack import dpotrf, dpotri

Set = tuple[int, ...]  # effects, by their place in the catalogue of the problem
INFORMATION = 30.0  # of a discrepancy's usual coefficient, where its amplitude is begun
LEARNING = 30  # rounds, at most, for amplitudes
PRICE = 3.0  # of the logarithm of the evidence, that a cause must bring: one in twenty of those that could be is there
PRICE_OF_FAMILY = 6.0  # the same of a discrepancy
FARTHEST = 4.0  # ordinary sizes beyond which a cause is none
EXHAUSTIVE = 3  # causes up to which every set is tried
MOST_CAUSES = 5
LEAST_EVIDENCE = 2.0  # of the logarithm, that each cause must bring beside the best discrepancy
LEAST_SHARE = 0.01  # of the error, that a cause must take away
LEAST_LEFT_SHARE = 0.2  # of the error, from which on what no cause explains is "unexplained"
LEADING_SHARE = 0.9  # of the error, beyond which a cause is named though a smooth function could stand for it
HALF = 0.5  # of all that the evidence gains, by which a single cause is looked at
HALVES = 20  # of the pieces, by which a cause's confidence is told
WIDE = 10.0  # times ordinary sizes, where only the data are to speak
ALIKE = 0.97  # |cosine| of two effects' patterns beyond which they are one group
TIE = 5.0  # of the logarithm of the evidence by which a cause must beat another in its place


@dataclass(frozen=True)
class Family:
    """Columns of one smooth function."""

    name: str
    direction: str
    columns: Int[np.ndarray, " m"]
    labels: tuple[str, ...]
    usual: float  # deviation of the amplitude's prior, in the columns' unit


@dataclass(frozen=True)
class Left:
    """What a set of causes leaves to the discrepancy."""

    coefficients: Float[np.ndarray, " c"]  # of all columns, effects' sizes beside the discrepancy among them
    evidence: float  # logarithm, of set and discrepancy together
    explained: float  # squared whitened error that set and discrepancy explain together


@dataclass(frozen=True)
class LinearModel:
    """Pieces about a fit: information about columns, effects first, then the families' functions."""

    piece_gram: Float[np.ndarray, "n c c"]
    piece_right: Float[np.ndarray, "n c"]
    middle: Float[np.ndarray, " K"]  # of the effects' priors
    scale: Float[np.ndarray, " K"]  # of an effect in the set
    spike: Float[np.ndarray, " K"]  # of one that is not
    low: Float[np.ndarray, " K"]  # sizes below which an effect makes no sense
    families: tuple[Family, ...]
    candidates: Set
    always: Set = ()  # effects that every set holds
    temper: float = 1.0

    @property
    def effects(self) -> int:
        """Number of effects."""
        return len(self.scale)

    @cached_property
    def total(self) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, " c"]]:
        """Information of all pieces, and its right side about the priors' middles."""
        gram, right = self.piece_gram.sum(axis=0), self.piece_right.sum(axis=0)
        right = right - gram[:, : self.effects] @ self.middle
        return gram / self.temper, right / self.temper

    def of_pieces(self, which: Int[np.ndarray, " m"]) -> LinearModel:
        """The model of some of the pieces."""
        return replace(self, piece_gram=self.piece_gram[which], piece_right=self.piece_right[which])

    def hold(self, held: Set) -> LinearModel:
        """The model with causes that every set holds."""
        return replace(
            self,
            candidates=tuple(c for c in self.candidates if c not in held),
            always=(*self.always, *held),
        )

    def tempered(self) -> tuple[LinearModel, Left]:
        """The model, its evidence divided by how much more the scores scatter than it says; and all it explains."""
        k, everything = self.effects, self.beside(self.candidates)
        score = self.piece_right[:, :k] - np.einsum("nkl,l->nk", self.piece_gram[:, :k], everything.coefficients)
        ratio = (score**2).sum(axis=0) / np.maximum(np.diagonal(self.piece_gram.sum(axis=0))[:k], 1e-300)
        typical = float(np.median(ratio[list(self.candidates)])) if self.candidates else 1.0
        return replace(self, temper=max(typical, 1.0)), everything

    def precision(self, chosen: Sequence[int]) -> Float[np.ndarray, " K"]:
        """Of the effects' priors."""
        inside = [*chosen, *self.always]
        width = self.spike.copy()
        width[inside] = self.scale[inside]
        return width**-2.0

    def evidence(self, sets: Sequence[Set]) -> Float[np.ndarray, " s"]:
        """Logarithm of each set's evidence, the discrepancy left out; its price included."""
        k = self.effects
        gram, right = (x[..., :k] for x in self.total)
        gram = gram[:k]
        precision = np.array([self.precision(chosen) for chosen in sets])
        size = 1.0 / np.sqrt(np.diagonal(gram) + precision)
        full = gram * size[:, :, None] * size[:, None] + (precision * size**2)[:, :, None] * np.eye(k)
        unit = right * size
        mean = np.linalg.solve(full, unit[..., None])[..., 0]
        spread = np.linalg.slogdet(full)[1] - 2.0 * np.log(size).sum(axis=1) - np.log(precision).sum(axis=1)
        count = np.array([len(chosen) for chosen in sets])
        value = mean * size
        far = (np.abs(value) > FARTHEST * self.scale) | (value + self.middle < self.low)
        far &= precision == self.scale**-2.0
        logarithm = 0.5 * ((unit * mean).sum(axis=1) - spread) - PRICE * count
        return np.where(far[:, list(self.candidates)].any(axis=1), -np.inf, logarithm)

    def solve(self, chosen: Set) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K K"], float]:
        """Sizes of all effects for one set, their covariance, and the squared error they explain less their price."""
        k = self.effects
        gram, right = self.total
        full = gram[:k, :k] + np.diag(self.precision(chosen))
        covariance = _inverse(full)
        mean = covariance @ right[:k]
        return mean + self.middle, covariance, float(right[:k] @ mean)

    def best(self, most: int) -> list[Set]:
        """The likeliest set of each number of causes up to ``most``."""
        path: list[Set] = [()]
        for count in range(1, min(most, len(self.candidates)) + 1):
            if count <= EXHAUSTIVE:
                tried = list(combinations(self.candidates, count))
            else:
                more = [tuple(sorted((*path[-1], c))) for c in self.candidates if c not in path[-1]]
                swapped = [
                    tuple(sorted({*s} - {a} | {b})) for s in more[:] for a in s for b in self.candidates if b not in s
                ]
                tried = list(dict.fromkeys([*more, *swapped]))
            path.append(tried[int(np.argmax(self.evidence(tried)))])
        return path

    def group(self, chosen: Set, member: int) -> Set:
        """A chosen effect, and those that explain as much in its place, or nearly in the same way."""
        rest = tuple(c for c in chosen if c != member)
        others = [c for c in self.candidates if c not in chosen]
        wide = replace(self, scale=WIDE * self.scale)
        evidence = wide.evidence([chosen, *((*rest, c) for c in others)])
        gram, beside = self.total[0], [*rest, *self.always]
        pair = [member, *others]
        alone = gram[np.ix_(pair, pair)]
        if beside:
            mixed = gram[np.ix_(pair, beside)]
            alone = alone - mixed @ np.linalg.solve(gram[np.ix_(beside, beside)], mixed.T)
        cosine = np.abs(alone[0]) / np.sqrt(np.maximum(alone[0, 0] * np.diagonal(alone), 1e-300))
        same = (evidence[1:] > evidence[0] - TIE) | (cosine[1:] > ALIKE)
        return (member, *(c for c, alike in zip(others, same, strict=True) if alike))

    def confidence(self, chosen: Set, rng: np.random.Generator) -> dict[int, float]:
        """Share of random halves of the pieces whose likeliest set holds each of the chosen, or one of its group."""
        groups, n = {j: set(self.group(chosen, j)) for j in chosen}, len(self.piece_gram)
        share = dict.fromkeys(chosen, 0)
        for _ in range(HALVES if share else 0):
            half = self.of_pieces(rng.permutation(n)[: n // 2])
            path = half.best(len(chosen))
            likeliest = set(path[int(np.argmax(half.evidence(path)))])
            for j in share:
                share[j] += bool(groups[j] & likeliest)
        return {j: count / HALVES for j, count in share.items()}

    def beside(self, chosen: Set, prune: bool = True) -> Left:
        """Discrepancy beside a set of causes, with the amplitudes that make the flights the likeliest."""
        gram, right = self.total
        inside = np.array([*self.always, *(c for c in chosen if c not in self.always)], dtype=int)
        k = self.effects
        rest = np.array([c for c in range(k) if c not in inside], dtype=int)
        functions = np.concatenate([f.columns for f in self.families]) if self.families else np.zeros(0, int)
        other = np.concatenate([rest, functions])
        own, explained, share = 0.0, 0.0, np.zeros((0, len(other) + 1))
        inner_gram, inner_right = gram[np.ix_(other, other)], right[other]
        if len(inside):
            full = gram[np.ix_(inside, inside)] + np.diag(self.scale[inside] ** -2.0)
            share = np.linalg.solve(full, np.column_stack([gram[np.ix_(inside, other)], right[inside]]))
            inner_gram = inner_gram - gram[np.ix_(other, inside)] @ share[:, :-1]
            inner_right = inner_right - gram[np.ix_(other, inside)] @ share[:, -1]
            explained = float(right[inside] @ share[:, -1])
            own = 0.5 * (explained - np.linalg.slogdet(full)[1] + np.log(self.scale[inside] ** -2.0).sum())
        precision = np.zeros(len(other))
        precision[: len(rest)] = self.spike[rest] ** -2.0
        ends = len(rest) + np.cumsum([0, *(len(f.columns) for f in self.families)])
        parts = [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]
        usual = np.array([f.usual for f in self.families])
        diagonal = np.maximum(np.diagonal(inner_gram), 1e-300)
        a = (
            np.minimum([np.sqrt(INFORMATION / diagonal[p].mean()) for p in parts], 3.0 * usual)
            if parts
            else np.zeros(0)
        )
        decided = np.zeros(len(parts))
        for _ in range(LEARNING):
            for part, amplitude in zip(parts, a, strict=True):
                precision[part] = amplitude**-2.0
            full = inner_gram + np.diag(precision)
            covariance = _inverse(full)
            mean = covariance @ inner_right
            decided = np.array(
                [p.stop - p.start - np.trace(covariance[p, p]) / x**2 for p, x in zip(parts, a, strict=True)]
            )
            squares = np.array([mean[p] @ mean[p] for p in parts])
            number = np.maximum(decided, 1e-9)
            wanted = np.sqrt(0.5 * usual**2 * (np.sqrt(number**2 + 4.0 * squares / usual**2) - number))
            new = np.clip(np.clip(wanted, 0.3 * a, 3.0 * a), 1e-3 * usual, None)
            if np.max(np.abs(np.log(new / a)), initial=0.0) < 0.05:
                break
            a = new
        spread = np.linalg.slogdet(full)[1] - np.log(precision).sum()
        logarithm = own + 0.5 * (float(inner_right @ mean) - spread)
        price = PRICE * len(chosen) + float(
            (np.minimum(decided, 1.0) * (PRICE_OF_FAMILY + 0.5 * (a / usual) ** 2)).sum()
        )
        out = np.zeros(len(right))
        if prune and (weak := decided < 1.0).any():
            kept = tuple(f for f, gone in zip(self.families, weak, strict=True) if not gone)
            return replace(self, families=kept).beside(chosen, False)
        out[other] = mean
        out[inside] = share[:, -1] - share[:, :-1] @ mean
        out[: self.effects] += self.middle
        return Left(out, logarithm - price, explained + float(inner_right @ mean))

    def orthogonalise(self, chosen: Set, smooth: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Coefficients of functions less what a set of causes could take of them: orthogonal to the set."""
        inside = [*self.always, *(c for c in chosen if c not in self.always)]
        gram, out = self.total[0], smooth.copy()
        full = gram[np.ix_(inside, inside)] + np.diag(self.scale[inside] ** -2.0)
        out[inside] -= np.linalg.solve(full, gram[inside] @ smooth)
        return out

    def find_catalogued(
        self, chosen: Set, left: Left, square: Float[np.ndarray, "c c"], whole: float, nothing: float
    ) -> Set:
        """Causes, two at most, that beside a set leave a fifth of its discrepancy where that is a fifth of the error.

        Evidence hardly tells smooth functions from causes where all pieces are alike. square: mean squares of the
        columns; whole: of the error; nothing: too small to ask. Empty where the catalogue has no such causes.
        """
        smooth = np.where(np.arange(len(square)) < self.effects, 0.0, left.coefficients)
        able = [c for c in self.candidates if c not in chosen]

        def size(causes: Set) -> float:
            rest = self.orthogonalise(causes, smooth)
            return float(rest @ square @ rest)

        before = size(chosen)
        for count in (1, 2) if before > max(LEAST_LEFT_SHARE * whole, nothing) else ():
            sets = [(*chosen, *more) for more in combinations(able, count)]
            sets = [s for s, e in zip(sets, self.evidence(sets), strict=True) if np.isfinite(e)] if sets else []
            best = min(sets, key=size, default=chosen)
            if size(best) < LEAST_LEFT_SHARE * before:
                return best[len(chosen) :]
        return ()


@dataclass(frozen=True)
class Chosen:
    """The causes that were chosen; errors are mean squares, as ``choose`` was told them."""

    causes: Set
    path: Sequence[Set]  # the likeliest set of each number of causes
    evidence: Sequence[float]  # theirs, beside the best discrepancy
    left: Left  # beside the chosen
    errors: Float[np.ndarray, " e"]  # of the nominal model
    remaining: Float[np.ndarray, " e"]  # beside the chosen
    without: dict[int, Float[np.ndarray, " e"]]  # with each of the chosen left out

    def share(self, member: int, level: float, nothing: float) -> float:
        """Part of the nominal model's error, the noise left out, that comes back without one of the chosen."""
        gone = (self.without[member] - self.remaining) / np.maximum(self.errors - level, nothing)
        return float(np.max(gone))


def choose(
    model: LinearModel,
    errors_of: Callable[[Set], Float[np.ndarray, " e"]],
    before: Set,
    nominal: float,
    level: float,
    nothing: float,
    early: bool,
) -> Chosen:
    """The likeliest set, as long as each of its causes takes away LEAST_SHARE of an error.

    A set that was chosen before stays unless another is clearly better. early: sizes do not count yet.
    errors_of: mean square errors with a set of causes. nominal, level: mean squares of the nominal model and of the
    noise. nothing: the smallest divisor.
    """
    path = model.best(MOST_CAUSES)
    beside = [model.beside(s) for s in path]
    evidence = np.array([b.evidence for b in beside])
    held = np.array([LEAST_EVIDENCE if set(s) == set(before) else 0.0 for s in path])
    count = int(np.argmax(evidence + held - LEAST_EVIDENCE * np.arange(len(path))))
    alone = model.evidence(path[:2])
    if early and count == 0 and alone[-1] - alone[0] > HALF * (evidence[0] - alone[0]):
        count = 1  # to be looked at from there: what is far off is not told from here
    errors = [errors_of(s) for s in path[: max(count, 1) + 1]]
    whole = np.maximum(errors[0], nominal) - level
    gained = [float(np.max((a - b) / np.maximum(whole, nothing))) for a, b in zip(errors, errors[1:], strict=False)]
    while not early and count and gained[count - 1] < LEAST_SHARE:
        count -= 1
    if count == 0 and gained and gained[0] > LEADING_SHARE:
        count = 1
    causes = path[count]
    without = {j: errors_of(tuple(c for c in causes if c != j)) for j in causes}
    largest = np.maximum(errors[0], nominal)
    return Chosen(causes, path, evidence.tolist(), beside[count], largest, errors[count], without)


def _inverse(full: Float[np.ndarray, "c c"]) -> Float[np.ndarray, "c c"]:
    """Of a symmetric matrix whose columns have very different units."""
    if not len(full):
        return full
    size = 1.0 / np.sqrt(np.diagonal(full))
    root, failed = dpotrf(full * size[:, None] * size + 1e-9 * np.eye(len(full)), lower=True)
    if failed:
        raise np.linalg.LinAlgError("the information about effects and discrepancy is not positive")
    lower = np.tril(dpotri(root, lower=True)[0])
    return (lower + lower.T - np.diag(np.diagonal(lower))) * size[:, None] * size
