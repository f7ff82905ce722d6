"""The ball's side of a diagnosis: from measured flights to causes, blocks and what the data cannot tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball import noise, selection, time_jitter
from mjx_tt.diagnosis.ball.effects import AT_THE_PADDLE, EFFECTS
from mjx_tt.diagnosis.ball.forward_model import Grid, grid, picked
from mjx_tt.diagnosis.ball.linearization import (
    SPIN,
    BallProblem,
    Linear,
    Projected,
    Situation,
    fit_starts,
    project,
    rows,
)
from mjx_tt.diagnosis.ball.scores import SpinPrior
from mjx_tt.diagnosis.ball.selection import Choice, Trial
from mjx_tt.diagnosis.ball.unexplained import Finding, unexplained
from mjx_tt.diagnosis.logs import before_racket
from mjx_tt.sim.model import SimModel

FEWEST_SAMPLES = 15  # of a flight
FEWEST_BALLS = 12
WINDOWS = (0.1, 0.2, 0.3, 0.4)  # [s] of a flight that the first fit takes in turn
ROUNDS = 4  # of choosing and linearising again
SETTLED = 0.2  # of an estimate's error by which it may still have moved in the last round
MAGNUS_KEPT = (0.2, 1.5)  # of the coefficient k about which derivatives are taken
# Coefficient k and mean spin [rad/s] (topspin, gyro, side) to start from where balls may spin fast. In flight only their
# product shows, at the bounce the spin alone.
FAST_SPINS = tuple(
    (k, tuple(sign * w * (a == axis) for a in range(3)))
    for k, w in ((0.6, 100.0), (0.3, 200.0))
    for axis in (0, 2)
    for sign in (1.0, -1.0)
)
FAST_STD = np.full(3, 80.0)  # [rad/s] how far a ball's own spin may then be from it
FEW = 24  # balls on which the spins are tried
CORNER = 5e-4  # [s] about the bounce of a spinning ball in which no sample counts
SPIN_COST = 3.0  # squared error by which three more numbers of a ball must pay at least


@dataclass(frozen=True)
class BallFindings:
    """What a set of flights says."""

    problem: BallProblem
    situation: Situation
    linear: Linear
    choice: Choice
    trial: Trial
    noise: noise.Noise
    projected: Projected
    findings: tuple[Finding, ...]
    survivors: tuple[str, ...]  # names that hold beside what is unexplained; all of them where nothing is
    start0: np.ndarray  # (9, n) starts under the nominal model
    residual0: np.ndarray  # (3, T, n) [m] under the nominal model
    trajectories: tuple[Trajectory, ...]
    sessions: np.ndarray
    age: np.ndarray
    seen: np.ndarray  # (K,) bool: the data could show the effect, and it was not left out
    imitated: tuple[str, ...]  # effects that were left out, each of which would replace two of the causes


def flights(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Flights free of rackets, of enough samples."""
    cut = (before_racket(t) for t in trajectories if len(t) >= FEWEST_SAMPLES)
    return [t for t in cut if len(t) >= FEWEST_SAMPLES]


def first_fit(
    problem: BallProblem,
    theta: np.ndarray | None = None,
    spin: np.ndarray | None = None,
    part: np.ndarray | None = None,
) -> np.ndarray:
    """(9, n) starts: a parabola through the first samples, then ever longer parts of the flight.

    A flight that bounces has other minima for a start that is far off; growing windows keep the bounce where it is.
    theta: (K,) or (K, n) changes of the effects, none by default. spin: (3,) or (3, n) [rad/s] of the balls, in their own
    axes. part: (T, n) samples that count.
    """
    g = problem.grid if part is None else replace(problem.grid, mask=problem.grid.mask & part)
    theta = np.zeros(len(problem.effects)) if theta is None else theta
    early = g.mask & (g.time <= WINDOWS[0])
    early[:8] |= g.mask[:8]
    start = np.zeros((9, g.n))
    for i in range(g.n):
        time, place = g.time[early[:, i], i], g.measured[:, early[:, i], i]
        fall = np.array([0.0, 0.0, -4.9])[:, None] * time**2
        line = np.polynomial.polynomial.polyfit(time, (place - fall).T, 1)
        start[:3, i], start[3:6, i] = line
    if spin is not None:
        start[SPIN] = spin[:, None] if spin.ndim == 1 else spin
    for window in WINDOWS:
        keep = (g.time <= window) | (np.arange(len(g.time)) < 8)[:, None]
        start = fit_starts(problem, theta, start, g, rounds=2, keep=keep)
    return fit_starts(problem, theta, start, g, rounds=4)


def diagnose_balls(
    trajectories: Sequence[Trajectory],
    model: SimModel,
    spin: str = "none",
    without: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> BallFindings:
    """``_diagnose``, and once more without the samples around the bounce where the time stamps prove to be shaky.

    A jitter of the time stamps rounds the corner of the bounce as a tracker's filter does.
    """
    found = _diagnose(trajectories, model, spin, without, seed, progress)
    if "latency_jitter" in without:
        return found
    shaken = shaking(found)
    if shaken is None:
        return found
    (progress or (lambda text: None))(
        f"time stamps shake by {1e3 * shaken.seconds:.1f} ms: once more without the bounce's samples"
    )
    near = np.abs(found.problem.grid.time - found.linear.base.bounce_time[0]) < 3.0 * shaken.seconds
    return _diagnose(trajectories, model, spin, without, seed, progress, near, found)


def _diagnose(
    trajectories: Sequence[Trajectory],
    model: SimModel,
    spin: str,
    without: Sequence[str],
    seed: int,
    progress: Callable[[str], None] | None,
    hidden: np.ndarray | None = None,
    before: BallFindings | None = None,
) -> BallFindings:
    """Chooses the causes.

    spin: "none" when the nominal ball does not spin, so that spin is a cause; "free" when every ball may.
    without: effects to leave out of the catalogue. hidden: (T, n) samples that do not count. before: what was found with
    them, whose spins are where the search starts. Raises ValueError when there are too few flights.
    """
    say = progress or (lambda text: None)
    kept = flights(trajectories)
    if len(kept) < FEWEST_BALLS:
        raise ValueError(
            f"{len(kept)} usable flights of {len(trajectories)} (at least {FEWEST_SAMPLES} samples each), at least "
            f"{FEWEST_BALLS} are needed: what the balls share cannot be told from what each does"
        )
    gone = set(without)
    if "magnus" in gone and model.ball.flight.magnus_coefficient == 0.0:
        gone |= {"magnus_coefficient", "spin_decay"}  # without the force the nominal model has no use for either
    fitted = tuple(e for e in EFFECTS if e.fit and e.group != AT_THE_PADDLE and not (e.needs_spin and e.name in gone))
    left_out = tuple(i for i, e in enumerate(fitted) if e.gone(gone))
    mode = "never" if spin == "none" and "magnus" in gone else spin
    names = list(dict.fromkeys(t.session for t in kept))
    sessions = np.array([names.index(t.session) for t in kept])
    age = np.zeros(len(kept))
    for s in range(len(names)):
        own = np.flatnonzero(sessions == s)
        age[own] = np.arange(len(own)) / max(len(own) - 1, 1)
    g = grid(kept)
    if hidden is not None:
        g = replace(g, mask=g.mask & ~hidden)
    problem = BallProblem(g, model, fitted, heading(g))
    say(f"fitting {g.n} flights under the nominal model")
    start = first_fit(problem)
    nominal = Situation(np.zeros(len(fitted)), start)
    linear = problem.linearise(nominal)
    trial = Trial(fitted, *_shifts(linear, g), mode, seed, left_out=left_out)

    def judged(settled: Settled):
        return unexplained(
            settled.linear, settled.at, settled.projected, settled.choice, settled.trial, g, sessions, age, names
        )

    if before is not None and before.choice.spin:
        best = search(problem, trial, before.situation, before.choice.prior, say)
    else:
        best = search(problem, trial, nominal, None, say, linear)
    say("looking for what no entry explains")
    findings, survivors = judged(best)
    if mode == "none" and (findings or _bent(best.choice)):
        # Strong spin is out of reach of derivatives taken about balls that do not spin.
        say("trying balls that spin fast")
        other = search(problem, trial, *spinning(problem, start), say)
        if other.choice.spin and _misfit(other, g) < _misfit(best, g):
            best = other
            findings, survivors = judged(best)
    std = None if best.choice.prior is None else best.choice.prior.std
    seen = selection.visible(best.projected, best.trial, best.choice.spin, std)
    seen[list(left_out)] = False
    return BallFindings(
        problem,
        best.at,
        best.linear,
        best.choice,
        best.trial,
        best.noise,
        best.projected,
        findings,
        survivors,
        start,
        linear.residual,
        tuple(kept),
        sessions,
        age,
        seen,
        selection.imitated(best.projected, best.trial, best.choice),
    )


@dataclass(frozen=True)
class Settled:
    """A choice of causes and the situation about which it was made."""

    at: Situation
    linear: Linear
    choice: Choice
    noise: noise.Noise
    projected: Projected
    trial: Trial


def search(
    problem: BallProblem,
    trial: Trial,
    at: Situation,
    prior: SpinPrior | None,
    say: Callable[[str], None],
    linear: Linear | None = None,
) -> Settled:
    """Chooses causes and linearises about them until the choice settles.

    prior: of the spins at the situation to start from, None where nothing spins. linear: the derivatives there.
    """
    g, own_noise, chosen_before, frame, bounces = problem.grid, None, None, None, None
    for round_ in range(ROUNDS):
        say(f"round {round_ + 1}: derivatives")
        linear = problem.linearise(at) if linear is None else linear
        spins = bool(np.any(at.start[SPIN]))
        if frame is None:
            frame = noise.flight_frame(linear.base.velocity[:, :, 0])
            if spins:  # effects that show on spinning balls alone have a size there
                trial = replace(trial, **dict(zip(("shift", "spin_shift"), _shifts(linear, g))))
        say(f"round {round_ + 1}: choosing")
        for _ in range(2 if own_noise is not None else 3):
            noise_now = own_noise or noise.estimate(linear.residual, frame, g)
            p = project(linear, at, noise_now, _weights(linear, noise_now, g, bounces), g, problem.coefficient)
            choice = selection.choose(p, replace(trial, spinning=spins), prior)
            left, moved = _left(linear, at, p, choice, g)
            own_noise = noise.estimate(left, frame, g, 9 if choice.spin else 6)
        theta = np.zeros(len(problem.effects))
        theta[list(choice.effects)] = choice.theta
        if choice.magnus is not None:
            # In flight only k omega shows: a coefficient out of reason is kept within it, the spins take up the rest.
            theta[problem.coefficient] = np.clip(choice.magnus, *MAGNUS_KEPT)
        settled = chosen_before == (choice.effects, choice.spin) and _close(theta, at.theta, choice)
        chosen_before, prior = (choice.effects, choice.spin), choice.prior
        (at, bounces), linear = _move(problem, moved, theta, choice, own_noise, g), None
        if settled:
            break
    linear = problem.linearise(at)
    p = project(linear, at, own_noise, _weights(linear, own_noise, g, bounces), g, problem.coefficient)
    return Settled(at, linear, selection.refined(choice, p), own_noise, p, trial)


def spinning(problem: BallProblem, start: np.ndarray) -> tuple[Situation, SpinPrior]:
    """Situation and prior about the fast spin, common to all balls, under which the flights fit best.

    From a few spins either way of topspin and sidespin, each with starts of its own, on some of the balls.
    """
    g = problem.grid
    few = np.linspace(0, g.n - 1, min(g.n, FEW)).astype(int)
    count = len(FAST_SPINS)
    many = picked(g, np.tile(few, count))
    tried = BallProblem(many, problem.model, problem.effects, heading(many))
    theta = np.zeros((len(problem.effects), many.n))
    theta[problem.coefficient] = np.repeat([k for k, _ in FAST_SPINS], len(few))
    spin = np.repeat(np.array([w for _, w in FAST_SPINS], float).T, len(few), axis=1)
    fitted = first_fit(tried, theta, spin)
    left = many.measured - tried.fly(theta, fitted).measured[:, :, 0]
    cost = np.sqrt(np.where(many.mask, (left**2).sum(axis=0), 0.0).sum(axis=0) / many.mask.sum(axis=0))
    best = int(np.argmin(np.median(cost.reshape(count, -1), axis=1)))
    k, mean = FAST_SPINS[best]
    theta, mean = np.zeros(len(problem.effects)), np.array(mean, float)
    theta[problem.coefficient] = k
    start = first_fit(problem, theta, mean)
    for _ in range(3):
        frame = noise.flight_frame(problem.fly(theta, start).velocity[:, :, 0])
        left = np.where(g.mask, g.measured - problem.fly(theta, start).measured[:, :, 0], 0.0)
        start = fit_starts(problem, theta, start, g, noise.estimate(left, frame, g, 9), (mean, FAST_STD), rounds=3)
        mean = np.median(start[SPIN], axis=1)
    std = np.clip(1.4826 * np.median(np.abs(start[SPIN] - mean[:, None]), axis=1), 1.0, FAST_STD)
    start[SPIN] = mean[:, None]
    return Situation(theta, start), SpinPrior(mean, std)


def _bent(choice: Choice) -> bool:
    """Whether spin was chosen with a Magnus coefficient that no ball has: a line bent too far."""
    return choice.magnus is not None and not MAGNUS_KEPT[0] <= choice.magnus <= MAGNUS_KEPT[1]


def _misfit(settled: Settled, g: Grid) -> float:
    """Twice the negative log likelihood of what a choice leaves under the noise that it leaves, and its price.

    Each sample's whitened error is bounded: mis-tracked ones decide nothing.
    """
    n, p, choice = settled.noise, settled.projected, settled.choice
    left = _left(settled.linear, settled.at, p, choice, g)[0]
    counts = g.mask & (p.weight.T > 0.0)
    error = np.minimum((noise.whiten(left, n, g) ** 2).sum(axis=0), 3.0 * noise.HUBER**2)
    spread = 2.0 * np.log(n.scale * np.sqrt(1.0 - n.memory[:, None] ** 2)).sum(axis=0)
    own = SPIN_COST * g.n if choice.spin else 0.0
    # As if the samples left out were as usual: to leave out must not pay.
    share = g.mask.sum() / counts.sum()
    return float(share * np.where(counts, error + spread, 0.0).sum() + own + choice.threshold * len(choice.effects))


def _last(g: Grid) -> np.ndarray:
    """(n,) index of each ball's last sample."""
    return len(g.mask) - 1 - np.argmax(g.mask[::-1], axis=0)


def heading(g: Grid) -> np.ndarray:
    """(3, n) way of each ball over its first samples."""
    k = np.minimum(_last(g), 8)
    return g.measured[:, k, np.arange(g.n)] - g.measured[:, 0]


def _close(theta: np.ndarray, before: np.ndarray, choice: Choice) -> bool:
    """Whether the chosen effects moved by little of their errors."""
    chosen = list(choice.effects)
    return bool(np.all(np.abs(theta - before)[chosen] <= SETTLED * choice.error))


def _shifts(linear: Linear, g: Grid) -> tuple[np.ndarray, float]:
    """Median shift [m] of the last sample of the balls concerned, per unit of each effect and per rad/s of spin.

    Against a nominal flight from the same measured start: what the effect does to the first samples is carried along.
    """
    last = _last(g)
    balls = np.arange(g.n)
    dt = np.maximum(g.time[2] - g.time[0], 1e-9)
    early = np.concatenate([linear.effects[:, :, 0], (linear.effects[:, :, 2] - linear.effects[:, :, 0]) / dt], axis=1)
    carried = np.einsum("kjn,jcn->kcn", early, linear.starts[:6][:, :, last, balls])
    end = linear.effects[:, :, last, balls] - carried
    spin = linear.starts[SPIN][:, :, last, balls]
    size = np.linalg.norm(end, axis=1)
    concerned = [s[s > 1e-3 * s.max()] for s in size]
    return np.array([np.median(s) if s.size else 0.0 for s in concerned]), float(
        np.median(np.linalg.norm(spin, axis=1))
    )


def shaking(found: BallFindings) -> time_jitter.Jitter | None:
    """Deviation of the time stamps in what the chosen causes leave, from the samples that count."""
    g = found.problem.grid
    g = replace(g, mask=g.mask & (found.projected.weight.T > 0.0))
    return time_jitter.find(left_over(found), found.linear.base.velocity[:, :, 0], g)


def left_over(found: BallFindings) -> np.ndarray:
    """(3, T, n) [m] what the chosen causes and each ball's own start leave."""
    return _left(found.linear, found.situation, found.projected, found.choice, found.problem.grid)[0]


def _theta(p: Projected, choice: Choice, size: int) -> np.ndarray:
    """(K,) changes of all effects under a choice."""
    theta = np.zeros(size)
    theta[list(choice.effects)] = choice.theta
    if choice.magnus is not None:
        theta[p.coefficient] = choice.magnus
    return theta


def _left(linear: Linear, at: Situation, p: Projected, choice: Choice, g: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Residual (3, T, n) [m] of the linear model with the chosen effects and the best starts, and these, (9, n)."""
    theta = _theta(p, choice, len(at.theta))
    left = linear.residual - np.tensordot(theta - at.theta, linear.effects, 1)
    start = at.start.copy()
    start[SPIN] = 0.0
    if choice.spin:
        full = p.spin_right - p.spin_effect @ theta - p.spin_gram @ choice.prior.mean
        inner = p.spin_gram + np.diag(1.0 / np.maximum(choice.prior.std, 1e-3) ** 2)
        start[SPIN] = choice.prior.mean[:, None] + np.linalg.solve(inner, full[..., None])[..., 0].T
    left = left - (linear.starts[SPIN] * (start[SPIN] - at.start[SPIN])[:, None, None]).sum(axis=0)
    white = rows(linear.starts[:6], p.noise, p.weight, g)
    target = rows(left[None], p.noise, p.weight, g)
    nu = np.linalg.solve(white.swapaxes(1, 2) @ white + 1e-9 * np.eye(6), white.swapaxes(1, 2) @ target)[..., 0]
    start[:6] += nu.T
    return np.where(g.mask, left - (linear.starts[:6] * nu.T[:, None, None]).sum(axis=0), 0.0), start


def _move(
    problem: BallProblem, start: np.ndarray, theta: np.ndarray, choice: Choice, noise_now: noise.Noise, g: Grid
) -> tuple[Situation, np.ndarray | None]:
    """The situation at the chosen causes, starts fitted again; and where balls spin, when each bounces (n,) by its own."""
    if not choice.spin:
        return Situation(theta, fit_starts(problem, theta, start, g, noise_now, rounds=3)), None
    prior = (choice.prior.mean, np.maximum(choice.prior.std, 1.0))
    start = fit_starts(problem, theta, start, g, noise_now, prior, rounds=3)
    bounces = problem.fly(theta, start).bounce_time[0]
    # About the mean spin, not about each ball's own: that is fitted to its noise, and derivatives taken there would
    # remember it (the first-order method of mixed models against its conditional form).
    start[SPIN] = choice.prior.mean[:, None]
    return Situation(theta, start), bounces


def _weights(linear: Linear, noise_now: noise.Noise, g: Grid, bounces: np.ndarray | None) -> np.ndarray:
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
