"""The leading cause: what accounts for nearly all of a misfit, of which something small stays without an explanation.

Thousands of clean samples show that every model is wrong. Where something stays open no set of causes is named, for any
of them may stand for it; but where one effect alone takes away nearly all that the catalogue and the unnamed patterns
can take away together, and unseen balls are missed by clearly less, the simulation is better with it than without.
It is fitted together with what one make of ball and table differs from another in, which any ball and table do. What
stays open widens its interval: had all of it come from this effect, its size would be off by as much.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mjx_tt.diagnosis.ball import evidence, scores, selection
from mjx_tt.diagnosis.ball.cross_validation import Prediction, held_out, predictions
from mjx_tt.diagnosis.ball.diagnose import SCATTER, BallFindings, plain, spinning
from mjx_tt.diagnosis.ball.flights.linearization import Situation
from mjx_tt.diagnosis.ball.selection import Settled
from mjx_tt.diagnosis.ball.unexplained import find

LEAST_SHARE = 0.9  # of what all effects and unnamed patterns explain together
TIE = 0.03  # share by which effects do as well as each other: of balls of one way and speed much is alike
RIVAL = 0.1  # share that another effect may lack and still be told as an alternative
LEAST_GAIN = 0.2  # share of the error on unseen balls that goes with it, at the lower end of the interval
BOOTSTRAP = 100
# What one make of ball and table differs from another in; a set-up's errors (camera, level, air) are no part of it.
BALL_AND_TABLE = ("drag_coefficient", "magnus_coefficient", "table_restitution", "table_friction", "table_grip")


@dataclass(frozen=True)
class Leading:
    """A leading cause and the flights under it alone."""

    found: BallFindings  # of which the choice holds it, its rivals in its group, and what balls and tables differ in
    place: int  # in the choice
    share: float  # of what is wrong
    confidence: float  # share of bootstrap draws of the balls in which it, or a rival, leads
    prediction: Prediction  # of unseen balls


def leading(found: BallFindings, say: Callable[[str], None], seed: int = 0) -> Leading | None:
    """The leading cause of flights of which something stays open; None where no effect leads or unseen balls disagree.

    Spins and bounces of the balls' own are allowed for where the flights' evidence is better with them.
    """
    problem, g, trial = found.problem, found.problem.grid, found.trial
    say("looking for a leading cause")
    best = Settled(found.situation, found.linear, found.choice, found.noise, found.projected, trial)
    nominal = Situation(np.zeros(len(trial.effects)), found.start0)
    if trial.spin != "never":
        other, _ = spinning(problem, trial, nominal, say, SCATTER)
        if evidence.misfit(other, g) < evidence.misfit(best, g) and evidence.lifts(other):
            best = other
    # The flights alone: the price of a size may not decide between effects that all have surprising ones.
    rated = scores.under(best.projected, best.choice.prior)
    alone = scores.gain(rated, ())
    called = [str(i) for i in range(int(found.sessions.max()) + 1)]
    patterns = find(best, g, found.sessions, found.age, called).findings
    open_ = max((f.gain for f in patterns), default=0.0)
    total = scores.gain(rated, best.choice.effects) - alone + open_
    if total <= 0.0:
        return None
    spins = best.choice.prior is not None
    able = [
        i
        for i, e in enumerate(trial.effects)
        if i not in rated.always and i not in trial.left_out and not e.made_of and (spins or not e.needs_spin)
    ]
    able = [i for i in able if not any(i == one for one, _ in trial.bound)]
    shares = {i: (scores.gain(rated, (i,)) - alone) / total for i in able if _possible(rated, trial, i)}
    if not shares:
        return None
    most = max(shares.values())
    if most < LEAST_SHARE:
        return None
    near = [i for i in shares if shares[i] > most - RIVAL]
    # Of those that do as well, one of ball and table, which are fitted in any case; then the least surprising one.
    best_of = [i for i in near if shares[i] > most - TIE]
    leads = min(best_of, key=lambda i: (trial.effects[i].name not in BALL_AND_TABLE, _surprise(rated, trial, i)))
    say(f"{trial.effects[leads].name} leads: once more with what balls and tables differ in")
    kept = {leads, problem.coefficient, *(i for i, e in enumerate(trial.effects) if e.name in BALL_AND_TABLE)}
    others = tuple(i for i in range(len(trial.effects)) if i not in kept or i in trial.left_out)
    few = replace(trial, left_out=others, spin=trial.spin if spins else "never")
    settled, _ = spinning(problem, few, nominal, say) if spins else plain(problem, few, nominal, say)
    if leads not in settled.choice.effects or (spins and not evidence.lifts(settled)):
        return None
    at = settled.choice.effects.index(leads)
    rivals = tuple(sorted((i for i in near if i != leads), key=lambda i: -shares[i]))
    open_size = abs(settled.choice.theta[at]) * np.sqrt(max(1.0 - shares[leads], 0.0))
    groups, error = list(settled.choice.groups), settled.choice.error.copy()
    groups[at], error[at] = (leads, *rivals), np.hypot(error[at], open_size)
    few_found = replace(
        found,
        situation=settled.at,
        linear=settled.linear,
        choice=replace(settled.choice, groups=tuple(groups), error=error, runners_up=()),
        trial=replace(settled.trial, left_out=trial.left_out, spin=trial.spin),
        noise=settled.noise,
        projected=settled.projected,
    )
    prediction = predictions(few_found, seed)
    unseen = held_out(prediction, seed)
    if unseen.low < LEAST_GAIN * unseen.before:
        return None
    return Leading(few_found, at, float(shares[leads]), _confidence(rated, able, (leads, *rivals), seed), prediction)


def _possible(rated: scores.Scores, trial: selection.Trial, i: int) -> bool:
    """True where the size that fits best alone is one that the effect can have."""
    effect, theta = trial.effects[i], scores.solve(rated, (i, *rated.always))[0]
    return bool(effect.low <= theta and abs(theta) <= selection.WIDEST * effect.scale)


def _surprise(rated: scores.Scores, trial: selection.Trial, i: int) -> float:
    """Size that fits best alone, in ordinary ones."""
    return float(abs(scores.solve(rated, (i, *rated.always))[0]) / trial.effects[i].scale)


def _confidence(rated: scores.Scores, able: list[int], group: tuple[int, ...], seed: int) -> float:
    """Share of bootstrap draws of the balls in which a member of the group explains most alone."""
    rng, n = np.random.default_rng(seed), len(rated.ball_right)
    won = 0
    for _ in range(BOOTSTRAP):
        drawn = rated.weighted(rng.multinomial(n, np.full(n, 1.0 / n)).astype(float))
        won += max(able, key=lambda i: scores.gain(drawn, (i,))) in group
    return won / BOOTSTRAP


def beside(lead: Leading) -> dict[str, float]:
    """Values of the extended model that go with a leading cause: those of ball and table, and the balls' spins."""
    choice, problem, theta = lead.found.choice, lead.found.problem, np.zeros(len(lead.found.problem.effects))
    others = [j for j in choice.effects if j != choice.effects[lead.place]]
    theta[others] = lead.found.situation.theta[others]
    if choice.prior is not None and problem.coefficient is not None:
        theta[problem.coefficient] = lead.found.situation.theta[problem.coefficient]
    values = {path: float(value) for path, value in problem.values(theta).items() if value != problem.nominal[path]}
    if choice.prior is not None:
        for axis, mean, std in zip("xyz", choice.prior.mean, choice.prior.std, strict=True):
            values |= {f"ball_spin.mean_{axis}": float(mean), f"ball_spin.std_{axis}": float(std)}
    return values
