"""Selection of the causes: the smallest set of effects that no larger one beats by more than the noise.

Beside it, what would do as well in place of each, and what neither explains.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjx_tt.diagnosis.joint import unexplained
from mjx_tt.diagnosis.joint.effects import BY_NAME, SMALLEST_DELAY
from mjx_tt.diagnosis.joint.fit import Fit, Fitter
from mjx_tt.diagnosis.joint.scores import EVIDENCE, FLOOR, UNIQUE, Judge, rms, scale, weights
from mjx_tt.diagnosis.joint.unexplained import Finding

PARENTS = (1, 3, 2)  # best sets of no, one and two effects that a further one is added to: three at most
CHILDREN = 3  # further effects that each of several parents tries
RIVAL = 10.0  # two models whose losses differ by less cannot be told apart
MOST_CONFIDENT = 0.99


@dataclass(frozen=True)
class Found:
    """Result of a search."""

    best: Fit
    still: Fit  # the nominal model, but for a delay too small to be named
    judge: Judge  # noise of the best explanation


def search(fitter: Fitter, allowed: Sequence[str]) -> Found:
    """Search among the allowed effects; every fit on the way stays in ``fitter.found``."""
    log = fitter.log
    nominal = fitter.fit({}, scale(log.centred(log.measured - log.simulate({}))))
    if log.fastest == 0.0:
        return Found(nominal, nominal, Judge(log, nominal.residual))
    sigma = scale(nominal.residual)
    # A delay too small to be named must not be named as something else.
    around = log.base["action_delay"]
    tiny = {"action_delay": (max(around - SMALLEST_DELAY, 0.0), around + SMALLEST_DELAY)}
    still = fitter.fit({"action_delay": around}, sigma, tiny)
    judge = Judge(log, still.residual)
    levels = [nominal]
    ranked = [nominal]
    for size, parents in enumerate(PARENTS, 1):
        ranked = _larger(fitter, ranked[:parents], allowed, sigma)
        if not ranked:
            break
        sigma = scale(ranked[0].residual)
        ranked = [fitter.fit(f.values, sigma) for f in ranked[:4]] + ranked[4:]
        ranked.sort(key=lambda f: f.loss(sigma))
        for f in ranked:
            fitter.found[f.names] = f
        before = still if size == 1 else levels[-1]
        levels.append(ranked[0])
        judge = Judge(log, ranked[0].residual)
        if not judge.convincing(before.residual, ranked[0].residual):
            break
        if size > 1 and unexplained.find(fitter, ranked[0], sigma) is None:
            break
    best, against = nominal, still
    for larger in levels[1:]:  # by the last noise, which is the least
        if not judge.convincing(against.residual, larger.residual):
            break
        best = against = larger
    return Found(best, still, judge)


def _larger(fitter: Fitter, parents: Sequence[Fit], allowed: Sequence[str], sigma: float) -> list[Fit]:
    """Fits of the parents with one effect more, best first."""
    made: dict[frozenset[str], Fit] = {}
    for parent in parents:
        slopes = fitter.jacobian(parent.values)
        choices = [n for n in allowed if n not in parent.values and parent.names | {n} not in made]
        guesses = {n: fitter.guess(parent, slopes, n, sigma) for n in choices}
        choices.sort(key=lambda n: -guesses[n][0])
        for name in choices[:CHILDREN] if parent.values else choices:
            new = fitter.add(parent, name, guesses[name][1], sigma)
            if new is not None:
                made[new.names] = new
    return sorted(made.values(), key=lambda f: f.loss(sigma))


@dataclass(frozen=True)
class Named:
    """One effect that is a cause."""

    rivals: tuple[str, ...]  # effects that explain as much in its place
    confidence: float
    movement: float  # [rad], [m] rms


@dataclass(frozen=True)
class Choice:
    """Causes of one joint and how they were chosen."""

    fit: Fit  # named and unnamed effects
    named: dict[str, Named]
    unexplained: Finding | None
    judge: Judge


def choose(fitter: Fitter, allowed: Sequence[str]) -> Choice:
    """Search among the allowed effects, and name those that are needed and large enough."""
    log, found = fitter.log, search(fitter, allowed)
    best, judge = found.best, found.judge
    named: dict[str, Named] = {}
    for name in sorted(best.values):
        if abs(best.values[name] - log.base[name]) < BY_NAME[name].smallest:
            continue
        without = {n: v for n, v in best.values.items() if n != name}
        movement = rms(log.centred(log.simulate(best.values) - log.simulate(without)))
        dropped = fitter.found.get(frozenset(without)) if without else found.still
        dropped = fitter.fit(without, judge.sigma) if dropped is None else dropped
        if movement < FLOOR or not judge.convincing(dropped.residual, best.residual):
            continue
        others = Fit(without, dropped.residual) if without else fitter.fit({}, judge.sigma)
        needed = judge.gain(dropped.residual, best.residual)[0] - math.log(log.time.size)
        rivals, odds = _rivals(fitter, best, others, [n for n in allowed if n not in best.values], judge)
        doubt = sum(odds, math.exp(-0.5 * needed))
        named[name] = Named(rivals, min(1.0 / (1.0 + doubt), MOST_CONFIDENT), movement)
    rest = best if best.values else Fit({}, found.still.residual)
    left = unexplained.find(fitter, rest, judge.sigma) if log.fastest > 0.0 else None
    if left is not None:
        named = {
            n: replace(e, confidence=e.confidence * (e.movement / (e.movement + 2.0 * left.size)))
            for n, e in named.items()
            if _survives(fitter, best, n, left, judge)
        }
    return Choice(best, named, left, judge)


def _rivals(
    fitter: Fitter, best: Fit, others: Fit, names: Sequence[str], judge: Judge
) -> tuple[tuple[str, ...], list[float]]:
    """Names that do as well beside the other effects, and the odds of each of the rest against the best fit."""
    rivals, odds = [], []
    slopes = fitter.jacobian(others.values)
    for name in names:
        twin = fitter.found.get(others.names | {name})
        if twin is None:
            twin = fitter.add(others, name, fitter.guess(others, slopes, name, judge.sigma)[1], judge.sigma)
        if twin is None:
            continue
        behind = judge.gain(twin.residual, best.residual)[0]
        if behind < RIVAL:
            rivals.append(name)
        else:
            odds.append(math.exp(-0.5 * behind))
    return tuple(rivals), odds


def _survives(fitter: Fitter, fit: Fit, name: str, left: Finding, judge: Judge) -> bool:
    """True for an effect that is needed beside an anonymous block that could stand in for it, and matters more."""
    log, weight = fitter.log, weights(fit.residual, judge.sigma)
    root = np.sqrt(weight)[:, None]
    without = {n: v for n, v in fit.values.items() if n != name}
    moved = log.simulate(fit.values) - log.simulate(without)
    moved, slopes, anonymous = (
        log.centred(x, weight) * root for x in (moved[:, None], fitter.jacobian(without), left.block.columns)
    )

    def beside(columns: np.ndarray) -> np.ndarray:
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
        return moved - columns @ np.linalg.lstsq(columns, moved, rcond=1e-8)[0]

    alone = rms(beside(slopes)) if slopes.size else rms(moved)
    needed = beside(np.concatenate([slopes, anonymous], axis=1))
    evidence = float(np.sum(needed * needed)) / judge.sigma**2 / judge.inflation
    return evidence > EVIDENCE and rms(needed) > max(UNIQUE, 0.3 * alone, left.size)
