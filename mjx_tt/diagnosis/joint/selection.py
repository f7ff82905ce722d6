"""The smallest set of effects that no larger one beats by more than the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mjx_tt.diagnosis.joint import unexplained
from mjx_tt.diagnosis.joint.effects import SMALLEST_DELAY
from mjx_tt.diagnosis.joint.fit import Fit, Fitter
from mjx_tt.diagnosis.joint.robust import scale
from mjx_tt.diagnosis.joint.scores import Judge

PARENTS = (1, 3, 2)  # best sets of no, one and two effects that a further one is added to: three at most
CHILDREN = 3  # further effects that each of several parents tries


@dataclass(frozen=True)
class Found:
    """Result of a search."""

    best: Fit
    still: Fit  # the nominal model, but for a delay too small to be named
    judge: Judge  # noise of the best explanation


def search(fitter: Fitter, allowed: Sequence[str]) -> Found:
    """Looks among the allowed effects; every fit on the way stays in ``fitter.found``."""
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
