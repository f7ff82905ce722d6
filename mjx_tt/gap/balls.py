"""The ball's side of a diagnosis: from measured flights to causes, blocks and what the data cannot tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from ballmodel.trajectory import Trajectory
from mjx_tt.gap import blocks, evidence, jitter, noise, select
from mjx_tt.gap.catalogue import AT_THE_PADDLE, EFFECTS
from mjx_tt.gap.dataset import before_racket
from mjx_tt.gap.linear import SPIN, BallProblem, Linear, Projected, Situation, fit_starts, project, rows
from mjx_tt.gap.predict import Grid, grid
from mjx_tt.gap.select import Choice, Trial
from mjx_tt.model import SimModel

FEWEST_SAMPLES = 15  # of a flight
FEWEST_BALLS = 12
WINDOWS = (0.1, 0.2, 0.3, 0.4)  # [s] of a flight that the first fit takes in turn
ROUNDS = 4  # of choosing and linearising again
BLOCK_LEVEL = 2e-5  # chance of one block's false alarm
BLOCK_FLOOR = 0.0025  # [m] shift that a block must cause on the balls it concerns
VISIBLE_FLOOR = 2e-4  # [m] rms of what of it no other start of the ball could imitate, on one ball in twenty
ODD_LEVEL = 1e-5  # chance with which one ball is called odd
ODD_SHARE = 0.01  # of the balls that may be odd (mis-tracked) before they are a finding


@dataclass(frozen=True)
class Finding:
    """A block that stays significant."""

    block: str
    where: str
    direction: str
    size: float  # [m]
    p_value: float
    gain: float  # squared error that it explains


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
    theta: (K,) changes of the effects, none by default. spin: (3,) [rad/s] of every ball, in its own axes. part: (T, n)
    samples that count.
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
        start[SPIN] = spin[:, None]
    for window in WINDOWS:
        keep = (g.time <= window) | (np.arange(len(g.time)) < 8)[:, None]
        start = fit_starts(problem, theta, start, g, rounds=2, keep=keep)
    return fit_starts(problem, theta, start, g, rounds=4)


def diagnose_balls(
    trajectories: Sequence[Trajectory], model: SimModel, spin: str = "none", without: Sequence[str] = (), seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> BallFindings:  # fmt: skip
    """``_diagnose``, and once more without the samples around the bounce where the time stamps prove to be shaky.

    A jitter of the time stamps rounds the corner of the bounce as a tracker's filter does.
    """
    found = _diagnose(trajectories, model, spin, without, seed, progress, None)
    if "latency_jitter" in without:
        return found
    shaken = jitter.find(left_over(found), found.linear.base.velocity[:, :, 0], found.problem.grid)
    if shaken is None:
        return found
    (progress or (lambda text: None))(
        f"time stamps shake by {1e3 * shaken.seconds:.1f} ms: once more without the bounce's samples"
    )
    near = np.abs(found.problem.grid.time - found.linear.base.bounce_time[0]) < 3.0 * shaken.seconds
    return _diagnose(trajectories, model, spin, without, seed, progress, near)


def _diagnose(
    trajectories: Sequence[Trajectory], model: SimModel, spin: str, without: Sequence[str], seed: int,
    progress: Callable[[str], None] | None, hidden: np.ndarray | None,
) -> BallFindings:  # fmt: skip
    """Chooses the causes.

    spin: "none" when the nominal ball does not spin, so that spin is a cause; "free" when every ball may.
    without: effects to leave out of the catalogue. Raises ValueError when there are too few flights.
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
    left_out = tuple(i for i, e in enumerate(fitted) if e.name in gone)
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
    zero = np.zeros(len(fitted))
    say(f"fitting {g.n} flights under the nominal model")
    start = first_fit(problem)
    at = Situation(zero, start)
    start0, residual0, trial, frame, chosen_before, hint = start, None, None, None, None, None
    own_noise = None
    for round_ in range(ROUNDS):
        say(f"round {round_ + 1}: derivatives")
        linear = problem.linearise(at)
        if trial is None:
            residual0 = linear.residual
            trial = Trial(fitted, *_shifts(linear, g), mode, seed, left_out=left_out)
            frame = noise.flight_frame(linear.base.velocity[:, :, 0])
        say(f"round {round_ + 1}: choosing")
        for _ in range(2 if own_noise is not None else 3):
            noise_now = own_noise or noise.estimate(linear.residual, frame, g)
            weight = noise.robust_weights(linear.residual, noise_now, g)
            p = project(linear, at, noise_now, weight, g, problem.coefficient)
            choice = select.choose(p, replace(trial, spinning=bool(np.any(at.start[SPIN]))), hint)
            left, moved = _left(linear, at, p, choice, g)
            own_noise = noise.estimate(left, frame, g, 9 if choice.spin else 6)
        theta = np.zeros(len(fitted))
        theta[list(choice.effects)] = choice.theta
        if choice.magnus is not None:
            # In flight only k omega shows: a coefficient out of reason is kept within it, the spins take up the rest.
            theta[problem.coefficient] = np.clip(choice.magnus, 0.2, 1.5)
        settled = chosen_before == (choice.effects, choice.spin) and _close(theta, at.theta, trial)
        chosen_before, hint = (choice.effects, choice.spin), choice.prior
        at = _move(problem, moved, theta, choice, own_noise, g)
        if settled:
            break
    linear = problem.linearise(at)
    weight = noise.robust_weights(linear.residual, own_noise, g)
    p = project(linear, at, own_noise, weight, g, problem.coefficient)
    say("looking for what no entry explains")
    findings, survivors = unexplained(linear, at, p, choice, trial, g, sessions, age, names)
    std = None if choice.prior is None else choice.prior.std
    seen = select.visible(p, trial, choice.spin, std)
    seen[list(left_out)] = False
    imitated = select.imitated(p, trial, choice)
    return BallFindings(
        problem,
        at,
        linear,
        choice,
        trial,
        own_noise,
        p,
        findings,
        survivors,
        start0,
        residual0,
        tuple(kept),
        sessions,
        age,
        seen,
        imitated,
    )


def _last(g: Grid) -> np.ndarray:
    """(n,) index of each ball's last sample."""
    return len(g.mask) - 1 - np.argmax(g.mask[::-1], axis=0)


def heading(g: Grid) -> np.ndarray:
    """(3, n) way of each ball over its first samples."""
    k = np.minimum(_last(g), 8)
    return g.measured[:, k, np.arange(g.n)] - g.measured[:, 0]


def _close(a: np.ndarray, b: np.ndarray, trial: Trial) -> bool:
    return bool(np.all(np.abs(a - b) * trial.shift < 1e-4))


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
    left = linear.residual - np.einsum("kctn,k->ctn", linear.effects, theta - at.theta)
    start = at.start.copy()
    start[SPIN] = 0.0
    if choice.spin:
        full = p.spin_right - p.spin_effect @ theta - p.spin_gram @ choice.prior.mean
        inner = p.spin_gram + np.diag(1.0 / np.maximum(choice.prior.std, 1e-3) ** 2)
        start[SPIN] = choice.prior.mean[:, None] + np.linalg.solve(inner, full[..., None])[..., 0].T
    left = left - np.einsum("kctn,kn->ctn", linear.starts[SPIN], start[SPIN] - at.start[SPIN])
    white = rows(linear.starts[:6], p.noise, p.weight, g)
    target = rows(left[None], p.noise, p.weight, g)
    nu = np.linalg.solve(white.swapaxes(1, 2) @ white + 1e-9 * np.eye(6), white.swapaxes(1, 2) @ target)[..., 0]
    start[:6] += nu.T
    return np.where(g.mask, left - np.einsum("kctn,nk->ctn", linear.starts[:6], nu), 0.0), start


def _move(problem, start, theta, choice: Choice, noise_now, g: Grid) -> Situation:
    """The situation at the chosen causes, starts fitted again."""
    if not choice.spin:
        return Situation(theta, fit_starts(problem, theta, start, g, noise_now, rounds=3))
    prior = (choice.prior.mean, np.maximum(choice.prior.std, 1.0))
    start = fit_starts(problem, theta, start, g, noise_now, prior, rounds=3)
    # About the mean spin, not about each ball's own: that is fitted to its noise, and derivatives taken there would
    # remember it (the first-order method of mixed models against its conditional form).
    start[SPIN] = choice.prior.mean[:, None]
    return Situation(theta, start)


def unexplained(
    linear: Linear,
    at: Situation,
    p: Projected,
    choice: Choice,
    trial: Trial,
    g: Grid,
    sessions: np.ndarray,
    age: np.ndarray,
    called: Sequence[str],
) -> tuple[tuple[Finding, ...], tuple[str, ...]]:
    """Blocks that stay significant beside the chosen causes, the most important first; names that hold beside it."""
    out, holding = [], []
    chosen = list(choice.effects)
    if choice.magnus is not None:
        chosen.append(p.coefficient)
    effects = linear.effects[chosen]
    for block in blocks.build(linear, g, sessions, age, called):
        columns = np.concatenate([effects, block.columns])
        both = _with_columns(linear, at, p, columns, g)
        scores = evidence.with_spin(both, choice.prior.std) if choice.spin else evidence.without_spin(both)
        extra = list(range(len(chosen), len(columns)))
        base = [*range(len(chosen)), *scores.always]
        # The chosen effects' own values are in the situation: what is left is scored at it.
        own, gram = evidence.unexplained_scores(scores, base, extra)
        p_value, beta = _joint_test(own, gram)
        if p_value > BLOCK_LEVEL:
            continue
        pattern = np.einsum("kctn,k->ctn", block.columns, beta)
        worst = np.linalg.norm(np.where(g.mask, pattern, 0.0), axis=0).max(axis=0)
        size = float(np.percentile(worst, 90))
        if size < BLOCK_FLOOR or _visible(scores.ball_gram[:, extra][:, :, extra], beta, p, g) < VISIBLE_FLOOR:
            continue
        axis = int(
            np.argmax([np.percentile(np.abs(np.where(g.mask, pattern[a], 0.0)).max(axis=0), 90) for a in range(3)])
        )
        importance = np.abs(beta) * np.sqrt(np.maximum(np.diagonal(gram), 0.0))
        best = int(np.argmax(importance))
        change = evidence.solve(scores, (*base, *extra))[: len(chosen)]
        error = np.sqrt(np.diagonal(evidence.sandwich(scores, (*base, *extra))))[: len(chosen)]
        holding.append(_holding(choice, trial, change, error))
        out.append(
            Finding(
                block.name,
                block.labels[best],
                block.directions[best] or "xyz"[axis],
                size,
                p_value,
                _explained(own, gram),
            )
        )
    odd = _odd_balls(linear, at, p, choice, g)
    if odd is not None:
        out.append(odd)
        holding.append({trial.effects[j].name for j in choice.effects})
    if not out:
        return (), tuple(e.name for e in trial.effects) + ("magnus", "latency_jitter")
    order = np.argsort([-f.gain for f in out])
    return tuple(out[i] for i in order), tuple(holding[order[0]])


def _holding(choice: Choice, trial: Trial, change: np.ndarray, error: np.ndarray) -> set[str]:
    """Chosen effects that keep at least half of their size, and significance, when a block may take over from them."""
    names = set()
    for j, before, moved, e in zip(choice.effects, choice.theta, change, error):
        now = before + moved
        if abs(now) > select.LEAST_Z * e and 0.5 < now / before < 2.0:
            names.add(trial.effects[j].name)
    return names


def _with_columns(linear: Linear, at: Situation, p: Projected, columns: np.ndarray, g: Grid) -> Projected:
    """The projected problem with other columns, its target the residual at the situation (spins kept absolute)."""
    other = replace(linear, effects=columns)
    return project(other, Situation(np.zeros(len(columns)), at.start), p.noise, p.weight, g)


def _joint_test(own: np.ndarray, gram: np.ndarray) -> tuple[float, np.ndarray]:
    """Chance that scores (n, E) have mean zero, by Hotelling's T^2 over the balls, and the fitted coefficients."""
    scale = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    useful = np.flatnonzero(scale > 1e-6 * scale.max())
    beta = np.zeros(len(scale))
    values, vectors = np.linalg.eigh(gram[np.ix_(useful, useful)] / scale[useful, None] / scale[useful])
    keep = values > 1e-3 * values.max()
    u = (own[:, useful] / scale[useful]) @ vectors[:, keep] / np.sqrt(values[keep])
    n, e = u.shape
    if n <= e + 5:
        return 1.0, beta
    mean = u.mean(axis=0)
    t2 = n * mean @ np.linalg.lstsq(np.cov(u.T).reshape(e, e), mean, rcond=1e-9)[0]
    beta[useful] = vectors[:, keep] @ (u.sum(axis=0) / np.sqrt(values[keep])) / scale[useful]
    return float(f_distribution.sf(t2 * (n - e) / (e * (n - 1)), e, n - e)), beta


def _visible(gram: np.ndarray, beta: np.ndarray, p: Projected, g: Grid) -> float:
    """Size [m], rms over a flight, of a pattern beyond what its ball's start explains: the 95th percentile of the balls."""
    energy = np.einsum("i,nij,j->n", beta, gram, beta) / (3.0 * g.mask.sum(axis=0))
    memory = float(p.noise.memory.mean())
    # Slow patterns lose this factor when noise that remembers itself is whitened.
    scale = np.median(p.noise.scale) * np.sqrt((1.0 + memory) / (1.0 - memory))
    return float(np.percentile(np.sqrt(np.maximum(energy, 0.0)), 95) * scale)


def _explained(own: np.ndarray, gram: np.ndarray) -> float:
    total = own.sum(axis=0)
    return float(total @ np.linalg.lstsq(gram, total, rcond=1e-6)[0])


def _odd_balls(linear: Linear, at: Situation, p: Projected, choice: Choice, g: Grid) -> Finding | None:
    """Balls of their own kind: a smooth misfit that the others do not have."""
    t = g.time / np.maximum(g.time.max(axis=0), 1e-9) * 2.0 - 1.0
    columns = []
    for poly in (
        t**2,
        t**3,
        np.where(
            g.time > linear.base.bounce_time[0],
            g.time - np.where(np.isfinite(linear.base.bounce_time[0]), linear.base.bounce_time[0], 0.0),
            0.0,
        ),
    ):
        for a in range(3):
            column = np.zeros((3, *t.shape))
            column[a] = poly
            columns.append(column)
    both = _with_columns(linear, at, p, np.stack(columns), g)
    gram, right = both.gram, both.right
    if choice.spin:
        inner = both.spin_gram + np.diag(1.0 / np.maximum(choice.prior.std, 1e-3) ** 2)
        left = both.spin_right - both.spin_gram @ choice.prior.mean
        gram = gram - both.spin_effect.swapaxes(1, 2) @ np.linalg.solve(inner, both.spin_effect)
        mean = both.spin_effect.swapaxes(1, 2) @ choice.prior.mean
        right = right - mean - (both.spin_effect.swapaxes(1, 2) @ np.linalg.solve(inner, left[..., None]))[..., 0]
    scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-300))
    unit = gram / scale[:, :, None] / scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    keep = values > 1e-3
    u = np.einsum("nij,ni->nj", vectors, right / scale) / np.sqrt(np.maximum(values, 1e-12))
    q, freedom = (np.where(keep, u, 0.0) ** 2).sum(axis=1), np.maximum(keep.sum(axis=1), 1)
    inflation = max(float(np.median(q / chi2.ppf(0.5, freedom))), 1.0)
    odd = q / inflation > chi2.isf(ODD_LEVEL, freedom)
    if odd.sum() < max(3, ODD_SHARE * g.n):
        return None
    beta = np.einsum("nij,nj->ni", vectors, np.where(keep, u / np.sqrt(np.maximum(values, 1e-12)), 0.0)) / scale
    pattern = np.einsum("kctn,nk->ctn", np.stack(columns), beta)
    per_axis = np.abs(np.where(g.mask, pattern, 0.0)).max(axis=1)[:, odd]
    size = float(np.median(np.linalg.norm(pattern, axis=0).max(axis=0)[odd]))
    if size < BLOCK_FLOOR:
        return None
    axis = "xyz"[int(np.argmax(np.median(per_axis, axis=1)))]
    return Finding(
        "a subset of the balls",
        f"{int(odd.sum())} of {g.n} balls",
        axis,
        size,
        ODD_LEVEL,
        float(q[odd].sum() / inflation),
    )
