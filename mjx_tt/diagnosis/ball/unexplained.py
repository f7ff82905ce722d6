"""Patterns that no entry of the catalogue explains: blocks that stay significant beside the chosen causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri, fdtrc

from mjx_tt.diagnosis.ball import basis_functions, scores, selection
from mjx_tt.diagnosis.ball.flights import noise
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import Linear, Projected, StartsOut
from mjx_tt.diagnosis.ball.flights.spin_prior import TINY
from mjx_tt.diagnosis.ball.selection import Choice, Settled, Trial

BLOCK_LEVEL = 2e-5  # chance of one block's false alarm
BLOCK_FLOOR = 0.0025  # [m] shift that a block must cause on the balls it concerns
VISIBLE_FLOOR = 2e-4  # [m] rms of what of it no other start of the ball could imitate, on one ball in twenty
FILTERED_FLOOR = 8e-4  # [m] the same behind a tracker's filter, which is never quite the catalogue's
NOT_SMALL = 0.01  # chance of effects of FLOOR each to be as large together
ODD_LEVEL = 1e-5  # chance with which one ball is called odd
ODD_SHARE = 0.01  # of the balls that may be odd (mis-tracked) before they are a finding


@dataclass(frozen=True)
class Finding:
    """A block that stays significant."""

    block: str
    where: str
    direction: str
    size: float  # [m]
    gain: float  # squared error that it explains


@dataclass(frozen=True)
class Left:
    """Patterns that stay significant beside the chosen causes."""

    findings: tuple[Finding, ...]  # that no entry explains, the most important first
    holding: tuple[str, ...]  # names that hold beside the first; all of them where nothing is found
    small: tuple[Finding, ...]  # that entries explain which are too small to be named


def find(
    settled: Settled, g: Grid, sessions: Int[np.ndarray, " n"], age: Float[np.ndarray, " n"], called: Sequence[str]
) -> Left:
    """Blocks that stay significant beside the chosen causes.

    sessions: number of each ball's session; age: 0 to 1, its place in its session; called: the sessions' names.
    """
    linear, p, choice, trial = settled.linear, settled.projected, settled.choice, settled.trial
    out, holding, small = [], [], []
    chosen = list(choice.effects)
    if choice.magnus is not None and p.coefficient is not None:
        chosen.append(p.coefficient)
    effects = linear.effects[chosen]
    # The chosen effects' own values are in the situation: what is left is scored at it (spins are kept absolute).
    flights = StartsOut(linear, linear.residual, settled.at.start, p.noise, p.weight, g)
    # Kicks imitate on each ball what all bounces share; it is as visible as if they were alike.
    alike = flights
    if p.noise.scatter.any():
        unkicked = replace(p.noise, scatter=noise.ALIKE)
        alike = StartsOut(linear, linear.residual, settled.at.start, unkicked, p.weight, g)
    named = len(choice.effects)  # the coefficient that comes along with spin is no name of its own
    filtered = any(trial.effects[j].name == "tracker_filter" for j in choice.effects)
    least = FILTERED_FLOOR if filtered else VISIBLE_FLOOR
    for block in basis_functions.build(linear, g, sessions, age, called):
        columns = np.concatenate([effects, block.columns])
        both = flights.project(columns)
        rated = scores.under(both, choice.prior)
        extra = list(range(len(chosen), len(columns)))
        base = [*range(len(chosen)), *rated.always]
        own, gram = scores.unexplained_scores(rated, base, extra)
        p_value, beta = _joint_test(own, gram)
        if p_value > BLOCK_LEVEL:
            continue
        pattern = np.tensordot(beta, block.columns, 1)
        worst = np.linalg.norm(np.where(g.mask, pattern, 0.0), axis=0).max(axis=0)
        size = float(np.percentile(worst, 90))
        shown = rated if alike is flights else scores.under(alike.project(columns), choice.prior)
        if size < BLOCK_FLOOR or _visible(shown.ball_gram[:, extra][:, :, extra], beta, p, g) < least:
            continue
        axis = int(
            np.argmax([np.percentile(np.abs(np.where(g.mask, pattern[a], 0.0)).max(axis=0), 90) for a in range(3)])
        )
        importance = np.abs(beta) * np.sqrt(np.maximum(np.diagonal(gram), 0.0))
        best = int(np.argmax(importance))
        finding = Finding(
            block.name, block.labels[best], block.directions[best] or "xyz"[axis], size, _explained(own, gram)
        )
        if not _stays(flights, linear, choice, trial, chosen, block.columns, size, g):
            small.append(finding)
            continue
        change = scores.solve(rated, (*base, *extra))
        error = np.sqrt(np.maximum(np.diagonal(scores.sandwich(rated, (*base, *extra))), 0.0))
        mean = change[len(chosen) : len(chosen) + len(rated.always)]
        holding.append(
            _holding(choice, trial, change[:named], error[:named]) | _spin_holding(choice, trial, mean, size)
        )
        out.append(finding)
    odd = _odd_balls(linear, flights, choice, g)
    if odd is not None:
        out.append(odd)
        holding.append({trial.effects[j].name for j in choice.effects} | ({"magnus"} if choice.spin else set()))
    small = sorted(small, key=lambda finding: -finding.gain)
    if not out:
        return Left((), tuple(e.name for e in trial.effects) + ("magnus", "latency_jitter"), tuple(small))
    order = np.argsort([-f.gain for f in out])
    return Left(tuple(out[i] for i in order), tuple(holding[order[0]]), tuple(small))


def _stays(
    flights: StartsOut,
    linear: Linear,
    choice: Choice,
    trial: Trial,
    chosen: Sequence[int],
    columns: Float[np.ndarray, "E 3 T n"],
    size: float,
    g: Grid,
) -> bool:
    """True if a block of this size [m] stays significant beside what the catalogue may hold without a name.

    Those are effects of FLOOR each: real set-ups are wrong in many places by a little, and a dozen effects of a
    millimetre together are a pattern. What is larger than they can be together is none of them.
    """
    small = [
        i
        for i, e in enumerate(trial.effects)
        if i not in chosen
        and i not in trial.left_out
        and not e.made_of
        and not (e.needs_spin and choice.prior is None)
        and trial.shift[i] > 0.0
    ]
    if size > selection.FLOOR * len(small) ** 0.5:
        return True
    both = flights.project(np.concatenate([linear.effects[[*chosen, *small]], columns]))
    rated = scores.under(both, choice.prior)
    known, count = len(chosen) + len(small), len(both.gram[0])
    base = [*range(known), *rated.always]
    pull = np.zeros(len(base))
    pull[len(chosen) : known] = (trial.shift[small] / selection.FLOOR) ** 2
    total = rated.gram[np.ix_(base, base)] + np.diag(pull)
    fitted = np.linalg.lstsq(total, rated.right[base], rcond=1e-12)[0]
    if float(pull @ fitted**2) > chdtri(len(small), NOT_SMALL):
        return True
    own, gram = scores.unexplained_scores(rated, base, range(known, count), pull)
    p_value, beta = _joint_test(own, gram)
    worst = np.linalg.norm(np.where(g.mask, np.tensordot(beta, columns, 1), 0.0), axis=0).max(axis=0)
    return p_value <= BLOCK_LEVEL and float(np.percentile(worst, 90)) >= BLOCK_FLOOR


def _holding(choice: Choice, trial: Trial, change: np.ndarray, error: np.ndarray) -> set[str]:
    """Chosen effects that keep at least half of their size, and significance, when a block may take over from them."""
    names = set()
    for j, before, moved, e in zip(choice.effects, choice.theta, change, error, strict=True):
        now = before + moved
        if abs(now) > selection.LEAST_Z * e and 0.5 < now / before < 2.0:
            names.add(trial.effects[j].name)
    return names


def _spin_holding(choice: Choice, trial: Trial, mean: np.ndarray, size: float) -> set[str]:
    """Spin, where the balls keep at least half of theirs, and their way of it, when a block may take over from it.

    A spin that bends the flights less than the block, of size [m], does not stand beside it: it may be part of the
    block.
    """
    if choice.prior is None:
        return set()
    if choice.prior.conditional:  # each ball's own: no mean of all could be part of a block
        return {"magnus"}
    spread = float((choice.prior.std**2).sum())
    before, now = (np.sqrt(float((m**2).sum()) + spread) for m in (choice.prior.mean, mean))
    same_way = float(choice.prior.mean @ mean) + spread > 0.0
    return {"magnus"} if same_way and 0.5 < now / before < 2.0 and now * trial.spin_shift > size else set()


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
    return float(fdtrc(e, n - e, t2 * (n - e) / (e * (n - 1)))), beta


def _visible(gram: np.ndarray, beta: np.ndarray, p: Projected, g: Grid) -> float:
    """Rms over a flight [m] of a pattern beyond what its ball's start explains: the 95th percentile of the balls."""
    energy = np.einsum("i,nij,j->n", beta, gram, beta) / (3.0 * g.mask.sum(axis=0))
    memory = float(p.noise.memory.mean())
    # Slow patterns lose this factor when noise that remembers itself is whitened.
    scale = np.median(p.noise.scale) * np.sqrt((1.0 + memory) / (1.0 - memory))
    return float(np.percentile(np.sqrt(np.maximum(energy, 0.0)), 95) * scale)


def _explained(own: np.ndarray, gram: np.ndarray) -> float:
    total = own.sum(axis=0)
    return float(total @ np.linalg.lstsq(gram, total, rcond=1e-6)[0])


def _odd_balls(linear: Linear, flights: StartsOut, choice: Choice, g: Grid) -> Finding | None:
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
    both = flights.project(np.stack(columns))
    gram, right = both.gram, both.right
    if choice.prior is not None:
        middle, precision = choice.prior.of_balls(g.n, TINY)
        if choice.prior.conditional:
            precision = scores.loosened(precision, both.spin_gram)
        inner = both.spin_gram + precision
        left = both.spin_right - np.einsum("nab,bn->na", both.spin_gram, middle)
        gram = gram - both.spin_effect.swapaxes(1, 2) @ np.linalg.solve(inner, both.spin_effect)
        mean = np.einsum("nak,an->nk", both.spin_effect, middle)
        right = right - mean - (both.spin_effect.swapaxes(1, 2) @ np.linalg.solve(inner, left[..., None]))[..., 0]
    scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-300))
    unit = gram / scale[:, :, None] / scale[:, None, :]
    values, vectors = np.linalg.eigh(unit)
    keep = values > 1e-3
    u = np.einsum("nij,ni->nj", vectors, right / scale) / np.sqrt(np.maximum(values, 1e-12))
    q, freedom = (np.where(keep, u, 0.0) ** 2).sum(axis=1), np.maximum(keep.sum(axis=1), 1)
    inflation = max(float(np.median(q / chdtri(freedom, 0.5))), 1.0)
    odd = q / inflation > chdtri(freedom, ODD_LEVEL)
    if odd.sum() < max(3, ODD_SHARE * g.n):
        return None
    beta = np.einsum("nij,nj->ni", vectors, np.where(keep, u / np.sqrt(np.maximum(values, 1e-12)), 0.0)) / scale
    pattern = (np.stack(columns) * beta.T[:, None, None]).sum(axis=0)
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
        float(q[odd].sum() / inflation),
    )
