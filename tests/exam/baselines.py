"""Baselines of the diagnosis, on the same logs: usual ways from residuals to a named cause.

The first five share one linearisation by finite differences of the generator's own physics: states fitted to whole
flights under the nominal model, their six directions projected out of residuals and of every effect's column. The last
two fly the balls with every set of parameters that they try, without spins. Samples beyond five robust deviations are
left out, as any engineer would. None of them can say "unexplained".

    best single   the effect that lowers the RMSE most, if it does by 1 %
    BIC           the subset of up to three effects with the lowest BIC of independent Gaussian noise
    LASSO         the effects that cross-validated LASSO keeps at one standard error
    SINDy         sequentially thresholded least squares; threshold: a shift of 3 mm of the median ball's last sample
    sysid         least squares of all parameters; those that differ from nominal by three of their standard errors
    MuJoCo        the same by mujoco.minimize, the solver of mujoco.sysid, on the nonlinear flights within bounds
    CMA-ES        all parameters by pycma on the robust error of the nonlinear flights; those that move a ball by 3 mm
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from tests.exam.generator import cases as drawing
from tests.exam.generator import held_out, scoring
from tests.exam.generator.cases import EFFECTS, MAGNUS, Case
from tests.exam.generator.json_lines import append, read_lines
from tests.exam.generator.sessions import Log
from tests.exam.generator.world import World

# One of each exact gauge; a defect of the time stamps has no column.
NAMES = tuple(n for n in EFFECTS if n not in ("air_density", "ball_mass", "buoyancy", "clock_rate", "latency_jitter"))
LITTLE = 3e-3  # of a typical amount, for a difference quotient
GAIN = 0.01  # of the RMSE, for a single effect to be named
LARGEST = 3  # effects in a subset
SHIFT = 3e-3  # [m] threshold of the sequential least squares
DEVIATIONS = 3.0  # standard errors for a parameter to count as changed
OUTLIER = 5.0  # robust deviations
BOUND = 0.15  # [m] of shift by which a parameter may differ
ITERATIONS = 12  # of the least squares
STEP = 1e-5  # [m] of shift, for difference quotients
EVALUATIONS = 600  # of CMA-ES
SPREAD = 5e-3  # [m] its first deviation


@dataclass(frozen=True)
class Linear:
    """Projected least squares: residual (N,), columns (N, K) per metre of shift, and their effects' names."""

    residual: np.ndarray
    columns: np.ndarray
    names: tuple[str, ...]  # (K,), magnus once for k and once for each axis
    ball: np.ndarray  # (N,) which ball a row belongs to


@dataclass(frozen=True)
class Flights:
    """The flights that a linearisation was taken about."""

    start: np.ndarray  # (9, B)
    time: np.ndarray  # (T, B) [s]
    measured: np.ndarray  # (3, T, B) [m]
    good: np.ndarray  # (T, B)
    states: list[np.ndarray]  # six of (3, T, B), derivatives by the state at the first sample
    amounts: dict[str, float]  # name -> amount that shifts the median ball by a metre, were it a straight line

    def residual(self, names: tuple[str, ...], shifts: np.ndarray) -> np.ndarray:
        """Projected residual (N,) with every named effect at its shift [m]."""
        world = World()
        for name, shift in zip(names, shifts, strict=True):
            effect = EFFECTS[name]
            changed = effect.rule(getattr(world, effect.field), float(shift) * self.amounts[name])
            world = replace(world, **{effect.field: changed})
        path = held_out.predict(held_out.Model(world, np.zeros(3), np.zeros(3)), self.start, self.time)
        rest = np.nan_to_num(np.clip(self.measured - path, -1.0, 1.0))  # of a ball that bounces elsewhere, perhaps not
        return _project(rest, [], self.states, self.good, ()).residual


def linearise(log: Log, human: np.ndarray, without: tuple[str, ...] = ()) -> Linear:
    """Residuals of the nominal model and the columns of all effects but ``without``, balls' states projected out."""
    return both(log, human, without)[0]


def both(log: Log, human: np.ndarray, without: tuple[str, ...] = ()) -> tuple[Linear, Flights]:
    """The linearisation, and the flights about which it was taken."""
    first = np.argmax(np.isfinite(log.position[0]), axis=0)
    time = log.time - log.time[first, np.arange(human.size)]
    kept = np.isfinite(log.position[0])
    time, measured = np.where(kept, time, 0.0), np.nan_to_num(log.position)
    nominal = held_out.nominal()
    start = held_out.fit_states(nominal, time, measured, kept, human)
    path = held_out.predict(nominal, start, time)
    shapes, names, amounts = [], [], {}
    for name in NAMES:
        if name not in without:
            for shape, amount in _columns(name, start, time, path, human):
                shapes.append(shape)
                names.append(name)
                amounts[name] = amount
    states = []
    for unknown, step in enumerate([1e-5] * 3 + [1e-4] * 3):
        moved = start.copy()
        moved[unknown] += step
        states.append((held_out.predict(nominal, moved, time) - path) / step)
    good = kept & np.all([np.all(np.isfinite(a), axis=0) for a in (path, *shapes, *states)], axis=0)
    distance = np.sqrt(np.sum((measured - path) ** 2, axis=0))
    spread = np.median(distance[good]) / 1.54  # of a coordinate, by the median of a three-dimensional Gaussian's length
    good &= distance < OUTLIER * np.sqrt(3.0) * spread
    flights = Flights(start, time, measured, good, states, amounts)
    return _project(measured - path, shapes, states, good, tuple(names)), flights


def _columns(name: str, start, time, path, human):
    """Changes (3, T, B) of the path by a little of an effect, over its shift [m], and the amount for a metre.

    By a little, because the path has a kink at the bounce: samples that change sides of it spoil the difference. The
    filter's trace grows faster than its constant and needs a typical amount.
    """
    if name == "magnus":
        slightly = held_out.Model(replace(World(), magnus_coefficient=LITTLE * MAGNUS), np.zeros(3), np.zeros(3))
        yield _scaled(held_out.predict(slightly, start, time) - path, 0.0)  # the bounce makes every ball spin
        world = replace(World(), magnus_coefficient=MAGNUS)
        curving = held_out.Model(world, np.zeros(3), np.zeros(3))
        spinless = held_out.predict(curving, start, time)
        for axis in range(3):
            spinning = start.copy()
            spinning[6 + axis] = LITTLE * 5.0 * np.where(human, 1.0, -1.0)
            yield _scaled(held_out.predict(curving, spinning, time) - spinless, 0.0)
        return
    effect = EFFECTS[name]
    amount = effect.amount if name == "tracker_smoothing" else LITTLE * effect.amount
    world = replace(World(), **{effect.field: effect.rule(getattr(World(), effect.field), amount)})
    yield _scaled(held_out.predict(held_out.Model(world, np.zeros(3), np.zeros(3)), start, time) - path, amount)


def _scaled(change, amount):
    """Over the median ball's largest change: a coefficient is then a shift in metres, of which one takes an amount."""
    size = max(float(np.nanmedian(np.nanmax(np.sqrt(np.sum(change**2, axis=0)), axis=0))), 1e-12)
    return change / size, amount / size


def _project(residual, shapes, states, good, names) -> Linear:
    rows, columns, balls = [], [], []
    for ball in range(good.shape[1]):
        use = good[:, ball]
        if use.sum() < 8:
            continue
        own = np.stack([s[:, use, ball].ravel() for s in states], axis=1)
        q, _ = np.linalg.qr(own)
        block = np.stack([residual[:, use, ball].ravel(), *(s[:, use, ball].ravel() for s in shapes)], axis=1)
        block = block - q @ (q.T @ block)
        rows.append(block[:, 0])
        columns.append(block[:, 1:])
        balls.append(np.full(block.shape[0], ball))
    return Linear(np.concatenate(rows), np.concatenate(columns), names, np.concatenate(balls))


def _solve(gram, right, index):
    return np.linalg.lstsq(gram[np.ix_(index, index)], right[index], rcond=1e-10)[0]


def _lost(gram, right, index) -> float:
    """Reduction by a subset of the residual's sum of squares."""
    return float(right[index] @ _solve(gram, right, index)) if index else 0.0


def _indices(linear: Linear, names) -> list[int]:
    return [i for i, n in enumerate(linear.names) if n in names]


def best_single(linear: Linear) -> tuple[str, ...]:
    gram, right = linear.columns.T @ linear.columns, linear.columns.T @ linear.residual
    total = float(linear.residual @ linear.residual)
    lost = {n: _lost(gram, right, _indices(linear, (n,))) for n in dict.fromkeys(linear.names)}
    best = max(lost, key=lost.get)
    return (best,) if 1.0 - np.sqrt(1.0 - lost[best] / total) > GAIN else ()


def bic(linear: Linear) -> tuple[str, ...]:
    gram, right = linear.columns.T @ linear.columns, linear.columns.T @ linear.residual
    n, total = linear.residual.size, float(linear.residual @ linear.residual)
    names = list(dict.fromkeys(linear.names))

    def value(subset):
        index = _indices(linear, subset)
        return n * np.log((total - _lost(gram, right, index)) / n) + len(index) * np.log(n)

    return min((s for k in range(LARGEST + 1) for s in combinations(names, k)), key=value)


def lasso(linear: Linear) -> tuple[str, ...]:
    from sklearn.linear_model import lasso_path

    x, y = linear.columns / np.sqrt(np.mean(linear.columns**2, axis=0)), linear.residual
    alphas = np.abs(x.T @ y).max() / y.size * np.logspace(0, -3, 25)
    folds = linear.ball % 5
    errors = []
    for fold in range(5):
        train, test = folds != fold, folds == fold
        _, paths, _ = lasso_path(x[train], y[train], alphas=alphas, precompute=True, max_iter=20_000)
        errors.append(np.mean((y[test, None] - x[test] @ paths) ** 2, axis=0))
    mean, deviation = np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1) / np.sqrt(5)
    best = int(np.argmin(mean))
    chosen = int(np.argmax(mean <= mean[best] + deviation[best]))
    _, paths, _ = lasso_path(x, y, alphas=alphas, precompute=True, max_iter=20_000)
    return tuple(dict.fromkeys(n for n, c in zip(linear.names, paths[:, chosen], strict=True) if c != 0.0))


def sindy(linear: Linear) -> tuple[str, ...]:
    gram, right = linear.columns.T @ linear.columns, linear.columns.T @ linear.residual
    active = list(range(len(linear.names)))
    for _ in range(10):
        values = _solve(gram, right, active) if active else np.zeros(0)
        left = [i for i, v in zip(active, values, strict=True) if abs(v) >= SHIFT]
        if left == active:
            break
        active = left
    return tuple(dict.fromkeys(linear.names[i] for i in active))


def sysid(linear: Linear) -> tuple[str, ...]:
    gram, right = linear.columns.T @ linear.columns, linear.columns.T @ linear.residual
    values = _solve(gram, right, list(range(len(linear.names))))
    rest = linear.residual - linear.columns @ values
    deviation = np.sqrt(np.diag(np.linalg.pinv(gram)) * (rest @ rest) / (rest.size - values.size))
    changed = np.abs(values) > DEVIATIONS * deviation
    return tuple(dict.fromkeys(n for n, c in zip(linear.names, changed, strict=True) if c))


def mujoco(linear: Linear, flights: Flights) -> tuple[str, ...]:
    from mujoco import minimize

    names = tuple(n for n in dict.fromkeys(linear.names) if flights.amounts[n])
    bounds = [np.full((len(names), 1), s * BOUND) for s in (-1.0, 1.0)]

    def residual(shifts: np.ndarray) -> np.ndarray:  # (K, n) -> (N, n)
        return np.stack([flights.residual(names, column) for column in shifts.T], axis=1)

    found, _ = minimize.least_squares(
        np.zeros((len(names), 1)), residual, bounds, verbose=minimize.Verbosity.SILENT, max_iter=ITERATIONS, eps=STEP
    )
    rest = residual(found)[:, 0]
    jacobian = (residual(found + STEP * np.eye(len(names))) - rest[:, None]) / STEP
    gram = jacobian.T @ jacobian
    deviation = np.sqrt(np.diag(np.linalg.pinv(gram)) * (rest @ rest) / (rest.size - len(names)))
    return tuple(n for n, c in zip(names, np.abs(found[:, 0]) > DEVIATIONS * deviation, strict=True) if c)


def cma_es(linear: Linear, flights: Flights) -> tuple[str, ...]:
    import cma

    names = tuple(n for n in dict.fromkeys(linear.names) if flights.amounts[n])
    scale = np.median(np.abs(linear.residual)) / 0.6745

    def cost(shifts: np.ndarray) -> float:  # Huber's
        size = np.abs(flights.residual(names, shifts)) / scale
        return float(np.sum(np.where(size < 1.345, 0.5 * size**2, 1.345 * (size - 0.6725))))

    options = {"maxfevals": EVALUATIONS, "bounds": [-BOUND, BOUND], "seed": 1, "verbose": -9}
    found, _ = cma.fmin2(cost, np.zeros(len(names)), SPREAD, options)
    return tuple(n for n, shift in zip(names, found, strict=True) if abs(shift) >= SHIFT)


METHODS: dict[str, Callable[[Linear], tuple[str, ...]]] = {
    "best single": best_single,
    "BIC": bic,
    "LASSO": lasso,
    "SINDy": sindy,
    "sysid": sysid,
}
NONLINEAR: dict[str, Callable[[Linear, Flights], tuple[str, ...]]] = {"MuJoCo": mujoco, "CMA-ES": cma_es}


def answer(names: tuple[str, ...]) -> dict:
    """A verdict in the diagnosis's form; each name comes with its exact twins for nothing."""
    causes = [{"name": n, "group": [n, *EFFECTS[n].twins], "parameters": {}} for n in names]
    return {"verdict": "named" if causes else "none", "causes": causes}


def examine(case: Case) -> dict:
    """Outcomes of all methods on one case."""
    drawn = drawing.build(case)
    linear, flights = both(drawn.log(), drawn.balls.human, case.without)
    truth = json.loads(json.dumps(drawn.truth()))
    outcomes: dict[str, str] = {}
    for name, method in METHODS.items():
        outcomes[name] = scoring.score(truth, answer(method(linear)))["outcome"]
    for name, flown in NONLINEAR.items():
        outcomes[name] = scoring.score(truth, answer(flown(linear, flights)))["outcome"]
    return {"key": case.name, "case": truth["case"], "outcomes": outcomes}


def run_all(cases: list[dict], folder: Path) -> list[dict]:
    """The ball cases of an examination, from their records' dictionaries; resumes OUT/baselines.jsonl."""
    path = folder / "baselines.jsonl"
    wanted = [Case(**{k: tuple(v) if isinstance(v, list) else v for k, v in c.items()}) for c in cases]
    wanted = [c for c in wanted if c.kind in COMPARED]
    known = {c.name for c in wanted}
    records = [r for r in read_lines(path) if r["key"] in known]
    done = {r["key"] for r in records}
    for i, case in enumerate(wanted):
        if case.name not in done:
            records.append(examine(case))
            append(path, records[-1])
            print(f"baselines {i + 1}/{len(wanted)} {case.name}: {records[-1]['outcomes']}", flush=True)
    return records


# Kinds side by side, and which outcomes are good there.
COMPARED = {
    "none": ("right",),
    "noise": ("right",),
    "single": ("right",),
    "pair": ("right",),
    "triple": ("right",),
    "deleted": ("right", "flagged"),
    "invented": ("flagged",),
    "many": ("right", "partly"),  # no wrong name
    "bounce": ("right",),
}


def side_by_side(ours: list[dict], theirs: list[dict]) -> list[str]:
    """Markdown: share of good answers by kind and method, and the sign test of ours against the method's."""
    by_key = {r["key"]: r["outcome"] for r in ours}
    lines = [
        "Share of good answers on the same cases; in brackets p of the sign test that the diagnosis is no better.",
        "",
        f"| kind | cases | diagnosis | {' | '.join((*METHODS, *NONLINEAR))} |",
        "|---|---|---|" + "---|" * (len(METHODS) + len(NONLINEAR)),
    ]
    for kind, good in COMPARED.items():
        rows = [r for r in theirs if r["case"]["kind"] == kind and r["key"] in by_key]
        if not rows:
            continue
        mine = np.array([by_key[r["key"]] in good for r in rows])
        cells = [f"{100 * mine.mean():.0f} %"]
        for method in (*METHODS, *NONLINEAR):
            other = np.array([r["outcomes"][method] in good for r in rows])
            better, worse = int((mine & ~other).sum()), int((other & ~mine).sum())
            p = binomtest(better, better + worse, alternative="greater").pvalue if better + worse else 1.0
            cells.append(f"{100 * other.mean():.0f} % ({p:.1g})")
        lines.append(f"| {kind} | {len(rows)} | {' | '.join(cells)} |")
    return lines
