"""Which of the fitted effects are causes, which others would do as well, and what neither explains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjx_tt.diagnosis.joint import unexplained as leftover
from mjx_tt.diagnosis.joint.effects import EFFECTS
from mjx_tt.diagnosis.joint.fit import Fit, Fitter
from mjx_tt.diagnosis.joint.robust import rms, weights
from mjx_tt.diagnosis.joint.scores import EVIDENCE, FLOOR, UNIQUE, Judge
from mjx_tt.diagnosis.joint.selection import search
from mjx_tt.diagnosis.joint.unexplained import Leftover

RIVAL = 10.0  # two models whose losses differ by less cannot be told apart
MOST_CONFIDENT = 0.99


@dataclass(frozen=True)
class Named:
    """One effect that is a cause."""

    rivals: tuple[str, ...]  # effects that explain as much in its place
    confidence: float
    movement: float  # [rad], [m] rms


@dataclass(frozen=True)
class Verdict:
    """What one joint's log says."""

    fit: Fit  # named and unnamed effects
    named: dict[str, Named]
    leftover: Leftover | None
    judge: Judge


def examine(fitter: Fitter, allowed: Sequence[str]) -> Verdict:
    """Searches among the allowed effects, and names those that are needed and large enough."""
    log, found = fitter.log, search(fitter, allowed)
    best, judge = found.best, found.judge
    named: dict[str, Named] = {}
    for name in sorted(best.values):
        if abs(best.values[name] - log.base[name]) < EFFECTS[name].smallest:
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
    left = leftover.find(fitter, rest, judge.sigma) if log.fastest > 0.0 else None
    if left is not None:
        named = {
            n: replace(e, confidence=e.confidence * (e.movement / (e.movement + 2.0 * left.size)))
            for n, e in named.items()
            if _survives(fitter, best, n, left, judge)
        }
    return Verdict(best, named, left, judge)


def _rivals(
    fitter: Fitter, best: Fit, others: Fit, names: Sequence[str], judge: Judge
) -> tuple[tuple[str, ...], list[float]]:
    """Which of the names do as well beside the other effects, and the odds of each of the rest against the best fit."""
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


def _survives(fitter: Fitter, fit: Fit, name: str, left: Leftover, judge: Judge) -> bool:
    """Whether an effect is needed beside an anonymous block that could stand in for it, and matters more than it."""
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
