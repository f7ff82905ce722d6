"""Diagnosis of the robot's hits: the measured return against the one that the model plays from the same ball.

A hit scatters: where on the rubber, an encoder's tick, a millisecond. So hits are judged in a second step, with the
ball's own
causes settled: each gives one difference of place and one of velocity behind the paddle, and the spread from hit to hit
is the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtr

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.causes import estimates, quantile, readings
from mjx_tt.diagnosis.ball.diagnose import BallFindings, flights
from mjx_tt.diagnosis.ball.effects import EFFECTS, INVISIBLE, Effect
from mjx_tt.diagnosis.ball.flights.fit import first_fit, heading
from mjx_tt.diagnosis.ball.flights.forward_model import Grid, grid, predict
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem
from mjx_tt.diagnosis.hits.paddle_path import JointPath, poses, watched
from mjx_tt.diagnosis.inclusion import LinearModel, Set
from mjx_tt.diagnosis.robust import deviation, huber_weights
from mjx_tt.diagnosis.verdict import Cause, Expressed, Part

FEWEST_HITS = 12
RETURN = 0.25  # [s] of each return that are used
FARTHEST = 0.15  # [m] between measured and predicted return at the hit beyond which the model's blade missed the ball
GAIN = 16.0  # squared errors of a size that matters, for hits to show an effect at all
SPIKE = 1e-2  # of its usual size, that an effect which is not chosen may have
LEAST_SHIFT = 0.010  # [m] of the return RETURN after the hit, below which an effect is of no interest
ROUNDS = 3
HUBER = 3.5  # deviations of a hit, in six numbers, beyond which it counts less


@dataclass(frozen=True)
class HitCause:
    """One effect at the paddle."""

    effect: Effect
    rivals: tuple[Effect, ...]
    change: float
    error: float
    shift: float  # [m] median shift of the return RETURN after the hit


@dataclass(frozen=True)
class HitFindings:
    """Findings at the paddle."""

    causes: tuple[HitCause, ...]
    hits: int
    quiet: tuple[str, ...]  # effects that these hits could not show
    before: Float[np.ndarray, "6 n"]  # place [m] and velocity [m/s] behind the paddle, measured - nominal
    after: Float[np.ndarray, "6 n"]  # with the causes


def diagnose_hits(
    found: BallFindings, trajectories: Sequence[Trajectory], joints: JointPath | None, without: Sequence[str]
) -> HitFindings | None:
    """Judges the hits of the watched balls; None where there are fewer than FEWEST_HITS."""
    pairs = watched_hits(trajectories, joints)
    if len(pairs) < FEWEST_HITS:
        return None
    effects = tuple(e for e in EFFECTS if e.at_paddle and e.name not in without)
    whole = [t for t, _ in pairs]
    g = grid(whole)
    g = replace(g, paddle=poses(whole, g.steps, joints))
    before = np.array([n for _, n in pairs])
    incoming = np.arange(len(g.time))[:, None] < before[None]
    problem = BallProblem(g, found.problem.model, (*found.problem.effects, *effects), heading(g))
    theta = np.concatenate([found.search.at.theta, np.zeros(len(effects))])
    start = first_fit(problem, theta, None if found.search.prior is None else found.search.prior.mean, incoming)
    change = np.zeros(len(effects))
    y, jacobian, hit = compare_returns(problem, theta, start, incoming)
    first, usable = y, np.isfinite(hit) & (np.linalg.norm(y[:3], axis=0) < FARTHEST)
    if usable.sum() < FEWEST_HITS:
        return None
    for round_ in range(ROUNDS):
        if round_:
            now = theta.copy()
            now[-len(effects) :] = change
            y, jacobian, _ = compare_returns(problem, now, start, incoming)
        target = y + np.einsum("kcn,k->cn", jacobian, change)
        chosen, values, errors, rated = _choose(target[:, usable], jacobian[:, :, usable], effects)
        change = np.zeros(len(effects))
        change[list(chosen)] = values
    shift = np.median(np.linalg.norm(jacobian[:, :3] + RETURN * jacobian[:, 3:], axis=1)[:, usable], axis=1)
    causes = []
    for i, value, error in zip(chosen, values, errors, strict=True):
        if abs(value) * shift[i] >= LEAST_SHIFT:
            rivals = rated.group(chosen, i)[1:]
            causes.append(
                HitCause(
                    effects[i],
                    tuple(effects[r] for r in rivals),
                    float(value),
                    float(error),
                    float(abs(value) * shift[i]),
                )
            )
    could = np.diagonal(rated.total[0]) * (2.0 * LEAST_SHIFT / np.maximum(shift, 1e-9)) ** 2 > GAIN
    named = {c.effect.name for c in causes}
    quiet = tuple(e.name for e, ok in zip(effects, could, strict=True) if not ok and e.name not in named)
    now = theta.copy()
    now[-len(effects) :] = [c if e.name in named else 0.0 for c, e in zip(change, effects, strict=True)]
    after, _, _ = compare_returns(problem, now, start, incoming)
    return HitFindings(tuple(causes), int(usable.sum()), quiet, first[:, usable], after[:, usable])


def watched_hits(trajectories: Sequence[Trajectory], joints: JointPath | None) -> list[tuple[Trajectory, int]]:
    """Balls up to RETURN after their hit by a paddle whose joints were watched, each with its samples before it."""
    pairs = []
    for t in trajectories:
        cut = flights([t])
        if not cut or len(cut[0]) + 6 > len(t) or not watched(t, joints) or cut[0].position[1, -1] > 0.0:
            continue
        n0 = len(cut[0])
        stop = int(np.searchsorted(t.time, t.time[n0] + RETURN))
        if stop - n0 >= 8:
            pairs.append((t.part(0, stop), n0))
    return pairs


def part(found: BallFindings, hits: HitFindings | None, without: Container[str]) -> Part:
    """The hits' part of the verdict; without hits, the effects at the paddle are not excited."""
    if hits is None:
        paddle = (e.name for e in EFFECTS if e.at_paddle and e.name not in INVISIBLE)
        return Part(not_excited=tuple(name for name in paddle if name not in without))
    nominal, freedom, named = found.problem.nominal, hits.hits - 6, []
    for c in hits.causes:
        wide = quantile(freedom) * c.error
        parameters = estimates(c.effect, nominal, c.change, c.change - wide, c.change + wide)
        sure = float(1.0 - 2.0 * stdtr(max(freedom, 5), -abs(c.change) / c.error))
        group = (c.effect.name, *(e.name for e in c.rivals))
        cause = Cause(c.effect.name, group, sure, parameters, 1e3 * c.shift, readings(c.effect, c.rivals))
        named.append(Expressed.by(cause, parameters))
    return Part(tuple(named), not_excited=hits.quiet)


def compare_returns(
    problem: BallProblem, theta: np.ndarray, start: np.ndarray, incoming: Bool[np.ndarray, "T n"]
) -> tuple[Float[np.ndarray, "6 n"], Float[np.ndarray, "K 6 n"], Float[np.ndarray, " n"]]:
    """Differences (6, n) behind the paddle, their derivatives (K, 6, n) by the paddle's effects, and hit times (n,)."""
    g = problem.grid
    paddle = [i for i, e in enumerate(problem.effects) if e.at_paddle]
    variants = 1 + len(paddle)
    thetas = np.repeat(theta[:, None], variants, axis=1)
    moves = np.array([0.02 * problem.effects[i].scale for i in paddle])
    thetas[paddle, 1 + np.arange(len(paddle))] += moves
    flown = predict(
        problem.model, problem.values(thetas[:, :, None]), np.repeat(start[:, None], variants, axis=1), g, problem.axes
    )
    out = g.mask & ~incoming
    behind = line_behind(g, out, flown.hit_time[0])
    y = behind(np.where(out, g.measured - flown.measured[:, :, 0], 0.0))
    change = np.moveaxis(flown.measured[:, :, 1:] - flown.measured[:, :, :1], 2, 0)
    return y, behind(np.where(out, change, 0.0)) / moves[:, None, None], flown.hit_time[0]


def line_behind(
    g: Grid, out: Bool[np.ndarray, "T n"], hit_time: Float[np.ndarray, " n"]
) -> Callable[[np.ndarray], np.ndarray]:
    """Function that turns differences (..., 3, T, n) of returns into place and velocity behind the paddle (..., 6, n).

    out: samples of the return; hit_time: [s] since the first sample.
    """
    since = np.where(out, g.time - np.where(np.isfinite(hit_time), hit_time, 0.0), 0.0)
    weight = out.astype(float)
    moments = np.array([[weight.sum(0), since.sum(0)], [since.sum(0), (since**2).sum(0)]])  # (2, 2, n)
    inverse = np.linalg.inv(np.moveaxis(moments, -1, 0) + 1e-12 * np.eye(2))

    def behind(difference: np.ndarray) -> np.ndarray:
        sums = np.stack([(difference * weight).sum(-2), (difference * since).sum(-2)], axis=-1)  # (..., 3, n, 2)
        line = np.einsum("nij,...nj->i...n", inverse, sums)
        return np.concatenate([line[0], line[1]], axis=-2)

    return behind


def _choose(
    y: Float[np.ndarray, "6 n"], jacobian: Float[np.ndarray, "K 6 n"], effects: tuple[Effect, ...]
) -> tuple[Set, np.ndarray, np.ndarray, LinearModel]:
    """The likeliest set of effects; hits are the clusters, their spread the noise."""
    left = y - np.median(y, axis=1, keepdims=True)
    scale = np.array([e.scale for e in effects])
    for _ in range(ROUNDS):
        root, weight = spread(left)
        j = np.einsum("cd,kdn->kcn", root, jacobian) * np.sqrt(weight)
        t = root @ y * np.sqrt(weight)
        gram, right = np.einsum("kcn,lcn->nkl", j, j), np.einsum("kcn,cn->nk", j, t)
        low, able = np.array([e.low for e in effects]), tuple(range(len(scale)))
        model = LinearModel(gram, right, np.zeros(len(scale)), scale, SPIKE * scale, low, (), able)
        path = model.best(len(effects))
        chosen = path[int(np.argmax(model.evidence(path)))]
        size, covariance, _ = model.solve(chosen)
        values, errors = size[list(chosen)], np.sqrt(np.diagonal(covariance))[list(chosen)]
        left = y - np.einsum("kcn,k->cn", jacobian[list(chosen)], values)
        left = left - (0.0 if chosen else np.median(left, axis=1, keepdims=True))
    return chosen, values, errors, model


def spread(left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root (6, 6) of the inverse covariance of residuals (6, n), robustly, and Huber's weights (n,).

    Place and velocity behind the paddle err together: a hit that is early by a millisecond is both ahead and faster.
    """
    scale = deviation(left, axis=1) + 1e-6
    unit = left / scale[:, None]
    root = np.eye(len(left))
    for _ in range(5):
        distance = np.sqrt(((root @ unit) ** 2).sum(axis=0))
        weight = huber_weights(distance, HUBER)
        covariance = (unit * weight) @ unit.T / weight.sum() + 0.05 * np.eye(len(left))
        root = np.linalg.inv(np.linalg.cholesky(covariance))
    return root / scale, weight
