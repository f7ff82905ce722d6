"""From scores to causes: the smallest set of effects that explains the data, and what cannot be told from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mjx_tt.diagnosis.ball import scores as evidence
from mjx_tt.diagnosis.ball.effects import Effect
from mjx_tt.diagnosis.ball.linearization import Projected
from mjx_tt.diagnosis.ball.scores import LARGEST_SUBSET, Scores, SpinPrior

FLOOR = 0.003  # [m] shift of the last sample below which an effect is of no practical interest
LEAST_GAIN = 14.0  # evidence that one more effect must bring at least
SPIN_GAIN = 30.0  # and a spread of spins, which has six numbers
MAGNUS_RANGE = (0.2, 2.0)  # of the coefficient k that any source reports, with a margin (0.3 to 1.5)
LEAST_SHARE = 0.01  # of the whole gain that a member must bring: linearisation errors of a large effect are no cause
WIDEST = 10.0  # scales of an effect beyond which it is no explanation: beside others it may be all but invisible
LEAST_Z = 3.5  # estimate over its ball-to-ball standard error
ALIKE = 0.97  # |cosine| of two effects' patterns beyond which they are one group
TIE = 10.0  # gain by which the chosen set must beat a substitute


@dataclass(frozen=True)
class Choice:
    """A set of causes and how it was chosen."""

    effects: tuple[int, ...]
    spin: bool  # per-ball spin is part of the model
    theta: np.ndarray  # (len(effects),)
    error: np.ndarray  # (len(effects),) standard errors, ball to ball
    gain: float
    prior: SpinPrior | None
    magnus: float | None  # change of the Magnus coefficient that came along with spin
    threshold: float
    groups: tuple[tuple[int, ...], ...]  # for each chosen effect: what can stand in for it, itself first
    runners_up: tuple[tuple[tuple[int, ...], bool, float], ...]  # other sets with their gains


def named(choice: Choice, trial: Trial) -> tuple[bool, ...]:
    """For each chosen effect whether it passes the second gate too: a size that matters."""
    return tuple(bool(abs(t) * trial.shift[j] >= FLOOR) for t, j in zip(choice.theta, choice.effects))


@dataclass(frozen=True)
class Trial:
    """What may be chosen."""

    effects: Sequence[Effect]
    shift: np.ndarray  # (K,) [m] median shift of the last sample per unit of the effect
    spin_shift: float  # [m] the same per rad/s of spin
    spin: str  # "none": spin is a cause; "free": every ball may spin; "never": neither
    seed: int = 0
    left_out: tuple[int, ...] = ()  # effects that may not be chosen
    spinning: bool = False  # linearised about spinning balls: effects that need spin mean nothing without it


def visible(p: Projected, trial: Trial, spin: bool, std: np.ndarray | None) -> np.ndarray:
    """(K,) True where the data could show the effect: twice FLOOR would bring LEAST_GAIN."""
    scores = evidence.with_spin(p, std) if spin else evidence.without_spin(p)
    k = len(trial.effects)
    gram = np.diagonal(scores.gram)[:k].copy()
    if scores.always:
        a = list(scores.always)
        cross = scores.gram[np.ix_(range(k), a)]
        gram -= np.einsum("ka,ab,kb->k", cross, np.linalg.pinv(scores.gram[np.ix_(a, a)]), cross)
    size = np.where(trial.shift > 1e-9, 2.0 * FLOOR / np.maximum(trial.shift, 1e-9), 0.0)
    return gram * size**2 > LEAST_GAIN


def choose(p: Projected, trial: Trial, hint: SpinPrior | None = None) -> Choice:
    """The smallest set that explains what can be explained."""
    rng = np.random.default_rng(trial.seed)
    prior = None
    sets: list[tuple[bool, Scores]] = []
    if trial.spin != "free":
        sets.append((False, evidence.without_spin(p)))
    if trial.spin != "never":
        prior = hint
        if prior is None:
            plain = evidence.without_spin(p)
            first = max(evidence.all_gains(plain, _candidates(p, trial, False, None), 1).items(), key=lambda x: x[1])[0]
            prior = evidence.fit_spin(p, first)
        sets.append((True, evidence.with_spin(p, prior.std)))
    found, all_plain, thresholds = [], {}, {}
    for spin, scores in sets:
        candidates = _candidates(p, trial, spin, None if prior is None else prior.std)
        gains = evidence.all_gains(scores, candidates)
        # What chance reaches beside the best set: with a cause left out, its own signal would count as noise.
        best = max(gains, key=lambda s: gains[s] - LEAST_GAIN * len(s))
        rest = [c for c in candidates if c not in best]
        threshold = LEAST_GAIN
        if rest:
            threshold = max(threshold, evidence.flip_threshold(scores, (*best, *scores.always), rest, rng))
        thresholds[spin] = threshold
        cost = SPIN_GAIN if spin and trial.spin == "none" else 0.0
        if not spin:
            all_plain = gains
        found += [(gain - cost - threshold * len(s), s, spin, gain) for s, gain in gains.items()]
    found.sort(key=lambda f: (-f[0], len(f[1])))
    by_spin = dict(sets)
    top = found[0][3]
    for value, subset, spin, gain in found:
        plain = all_plain.get(tuple(sorted({*subset, p.coefficient} - {None}))[:LARGEST_SUBSET], -np.inf)
        if _holds(by_spin[spin], subset, gain, trial, thresholds[spin], spin, prior, top, plain):
            break
    scores = by_spin[spin]
    theta = evidence.solve(scores, (*subset, *scores.always))
    error = np.sqrt(np.diagonal(evidence.sandwich(scores, (*subset, *scores.always))))
    magnus = None
    if spin:
        prior = SpinPrior(theta[len(subset) : len(subset) + 3], prior.std)
        magnus = None if p.coefficient is None else float(theta[-1])
    groups = tuple(
        _group(scores, subset, i, gain, trial, _candidates(p, trial, spin, None if prior is None else prior.std))
        for i in range(len(subset))
    )
    others = tuple((s, sp, g) for v, s, sp, g in found[:200] if (s, sp) != (subset, spin))[:8]
    return Choice(
        subset,
        spin,
        theta[: len(subset)],
        error[: len(subset)],
        gain,
        prior if spin else None,
        magnus,
        thresholds[spin],
        groups,
        others,
    )


def refined(choice: Choice, p: Projected) -> Choice:
    """The same causes with sizes and errors from derivatives that were taken where they were found.

    With spin they stay: of coefficient and mean spin the flights show the product, and a step of each is none of that.
    """
    if choice.spin or not choice.effects:
        return choice
    scores = evidence.without_spin(p)
    error = np.sqrt(np.diagonal(evidence.sandwich(scores, choice.effects)))
    return replace(choice, theta=evidence.solve(scores, choice.effects), error=error)


def _candidates(p, trial: Trial, spin: bool, std) -> tuple[int, ...]:
    ok = visible(p, trial, spin, np.full(3, 30.0) if spin and std is None else std)
    out = set(trial.left_out)
    bent = {p.coefficient} if spin else {i for i, e in enumerate(trial.effects) if e.needs_spin and trial.spinning}
    return tuple(int(i) for i in np.flatnonzero(ok) if i not in bent and i not in out)


def _holds(
    scores: Scores, subset, gain: float, trial: Trial, threshold: float, spin: bool, prior, top: float, plain: float
) -> bool:
    """Every member passes the gate of evidence. (Members too small to matter stay in the model without being named.)"""
    if spin and trial.spin == "none":
        rms = float(np.sqrt(np.mean(prior.std**2 + prior.mean**2))) * np.sqrt(3.0)
        if rms * trial.spin_shift < FLOOR or gain - plain < SPIN_GAIN:
            return False
        # Spin that bends flights without what the bounce does to spinning balls is another force under its name.
        if len(scores.always) > 3:
            k = evidence.solve(scores, (*subset, *scores.always))[-1]
            error = np.sqrt(evidence.sandwich(scores, (*subset, *scores.always))[-1, -1])
            if k + 2.0 * error < MAGNUS_RANGE[0] or k - 2.0 * error > MAGNUS_RANGE[1]:
                return False
    if not subset:
        return True
    theta = evidence.solve(scores, (*subset, *scores.always))
    error = np.sqrt(np.diagonal(evidence.sandwich(scores, (*subset, *scores.always))))
    for i, j in enumerate(subset):
        rest = subset[:i] + subset[i + 1 :]
        brought = gain - evidence.gain(scores, rest)
        if abs(theta[i]) < LEAST_Z * error[i]:
            return False
        if brought < max(threshold, LEAST_SHARE * top):
            return False
        if theta[i] < trial.effects[j].low or abs(theta[i]) > WIDEST * trial.effects[j].scale:
            return False
    return True


def _group(scores: Scores, subset, i: int, gain: float, trial: Trial, candidates) -> tuple[int, ...]:
    """Effects that explain the data as well in place of member i, the member first."""
    rest = subset[:i] + subset[i + 1 :]
    fixed = [*rest, *scores.always]
    member = subset[i]
    others = [c for c in candidates if c not in subset]
    if not others:
        return (member,)
    _, gram = evidence.unexplained_scores(scores, fixed, [member, *others])
    cosine = np.abs(gram[0, 1:]) / np.sqrt(np.maximum(gram[0, 0] * np.diagonal(gram)[1:], 1e-300))
    alike = []
    for c, cos in zip(others, cosine):
        substitute = tuple(sorted((*rest, c)))
        if (cos > ALIKE or gain - evidence.gain(scores, substitute) < TIE) and cos > 0.5:
            theta = evidence.solve(scores, (*substitute, *scores.always))[substitute.index(c)]
            if theta >= trial.effects[c].low:
                alike.append((-cos, c))
    return (member, *(c for _, c in sorted(alike)))


def imitated(p: Projected, trial: Trial, choice: Choice) -> tuple[str, ...]:
    """Effects that were left out and would explain the data as well as two of the chosen ones together.

    A camera that is turned tilts gravity and the table alike; one of another scale changes gravity and drag. Two causes
    whose sizes happen to stand in such a ratio are a coincidence that has to be told.
    """
    if not trial.left_out or len(choice.effects) < 2:
        return ()
    scores = evidence.with_spin(p, choice.prior.std) if choice.spin else evidence.without_spin(p)
    whole = evidence.gain(scores, choice.effects)
    names = []
    for r in trial.left_out:
        for i, j in combinations(choice.effects, 2):
            rest = tuple(e for e in choice.effects if e not in (i, j))
            if whole - evidence.gain(scores, tuple(sorted((*rest, r)))) < TIE + choice.threshold:  # one number less
                names.append(trial.effects[r].name)
    return tuple(dict.fromkeys(names))
