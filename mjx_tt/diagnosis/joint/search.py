"""Search of one joint's causes: fit those that are chosen, look what else is there, choose again.

Effects with a threshold have no slope while they are inactive. So each effect enters the linear model by the whole of
its change: from the nominal value to the fitted one, or to the best of the values that its fits begin with. Its size is
1 there, whatever its unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.inclusion import Chosen, Family, LinearModel, Set, choose
from mjx_tt.diagnosis.joint import discrepancy
from mjx_tt.diagnosis.joint.effects import BY_NAME
from mjx_tt.diagnosis.joint.fit import HUBER, fit, residual, rms, scale, slopes, weights
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.robust import bounded_mean, huber_loss

ROUNDS, EARLY = 8, 2  # early: no cause has to be worth its name
SPIKE = 1e-4  # [rad], [m] rms by which what is not chosen may move the joint
FLOOR = 5e-4  # [rad], [m] rms movement below which nothing is named
VISIBLE, ONE_WINDOW = 30.0, 12.0  # squared noise deviations that a change must make, in all and without one window
NOTHING = 1e-9  # [rad^2], [m^2] beside the noise, below which there is no error


@dataclass(frozen=True)
class JointSearch:
    """Where the search ended. Errors are mean squares [rad^2], [m^2], without each window's offset."""

    names: tuple[str, ...]  # of the effects that were searched
    values: dict[str, float]  # of the chosen
    model: LinearModel
    picked: Chosen
    columns: Float[np.ndarray, "n c"]  # of the model
    residual: Float[np.ndarray, " n"]  # beside the chosen
    sigma: float  # deviation of the noise
    level: float  # its mean square

    @property
    def pattern(self) -> tuple[str, str, str]:
        """The discrepancy that alone explains most of what is left: its name, where it is largest, its direction."""
        explained = []
        for family in self.model.families:
            columns = self.columns[:, family.columns]
            shape = np.linalg.lstsq(columns, self.residual, 1e-6)[0]
            explained.append((float(self.residual @ columns @ shape), family, shape))
        _, family, shape = max(explained, key=lambda row: row[0])
        shape = shape - shape.mean() if shape.size > 1 else shape
        largest = int(np.argmax(np.abs(shape)))
        return family.name, family.labels[largest], "+" if shape[largest] > 0.0 else "-"

    @property
    def others(self) -> Float[np.ndarray, "n o"]:
        """Movements [rad], [m] of the effects that were not chosen, all together as large as nobody would name them."""
        rest = [k for k in range(len(self.names)) if k not in self.picked.causes and self.columns[:, k].any()]
        return self.columns[:, rest] * self.model.spike[rest] / math.sqrt(max(len(rest), 1))

    @property
    def left(self) -> float:
        """Size [rad], [m] rms of what the chosen leave, without the noise."""
        return math.sqrt(max(float(self.picked.remaining[0]) - self.level, 0.0))

    @property
    def left_share(self) -> float:
        """Part of the nominal model's error, the noise left out, that the chosen leave."""
        return self.left**2 / max(float(self.picked.errors[0]) - self.level, self.left**2, NOTHING)

    def share(self, name: str) -> float:
        """Part of the nominal model's error, the noise left out, that comes back without one of the chosen."""
        return self.picked.share(self.names.index(name), self.level, NOTHING)

    def visible(self, log: JointLog, change: Float[np.ndarray, " n"]) -> bool:
        """True if a change of the predicted positions would show in this noise."""
        windows = np.add.reduceat(change**2, log.starts) / self.sigma**2 / self.model.temper
        total = float(windows.sum())
        return rms(change) > FLOOR and total > VISIBLE and total - windows.max() > ONE_WINDOW


def search(log: JointLog, names: Sequence[str]) -> JointSearch:
    """Search among effects with these names."""
    fits = _Fits(log, names)
    values: dict[str, float] = {}
    before: Set = ()
    sigma = scale(log.centred(log.measured - log.simulate({})))
    for round_ in range(ROUNDS):
        r = residual(log, values, sigma)
        change, starts = _changes(log, names, values, r, sigma)
        families, smooth = discrepancy.build(log, values, r, len(names))
        columns = np.concatenate([change, smooth], axis=1)
        now = np.array([float(name in values) for name in names] + [0.0] * smooth.shape[1])
        # What is not explained yet is smooth and would pass for noise: the noise is what all together leaves.
        for _ in range(1 if round_ else 2):
            model, everything = _linear_model(log, names, columns, now, r, sigma, families).tempered()
            left = r - columns @ (everything.coefficients - now)
            sigma = scale(left)
        level = bounded_mean(left**2)
        fits.prepare(model, values, starts, sigma)
        picked = choose(model, fits.errors, before, 0.0, level, NOTHING, round_ < EARLY)
        picked = _best_of_alike(model, picked, fits)
        values = fits.of(picked.causes)
        if picked.causes == before and round_ >= EARLY:
            break
        before = picked.causes
    return JointSearch(tuple(names), values, model, picked, columns, residual(log, values, sigma), sigma, level)


def _best_of_alike(model: LinearModel, picked: Chosen, fits: _Fits) -> Chosen:
    """Of effects that look alike the one that leaves least: a whole change is not told from another by slopes."""
    for member in picked.causes:
        rest = tuple(c for c in picked.causes if c != member)
        for rival in model.group(picked.causes, member)[1:]:
            causes = tuple(sorted((*rest, rival)))
            remaining = fits.errors(causes)
            if remaining < picked.remaining:
                without = {c: fits.errors(tuple(o for o in causes if o != c)) for c in causes}
                left = model.beside(causes)
                return replace(picked, causes=causes, left=left, remaining=remaining, without=without)
    return picked


def _changes(
    log: JointLog, names: Sequence[str], values: dict[str, float], r: Float[np.ndarray, " n"], sigma: float
) -> tuple[Float[np.ndarray, "n K"], dict[str, float]]:
    """What each effect changes, beside those that are fitted, and the values to which it does."""
    here, weight = log.simulate(values), weights(r, sigma)
    beside, starts, columns = slopes(log, values), {}, np.zeros((log.time.size, len(names)))
    for k, name in enumerate(names):
        if name in values:
            rest = {n: v for n, v in values.items() if n != name}
            columns[:, k] = log.centred(here - log.simulate(rest), weight)
            starts[name] = values[name]
            continue
        best = 0.0
        for value in BY_NAME[name].starts(log, log.base[name]):
            column = log.simulate({**values, name: value}) - here
            all_ = log.centred(np.column_stack([beside, column]), weight)
            if rms(all_[:, -1]) < 1e-8:
                continue
            normal, right = all_.T @ (all_ * weight[:, None]), all_.T @ (weight * r)
            solution = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
            gain = right @ solution * (1.0 if 0.2 < solution[-1] < 5.0 else 0.7 if solution[-1] > 0.0 else 0.1)
            if name not in starts or gain > best:
                best, starts[name], columns[:, k] = gain, value, all_[:, -1]
    return columns, starts


def _linear_model(
    log: JointLog,
    names: Sequence[str],
    columns: Float[np.ndarray, "n c"],
    now: Float[np.ndarray, " c"],
    r: Float[np.ndarray, " n"],
    sigma: float,
    families: tuple[Family, ...],
) -> LinearModel:
    """The linear model; windows are its pieces. now: the sizes at which r is what is left."""
    weight = weights(r, sigma) / sigma**2
    weighted = columns * weight[:, None]
    ends = np.append(log.starts, log.time.size)
    pieces = [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]
    gram = np.array([weighted[p].T @ columns[p] for p in pieces])
    right = np.array([weighted[p].T @ r[p] for p in pieces]) + gram @ now
    size = np.sqrt(np.mean(columns[:, : len(names)] ** 2, axis=0))
    spike = SPIKE / np.maximum(size, 1e-9)
    seen = tuple(k for k in range(len(names)) if gram[:, k, k].sum() > 1.0)
    count = len(names)
    return LinearModel(
        gram, right, np.zeros(count), np.ones(count), np.minimum(spike, 0.3), np.full(count, -0.5), families, seen
    )


class _Fits:
    """The best fit of each set of effects that was asked for."""

    def __init__(self, log: JointLog, names: Sequence[str]) -> None:
        self._log, self._names = log, names
        self._found: dict[Set, dict[str, float]] = {}
        self._asked: set[Set] = set()

    def prepare(self, model: LinearModel, values: dict[str, float], starts: dict[str, float], sigma: float) -> None:
        """Fits begin from here from now on."""
        self._model, self._values, self._starts, self._sigma = model, values, starts, sigma
        self._asked.clear()

    def of(self, chosen: Set) -> dict[str, float]:
        """Parameters of a set."""
        if chosen not in self._asked:
            self._asked.add(chosen)
            found = fit(self._log, self._begin(chosen), self._sigma)
            if chosen not in self._found or self._cost(found) < self._cost(self._found[chosen]):
                self._found[chosen] = found
        return self._found[chosen]

    def errors(self, chosen: Set) -> Float[np.ndarray, 1]:
        """Mean square beside a set."""
        return np.array([bounded_mean(residual(self._log, self.of(chosen), self._sigma) ** 2)])

    def _begin(self, chosen: Set) -> dict[str, float]:
        size = self._model.solve(chosen)[0]
        begin = {}
        for k in chosen:
            name, base = self._names[k], self._log.base[self._names[k]]
            start = self._starts[name]
            far = np.clip(size[k], 0.3, 2.0) if np.isfinite(base) and name not in self._values else 1.0
            begin[name] = float(base + far * (start - base)) if np.isfinite(base) else start
        return begin

    def _cost(self, values: dict[str, float]) -> float:
        return float(np.sum(huber_loss(np.abs(residual(self._log, values, self._sigma)) / self._sigma, HUBER)))
