"""Selection of the causes: the smallest set of effects that explains the data, and what cannot be told from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from mjx_tt.diagnosis.ball import scores
from mjx_tt.diagnosis.ball.effects import Effect
from mjx_tt.diagnosis.ball.flights import noise
from mjx_tt.diagnosis.ball.flights.fit import fit_starts, refit_worst
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import (
    KICK,
    SPIN,
    BallProblem,
    Linear,
    Projected,
    Situation,
    project,
    shifts,
)
from mjx_tt.diagnosis.ball.flights.noise import Noise
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_RANGE, TINY, SpinPrior, learned
from mjx_tt.diagnosis.ball.scores import LARGEST_SUBSET, Scores, Subset

FLOOR = 0.003  # [m] shift of the last sample below which an effect is of no practical interest
LEAST_GAIN = 14.0  # evidence that one more effect must bring at least
SPIN_GAIN = 30.0  # and a spread of spins, which has six numbers
LEAST_SHARE = 0.003  # of the gain of the way from where derivatives were taken: a line's error is no cause
ROUNDS = 4  # of choosing and linearising again
SETTLED = 0.2  # of an estimate's error by which it may still have moved in the last round
MAGNUS_KEPT = (0.2, 1.5)  # of the coefficient k about which derivatives are taken by balls of one spin
NEAR = np.repeat([0.5, 5.0, 1000.0, 5.0], 3)  # [m], [m/s], [rad/s], [m/s] by which a ball's start may move at once
CORNER = 5e-4  # [s] about the bounce of a spinning ball in which no sample counts
WIDEST = 10.0  # scales of an effect beyond which it is no explanation: beside others it may be all but invisible
LEAST_Z = 3.5  # estimate over its ball-to-ball standard error
ALIKE = 0.97  # |cosine| of two effects' patterns beyond which they are one group
TIE = 10.0  # gain by which the chosen set must beat a substitute


@dataclass(frozen=True)
class Choice:
    """A set of causes and how it was chosen."""

    effects: tuple[int, ...]
    theta: np.ndarray  # (len(effects),)
    error: np.ndarray  # (len(effects),) standard errors, ball to ball
    gain: float
    prior: SpinPrior | None  # of the balls' spins, where spin is part of the model
    magnus: float | None  # change of the Magnus coefficient that came along with spin
    threshold: float
    groups: tuple[tuple[int, ...], ...]  # for each chosen effect: what can stand in for it, itself first
    runners_up: tuple[tuple[tuple[int, ...], bool, float], ...]  # other sets with their gains

    @property
    def spin(self) -> bool:
        """True if per-ball spin is part of the model."""
        return self.prior is not None


def named(choice: Choice, trial: Trial) -> tuple[bool, ...]:
    """For each chosen effect: True if it passes the second gate too, a size that matters.

    What means nothing without another effect is not named without it.
    """
    matter = {j for t, j in zip(choice.theta, choice.effects, strict=True) if abs(t) * trial.shift[j] >= FLOOR}
    alone = {one for one, other in trial.bound if other not in matter}
    return tuple(j in matter - alone for j in choice.effects)


@dataclass(frozen=True)
class Trial:
    """Effects that may be chosen."""

    effects: Sequence[Effect]
    shift: np.ndarray  # (K,) [m] median shift of the last sample per unit of the effect
    spin_shift: float  # [m] the same per rad/s of spin
    spin: str  # "none": spin is a cause; "free": every ball may spin; "never": neither
    seed: int = 0
    left_out: tuple[int, ...] = ()  # effects that may not be chosen
    bound: tuple[tuple[int, int], ...] = ()  # effects that mean nothing without another: (effect, the other)
    spinning: bool = False  # linearised about spinning balls: effects that need spin mean nothing without it


def visible(rated: Scores, trial: Trial, scatters: bool = False) -> Bool[np.ndarray, " K"]:
    """True where the data could show the effect: twice FLOOR would bring LEAST_GAIN, four times where bounces scatter.

    There each ball's own bounce is worth several FLOOR and hides small effects, but no large one's rival.
    """
    k = len(trial.effects)
    gram = np.diagonal(rated.gram)[:k].copy()
    if rated.always:
        a = list(rated.always)
        cross = rated.gram[np.ix_(range(k), a)]
        gram -= np.einsum("ka,ab,kb->k", cross, np.linalg.pinv(rated.gram[np.ix_(a, a)]), cross)
    least = (4.0 if scatters else 2.0) * FLOOR
    size = np.where(trial.shift > 1e-9, least / np.maximum(trial.shift, 1e-9), 0.0)
    return gram * size**2 > LEAST_GAIN


@dataclass(frozen=True)
class _Treatment:
    """One treatment of spin, with the gains of all sets under it."""

    rated: Scores
    prior: SpinPrior | None  # of the spins, None where nothing spins
    candidates: Subset
    gains: dict[Subset, float]
    threshold: float


def _treated(p: Projected, trial: Trial, prior: SpinPrior | None, rng: np.random.Generator) -> _Treatment:
    rated = scores.priced(scores.under(p, prior), trial.effects)
    candidates = _candidates(rated, p, trial, prior is not None)
    gains = scores.all_gains(rated, candidates)
    # What chance reaches beside the best set: with a cause omitted, its own signal would count as noise.
    best = max(gains, key=lambda s: gains[s] - LEAST_GAIN * len(s))
    rest = [c for c in candidates if c not in best]
    threshold = LEAST_GAIN
    if rest:
        threshold = max(threshold, scores.flip_threshold(rated, (*best, *rated.always), rest, rng))
    gains = scores.widened(rated, gains, candidates, threshold)
    return _Treatment(rated, prior, candidates, gains, threshold)


def choose(p: Projected, trial: Trial, about: Float[np.ndarray, " K"], hint: SpinPrior | None = None) -> Choice:
    """The smallest set that explains what can be explained.

    about: changes at which derivatives were taken. hint: distribution of the spins, fitted without it.
    """
    rng = np.random.default_rng(trial.seed)
    treatments: dict[bool, _Treatment] = {}
    if trial.spin != "free":
        treatments[False] = _treated(p, trial, None, rng)
    if trial.spin != "never":
        if hint is None:
            plain = scores.without_spin(p)
            single = scores.all_gains(plain, _candidates(plain, p, trial, False), 1)
            hint = scores.fit_spin(p, max(single, key=lambda s: single[s]))
        treatments[True] = _treated(p, trial, hint, rng)
    found = []
    for spin, t in treatments.items():
        cost = SPIN_GAIN if spin and trial.spin == "none" else 0.0
        found += [(gain - cost - t.threshold * len(s), s, spin, gain) for s, gain in t.gains.items()]
    found.sort(key=lambda f: (-f[0], len(f[1])))
    without = treatments[False].gains if False in treatments else {}
    bent = () if p.coefficient is None else (p.coefficient,)

    def holds(subset: Subset, spin: bool, gain: float) -> bool:
        plain = without.get(tuple(sorted({*subset, *bent}))[:LARGEST_SUBSET], -np.inf)
        return _holds(treatments[spin], subset, gain, trial, about, plain)

    _, subset, spin, gain = next((f for f in found if holds(*f[1:])), found[-1])
    t = treatments[spin]
    theta, error = _estimated(t.rated, subset)
    count, prior, magnus = len(subset), None, None
    if t.prior is not None:
        magnus = None if p.coefficient is None else float(theta[-1])
        if t.prior.conditional:
            shown = [*subset] if p.coefficient is None else [*subset, p.coefficient]
            prior = learned(p.spin_gram, p.spin_right - p.spin_effect[:, :, shown] @ theta)
        else:
            prior = t.prior.moved(theta[count : count + 3] - t.prior.mean)
    groups = tuple(_group(t, subset, i, gain, trial) for i in range(count))
    others = tuple((s, sp, g) for _, s, sp, g in found[:200] if (s, sp) != (subset, spin))[:8]
    return Choice(subset, theta[:count], error[:count], gain, prior, magnus, t.threshold, groups, others)


def _estimated(rated: Scores, subset: Subset) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Estimates and standard errors of a subset and of the columns that every one holds."""
    chosen = (*subset, *rated.always)
    return scores.solve(rated, chosen), np.sqrt(np.diagonal(scores.sandwich(rated, chosen)))


def refined(choice: Choice, p: Projected) -> Choice:
    """The same causes with sizes and errors from derivatives that were taken where they were found.

    With spin they stay: of coefficient and mean spin the flights show the product, and a step of each is none of that.
    """
    if not choice.effects or (choice.prior is not None and not choice.prior.conditional):
        return choice
    theta, error = _estimated(scores.under(p, choice.prior), choice.effects)
    count = len(choice.effects)
    return replace(choice, theta=theta[:count], error=error[:count])


def _candidates(rated: Scores, p: Projected, trial: Trial, spin: bool) -> Subset:
    bent = {p.coefficient} if spin else {i for i, e in enumerate(trial.effects) if e.needs_spin and trial.spinning}
    if p.coefficient is not None or not spin:  # where the lift is free anyway, drag and lift together are drag alone
        bent |= {i for i, e in enumerate(trial.effects) if e.made_of}
    shown = np.flatnonzero(visible(rated, trial, bool(p.noise.scatter.any()))).tolist()
    return tuple(i for i in shown if i not in bent and i not in trial.left_out)


def _holds(
    t: _Treatment, subset: Subset, gain: float, trial: Trial, about: Float[np.ndarray, " K"], plain: float
) -> bool:
    """True if every member passes the gate of evidence. (Those too small to matter stay without being named.)

    about: changes at which derivatives were taken; plain: gain of this set without spin.
    """
    if any(one in subset and other not in subset for one, other in trial.bound):
        return False
    as_cause = t.prior is not None and trial.spin == "none"
    if t.prior is not None and as_cause:
        rms = float(np.sqrt(np.mean(t.prior.std**2 + t.prior.mean**2))) * np.sqrt(3.0)
        if rms * trial.spin_shift < FLOOR or gain - plain < SPIN_GAIN:
            return False
    theta, error = _estimated(t.rated, subset)
    if as_cause and len(t.rated.always) in (1, 4):
        # Spin that bends flights without what the bounce does to spinning balls is another force under its name.
        k, wide = theta[-1], 2.0 * error[-1]
        if k + wide < MAGNUS_RANGE[0] or k - wide > MAGNUS_RANGE[1]:
            return False
    if scores.undo(t.rated, subset, theta, ALIKE):
        return False
    way = -about
    way[list(subset)] += theta[: len(subset)]
    way[[j for j in t.rated.always if j < len(way)]] = 0.0
    far = LEAST_SHARE * float(way @ t.rated.gram[: len(way), : len(way)] @ way)
    for i, j in enumerate(subset):
        brought = gain - scores.gain(t.rated, subset[:i] + subset[i + 1 :])
        if abs(theta[i]) < LEAST_Z * error[i]:
            return False
        if brought < max(t.threshold, far):
            return False
        # A size that cannot be is no cause, but a small one may stand for how the true cause differs from its entry.
        if theta[i] < trial.effects[j].low and abs(theta[i]) * trial.shift[j] >= FLOOR:
            return False
        if abs(theta[i]) > WIDEST * trial.effects[j].scale:
            return False
    return True


def _group(t: _Treatment, subset: Subset, i: int, gain: float, trial: Trial) -> Subset:
    """Effects that explain the data as well in place of member i, the member first."""
    rated, rest, member = t.rated, subset[:i] + subset[i + 1 :], subset[i]
    others = [c for c in t.candidates if c not in subset]
    if not others:
        return (member,)
    _, gram = scores.unexplained_scores(rated, [*rest, *rated.always], [member, *others])
    cosine = np.abs(gram[0, 1:]) / np.sqrt(np.maximum(gram[0, 0] * np.diagonal(gram)[1:], 1e-300))
    alike = []
    for c, cos in zip(others, cosine, strict=True):
        substitute = tuple(sorted((*rest, c)))
        if (cos > ALIKE or gain - scores.gain(rated, substitute) < TIE) and cos > 0.5:
            theta = scores.solve(rated, (*substitute, *rated.always))[substitute.index(c)]
            if theta >= trial.effects[c].low:
                alike.append((-cos, c))
    return (member, *(c for _, c in sorted(alike)))


@dataclass(frozen=True)
class Settled:
    """A choice of causes and the situation about which it was made."""

    at: Situation
    linear: Linear
    choice: Choice
    noise: Noise
    projected: Projected
    trial: Trial


def search(
    problem: BallProblem,
    trial: Trial,
    at: Situation,
    prior: SpinPrior | None,
    say: Callable[[str], None],
    linear: Linear | None = None,
    scatter: np.ndarray = noise.ALIKE,
) -> Settled:
    """Chooses causes and linearises about them until the choice settles.

    prior: of the spins at the situation to start from, None where nothing spins. linear: the derivatives there.
    scatter: (3,) [m/s] of the bounces from ball to ball, to start from.
    """
    g, bounces, chosen_before = problem.grid, None, None
    say("round 1: derivatives")
    linear = problem.linearise(at) if linear is None else linear
    frame = noise.flight_frame(linear.base.velocity[:, :, 0])
    own_noise = replace(noise.estimate(linear.residual, frame, g), scatter=scatter)
    if np.any(at.start[SPIN]):  # effects that show on spinning balls alone have a size there
        shift, spin_shift = shifts(linear, g, trial.effects)
        trial = replace(trial, shift=shift, spin_shift=spin_shift)
    for round_ in range(ROUNDS):
        if round_:
            say(f"round {round_ + 1}: derivatives")
            linear = problem.linearise(at)
        spins = bool(np.any(at.start[SPIN]))
        say(f"round {round_ + 1}: choosing")
        for _ in range(2 if round_ else 3):
            p = project(linear, at, own_noise, _weights(linear, own_noise, g, bounces), g, problem.coefficient)
            choice = choose(p, replace(trial, spinning=spins), at.theta, prior)
            left, moved = left_over(linear, at, p, choice, g)
            scatter = noise.scattered(moved[KICK], p.kick_gram, scatter)
            own_noise = replace(noise.estimate(left, frame, g, 9 if choice.spin else 6), scatter=scatter)
        theta = np.zeros(len(problem.effects))
        theta[list(choice.effects)] = choice.theta
        theta = np.maximum(theta, [e.low for e in problem.effects])
        if choice.magnus is not None:
            # In flight only k omega shows: a coefficient out of reason is kept within it, the spins take up the rest.
            own = choice.prior is not None and choice.prior.conditional
            theta[problem.coefficient] = np.clip(choice.magnus, *(MAGNUS_RANGE if own else MAGNUS_KEPT))
        settled = chosen_before == (choice.effects, choice.spin) and _close(theta, at.theta, choice)
        chosen_before, prior = (choice.effects, choice.spin), choice.prior
        # The line's best start of a ball of which few samples count can be anywhere.
        near = np.all(np.abs(moved - at.start) < NEAR[:, None], axis=0)
        at, bounces = _move(problem, np.where(near, moved, at.start), theta, choice, own_noise, g)
        if settled:
            break
    if prior is not None and prior.conditional:
        # Elsewhere in theta another valley of a ball's spin may be the deeper one.
        at = replace(at, start=refit_worst(problem, at.theta, at.start, g, own_noise, prior))
    linear = problem.linearise(at)
    p = project(linear, at, own_noise, _weights(linear, own_noise, g, bounces), g, problem.coefficient)
    return Settled(at, linear, refined(choice, p), own_noise, p, trial)


def _close(theta: np.ndarray, before: np.ndarray, choice: Choice) -> bool:
    """True if the chosen effects moved by little of their errors."""
    chosen = list(choice.effects)
    return bool(np.all(np.abs(theta - before)[chosen] <= SETTLED * choice.error))


def _theta(p: Projected, choice: Choice) -> Float[np.ndarray, " K"]:
    """Changes of all effects under a choice."""
    theta = np.zeros(p.gram.shape[1])
    theta[list(choice.effects)] = choice.theta
    if choice.magnus is not None:
        theta[p.coefficient] = choice.magnus
    return theta


def fitted_spins(p: Projected, choice: Choice) -> Float[np.ndarray, "3 n"]:
    """Spin of each ball [rad/s]: its best linear prediction from the flight and from what the balls share."""
    prior = choice.prior
    if prior is None:
        return np.zeros((3, len(p.gram)))
    middle, precision = prior.of_balls(len(p.gram), TINY)
    left = p.spin_right - p.spin_effect @ _theta(p, choice) - np.einsum("nab,bn->na", p.spin_gram, middle)
    return middle + np.linalg.solve(p.spin_gram + precision, left[..., None])[..., 0].T


def left_over(
    linear: Linear, at: Situation, p: Projected, choice: Choice, g: Grid
) -> tuple[Float[np.ndarray, "3 T n"], Float[np.ndarray, "12 n"]]:
    """Residual [m] of the linear model with the chosen effects and the best starts, and these."""
    left = linear.residual - np.tensordot(_theta(p, choice) - at.theta, linear.effects, 1)
    start = at.start.copy()
    start[SPIN] = fitted_spins(p, choice)
    left = left - (linear.starts[SPIN] * (start[SPIN] - at.start[SPIN])[:, None, None]).sum(axis=0)
    own, precision = np.arange(6), np.full(6, 1e-9)
    if p.noise.scatter.any():
        own, precision = np.r_[own, 9:12], np.r_[precision, np.maximum(p.noise.scatter, noise.LEAST_SCATTER) ** -2.0]
    whitening = noise.Whitening(p.noise, g)
    white, target = (whitening.rows(x, p.weight) for x in (linear.starts[own], left[None]))
    known = np.where(own < 6, 0.0, precision)[:, None] * start[own]
    right = (white.swapaxes(1, 2) @ target)[..., 0] - known.T
    nu = np.linalg.solve(white.swapaxes(1, 2) @ white + np.diag(precision), right[..., None])[..., 0]
    start[own] += nu.T
    return np.where(g.mask, left - (linear.starts[own] * nu.T[:, None, None]).sum(axis=0), 0.0), start


def _move(
    problem: BallProblem, start: np.ndarray, theta: np.ndarray, choice: Choice, noise_now: Noise, g: Grid
) -> tuple[Situation, np.ndarray | None]:
    """Situation at the chosen causes, starts fitted again; and where balls spin, the time of each one's own bounce."""
    if choice.prior is None:
        return Situation(theta, fit_starts(problem, theta, start, g, noise_now, rounds=3)), None
    start = fit_starts(problem, theta, start, g, noise_now, choice.prior, rounds=5)
    if choice.prior.conditional:
        return Situation(theta, start), None
    bounces = problem.fly(theta, start).bounce_time[0]
    # About the mean spin, not about each ball's own: that is fitted to its noise, and derivatives taken there would
    # remember it (the first-order method of mixed models against its conditional form).
    start[SPIN] = choice.prior.mean[:, None]
    return Situation(theta, start), bounces


def _weights(linear: Linear, noise_now: Noise, g: Grid, bounces: np.ndarray | None) -> np.ndarray:
    """Square roots (n, T) of the samples' weights; none between the bounce of the mean spin and that of a ball's own.

    There a straight line in the spin leads astray: the flight has a corner, and it has moved past the sample.
    """
    weight = noise.robust_weights(linear.residual, noise_now, g)
    if bounces is None:
        return weight
    ends = np.sort([linear.base.bounce_time[0], bounces], axis=0)
    with np.errstate(invalid="ignore"):
        astray = (g.time > ends[0] - CORNER) & (g.time < ends[1] + CORNER)
    return np.where(astray, 0.0, weight.T).T
