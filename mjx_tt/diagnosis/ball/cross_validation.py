"""Gain on data that was not used: each ball predicted by a model fitted on others.

A ball's state is fitted to the first 30 % of its samples, the rest is predicted: by the nominal model, and by the model
extended with causes whose size the other folds gave. How much of a ball's own spin to believe after so short a part is
learned from the other folds as well: small errors of any model pass for spin there, and grow behind it. The interval is
a paired bootstrap over the balls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.ball.diagnose import BallFindings
from mjx_tt.diagnosis.ball.effects import FLIGHT, TABLE
from mjx_tt.diagnosis.ball.flights.fit import fit_starts
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import KICK, SPIN, BallProblem
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_RANGE, SpinPrior
from mjx_tt.diagnosis.verdict import HeldOut

FIRST_PART = 0.3
FOLDS = 5
DRAWS = 2000
BELIEVED = (1.0, 0.3, 0.1)  # of the spins' deviation from ball to ball, that a ball's own may take up
PAYS = 0.9  # of the error on unseen balls, below which one more effect has to bring it
MOST_COMPANIONS, TRIED = 2, 4  # effects beside the causes; that are tried for each
SET_UP = ("_x", "_y", "_z", "height")  # ends of paths that are not the ball's nor the table's own
GROSS = 6.0  # times a ball's median distance beyond which a sample is an outlier of the tracker, for either model
METRIC = "rms of the predicted last 70 % of each flight, state from the first 30 % [mm]"


@dataclass(frozen=True)
class Prediction:
    """Errors ball by ball [m]."""

    before: Float[np.ndarray, " n"]  # root mean square under the nominal model
    after: Float[np.ndarray, " n"]  # under the extended one


def with_companions(found: BallFindings, seed: int = 0) -> tuple[BallFindings, Prediction]:
    """The findings and their held-out errors, with effects of ball and table beside the causes where unseen balls want
    them.

    Where something stays unexplained a cause may need another, too small to be named or too uncertain, to predict well.
    """
    prediction, search = predictions(found, seed), found.search
    while found.unexplained and len(found.companions) < MOST_COMPANIONS:
        others = [
            c
            for c in search.model.candidates
            if c not in (*search.chosen, *found.companions)
            and found.problem.effects[c].path.startswith((FLIGHT, TABLE))
            and not found.problem.effects[c].path.endswith(SET_UP)
        ]
        order = np.argsort(-search.model.evidence([(*search.chosen, *found.companions, c) for c in others]))
        tried = [replace(found, companions=(*found.companions, others[i])) for i in order[:TRIED]]
        errors = [predictions(one, seed) for one in tried]
        if not errors:
            break
        best = int(np.argmin([np.nanmedian(e.after) for e in errors]))
        if np.nanmedian(errors[best].after) > PAYS * np.nanmedian(prediction.after):
            break
        found, prediction = tried[best], errors[best]
    return found, prediction


def predictions(found: BallFindings, seed: int = 0) -> Prediction:
    """Held-out errors of every ball with enough samples."""
    problem, g, search = found.problem, found.problem.grid, found.search
    k = len(problem.effects)
    first = np.maximum(np.ceil(FIRST_PART * g.mask.sum(axis=0)), 5)
    keep = np.cumsum(g.mask, axis=0) <= first[None]
    fold = _folds(found, seed)
    theta = np.zeros((k, g.n))
    chosen = (*search.chosen, *found.companions)
    inside = [*search.model.always, *chosen]
    for f in range(FOLDS):
        of_others = search.model.of_pieces(np.flatnonzero(fold != f))
        theta[np.ix_(inside, fold == f)] = of_others.solve(chosen)[0][inside, None]
    if problem.coefficient in search.model.always:
        theta[problem.coefficient] = np.clip(theta[problem.coefficient], *MAGNUS_RANGE)
    prior = None if search.prior is None else SpinPrior(search.prior.mean, search.prior.std)
    # Where the nominal ball may spin, spins are no part of the extension: both models know the same of them.
    base = found.start0.copy()
    base[SPIN] = 0.0
    error0 = _predicted(found, np.zeros((k, g.n)), base, None if found.spin_is_cause else prior, keep, fold)
    if not inside and prior is None:
        return Prediction(error0, error0.copy())
    start = search.at.start.copy()
    start[KICK] = 0.0
    if prior is not None:
        start[SPIN] = prior.mean[:, None]
    return Prediction(error0, _predicted(found, theta, start, prior, keep, fold))


def _predicted(
    found: BallFindings,
    theta: np.ndarray,
    start: np.ndarray,
    prior: SpinPrior | None,
    keep: np.ndarray,
    fold: np.ndarray,
) -> Float[np.ndarray, " n"]:
    """Error of each ball behind the samples to keep, its state fitted to these."""
    problem, g = found.problem, found.problem.grid
    errors = []
    for believed in BELIEVED if prior is not None else BELIEVED[:1]:
        own = None if prior is None else SpinPrior(prior.mean, believed * prior.std)
        fitted = fit_starts(problem, theta, start, g, found.search.noise, own, rounds=4, keep=keep)
        errors.append(_error(problem, theta, fitted, g, ~keep & g.mask))
    error = errors[0].copy()
    for f in np.unique(fold):
        square = [np.nanmean(e[fold != f] ** 2) if np.isfinite(e[fold != f]).any() else np.inf for e in errors]
        error[fold == f] = errors[int(np.argmin(square))][fold == f]
    return error


def held_out(p: Prediction, seed: int = 0) -> HeldOut:
    """Root mean squares over the balls in mm, and the 90 % interval of what the extension gains."""
    ok = np.isfinite(p.before) & np.isfinite(p.after)
    before, after = p.before[ok] ** 2, p.after[ok] ** 2
    rng = np.random.default_rng(seed)
    index = rng.integers(0, len(before), (DRAWS, len(before)))
    gain = np.sqrt(before[index].mean(axis=1)) - np.sqrt(after[index].mean(axis=1))
    low, high = np.percentile(gain, [5, 95])
    return HeldOut(METRIC, *(float(1e3 * x) for x in (np.sqrt(before.mean()), np.sqrt(after.mean()), low, high)))


def _folds(found: BallFindings, seed: int) -> np.ndarray:
    """Fold of each ball: whole sessions where there are enough of them, single balls otherwise."""
    rng = np.random.default_rng(seed)
    sessions = found.sessions.number
    count = sessions.max() + 1
    if count >= FOLDS:
        return rng.permutation(np.arange(count) % FOLDS)[sessions]
    return rng.permutation(np.arange(len(sessions)) % FOLDS)


def _error(problem: BallProblem, theta: np.ndarray, start: np.ndarray, g: Grid, rest: np.ndarray) -> np.ndarray:
    flown = problem.fly(theta, start)
    distance = np.linalg.norm(g.measured - flown.measured[:, :, 0], axis=0)
    distance = np.where(rest, distance, np.nan)
    with np.errstate(all="ignore"):
        middle = np.nanmedian(distance, axis=0)
        distance = np.where(distance > GROSS * middle[None], np.nan, distance)
        return np.sqrt(np.nanmean(distance**2, axis=0))
