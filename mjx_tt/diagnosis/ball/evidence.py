"""Evidence for one treatment of the flights against another: likelihood, and the price of what it supposes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.ball import scores
from mjx_tt.diagnosis.ball.flights import noise
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import KICK, Projected
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_RANGE
from mjx_tt.diagnosis.ball.selection import MAGNUS_KEPT, TIE, Choice, Settled, Trial, fitted_spins, left_over

EXTRAORDINARY = 5.0  # ordinary sizes beyond which a cause asks whether another kind of ball would do with less
SPIN_COST = 3.0  # squared error by which three more numbers of a ball must pay at least


def misfit(settled: Settled, g: Grid) -> float:
    """Twice the negative log likelihood of what a choice leaves under the noise that it leaves, and its price.

    Each sample's whitened error is bounded: mis-tracked ones decide nothing.
    """
    n, p, choice = settled.noise, settled.projected, settled.choice
    left, start = left_over(settled.linear, settled.at, p, choice, g)
    counts = g.mask & (p.weight.T > 0.0)
    error = np.minimum(noise.Whitening(n, g).distance(left) ** 2, 3.0 * noise.HUBER**2)
    spread = 2.0 * np.log(n.scale * np.sqrt(1.0 - n.memory[:, None] ** 2)).sum(axis=0)
    own = _price_of_spins(settled, g.n) + _price_of_kicks(settled, start[KICK])
    own += float(scores.price(_sizes(choice, settled.trial), np.ones(len(choice.effects))))
    # As if the samples left out were as usual: to leave out must not pay.
    share = g.mask.sum() / counts.sum()
    return float(share * np.where(counts, error + spread, 0.0).sum() + own + choice.threshold * len(choice.effects))


def _price_of_spins(settled: Settled, n: int) -> float:
    """Twice the negative log evidence of the spins beside what they explain: nothing where no ball spins.

    By Laplace's approximation where each ball's own was found: how far they lie from their prior's mean, and how much
    narrower the flights made them than the prior.
    """
    prior, p = settled.choice.prior, settled.projected
    if prior is None:
        return 0.0
    if not prior.conditional:
        return SPIN_COST * n
    middle, precision = prior.of_balls(n)
    away = fitted_spins(p, settled.choice) - middle
    narrower = np.linalg.slogdet(np.eye(3) + np.linalg.solve(precision, p.spin_gram))[1]
    return float(np.einsum("an,nab,bn->", away, precision, away) + narrower.sum())


def _sizes(choice: Choice, trial: Trial) -> Float[np.ndarray, " c"]:
    """Sizes of the causes in ordinary ones."""
    return np.asarray(choice.theta) / np.array([trial.effects[j].scale for j in choice.effects])


def _price_of_kicks(settled: Settled, kick: np.ndarray) -> float:
    """The same of the bounces' own kicks (3, n); nothing where all bounces are alike."""
    scatter = settled.noise.scatter
    if not scatter.any():
        return 0.0
    narrower = np.linalg.slogdet(np.eye(3) + scatter[:, None] * settled.projected.kick_gram * scatter)[1]
    return float(((kick / scatter[:, None]) ** 2).sum() + narrower.sum())


def shift_of_scatter(settled: Settled, g: Grid) -> float:
    """Median shift [m] of a flight's last sample by a usual kick of its bounce; 0 where all bounces are alike."""
    moved = settled.linear.starts[KICK][:, :, g.last, np.arange(g.n)] * settled.noise.scatter[:, None, None]
    return float(np.median(np.sqrt((moved**2).sum(axis=(0, 1)))))


def shift_of_spins(settled: Settled) -> float:
    """Median shift [m] of a flight's last sample by a usual spin of the log; 0 where nothing spins."""
    prior = settled.choice.prior
    if prior is None:
        return 0.0
    return float(np.sqrt(np.sum(prior.std**2 + prior.mean**2))) * settled.trial.spin_shift


def lifts(settled: Settled) -> bool:
    """True where the Magnus coefficient that goes with the spins is not held at an end of what balls have."""
    j = settled.projected.coefficient
    return j is None or bool(MAGNUS_RANGE[0] < settled.at.theta[j] < MAGNUS_RANGE[1])


def spins_without_lift(settled: Settled) -> bool:
    """True where spins of the balls' own were chosen with a Magnus coefficient that is held at an end."""
    prior = settled.choice.prior
    return prior is not None and prior.conditional and not lifts(settled)


def bent_too_far(choice: Choice) -> bool:
    """True if spin was chosen with a Magnus coefficient that no ball has: a line bent too far."""
    return choice.magnus is not None and not MAGNUS_KEPT[0] <= choice.magnus <= MAGNUS_KEPT[1]


def extraordinary(choice: Choice, trial: Trial) -> bool:
    """True where a cause was chosen of a size that hardly any set-up has: what spin bends in one way, wind does too."""
    return bool(np.any(np.abs(_sizes(choice, trial)) > EXTRAORDINARY))


def imitated(p: Projected, trial: Trial, choice: Choice) -> tuple[str, ...]:
    """Effects that were left out and would explain the data as well as two of the chosen ones together.

    A camera that is turned tilts gravity and the table alike; one of another scale changes gravity and drag. Two causes
    whose sizes happen to stand in such a ratio are a coincidence that has to be told.
    """
    if not trial.left_out or len(choice.effects) < 2:
        return ()
    rated = scores.under(p, choice.prior)
    whole = scores.gain(rated, choice.effects)
    names = []
    for r in trial.left_out:
        for i, j in combinations(choice.effects, 2):
            rest = tuple(e for e in choice.effects if e not in (i, j))
            if whole - scores.gain(rated, tuple(sorted((*rest, r)))) < TIE + choice.threshold:  # one number less
                names.append(trial.effects[r].name)
    return tuple(dict.fromkeys(names))
