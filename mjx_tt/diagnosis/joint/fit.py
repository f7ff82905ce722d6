"""Fits of effects to one joint's log: Levenberg-Marquardt on a Huber loss, with a free offset in every window."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.joint.effects import BY_NAME
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.scores import Judge, loss, weights
from mjx_tt.diagnosis.verdict import Estimate

INTERVAL = 1.645  # deviations of a 90 % interval


@dataclass(frozen=True)
class Fit:
    """Fitted effects; ``values`` holds the parameter of each, the sum of both delays under action_delay."""

    values: dict[str, float]
    residual: Float[np.ndarray, " n"]  # measured - predicted, without each window's offset

    @property
    def names(self) -> frozenset[str]:
        return frozenset(self.values)

    def loss(self, sigma: float) -> float:
        return np.sum(loss(self.residual, sigma))


class Fitter:
    """Fits to one joint's log; ``found`` remembers the best of each set of effects."""

    def __init__(self, log: JointLog):
        self.log = log
        self.found: dict[frozenset[str], Fit] = {}

    def residual(self, values: Mapping[str, float], sigma: float) -> Float[np.ndarray, " n"]:
        """Measured - predicted, without each window's robust mean."""
        r = self.log.centred(self.log.measured - self.log.simulate(values))
        for _ in range(2):
            r = self.log.centred(r, weights(r, sigma))
        return r

    def jacobian(self, values: Mapping[str, float]) -> Float[np.ndarray, "n p"]:
        """Derivatives of the prediction by the fitted parameters."""
        here = self.log.simulate(values)
        columns = []
        for name, value in values.items():
            effect = BY_NAME[name]
            step = effect.step(self.log, value)
            if value + step > effect.bounds(self.log)[1]:
                step = -step
            columns.append((self.log.simulate({**values, name: value + step}) - here) / step)
        return np.array(columns).T.reshape(self.log.time.size, len(columns))

    def fit(
        self,
        start: Mapping[str, float],
        sigma: float,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        mask: Float[np.ndarray, " n"] | float = 1.0,
    ) -> Fit:
        """Levenberg-Marquardt from ``start``; mask: 1 for the samples that count."""
        values, names = dict(start), list(start)
        if not names:
            return Fit({}, self.residual({}, sigma))
        if "deadband" in values:
            values = self._place(values, sigma)
        limits = np.array([(bounds or {}).get(n, BY_NAME[n].bounds(self.log)) for n in names])
        r = self.residual(values, sigma)
        least, damping = np.sum(mask * loss(r, sigma)), 1e-3
        for _ in range(12):
            weight = mask * weights(r, sigma)
            slopes = self.log.centred(self.jacobian(values), weights(r, sigma))
            normal = slopes.T @ (slopes * weight[:, None]) / sigma**2
            right = slopes.T @ (weight * r) / sigma**2
            x, scale = np.array([values[n] for n in names]), np.diag(normal) + 1e-12
            for _ in range(4):
                change = np.linalg.solve(normal + np.diag(damping * scale), right)
                moved = np.clip(x + change, limits[:, 0], limits[:, 1])
                trial = dict(zip(names, moved.tolist(), strict=True))
                r_trial = self.residual(trial, sigma)
                reached = np.sum(mask * loss(r_trial, sigma))
                if reached < least:
                    break
                damping *= 10.0
            else:
                break
            gain, values, r, least, damping = least - reached, trial, r_trial, reached, damping * 0.1
            if gain < max(0.5, 1e-4 * least):
                break
        return Fit(values, r)

    def _place(self, values: dict[str, float], sigma: float) -> dict[str, float]:
        """Best deadband near the given one: the loss is a staircase in it, so that slopes lead nowhere."""
        least = float(np.sum(loss(self.residual(values, sigma), sigma)))
        for width in (0.12, 0.04, 0.013, 0.004, 0.0013):
            for factor in (1.0 - 2.0 * width, 1.0 - width, 1.0 + width, 1.0 + 2.0 * width):
                trial = {**values, "deadband": min(values["deadband"] * factor, self.log.fastest)}
                reached = float(np.sum(loss(self.residual(trial, sigma), sigma)))
                if reached < least:
                    least, values = reached, trial
        return values

    def guess(self, fit: Fit, slopes: np.ndarray, name: str, sigma: float) -> tuple[float, dict[str, float]]:
        """Linear guess of the gain from a further effect, and where its fit begins: nowhere if the log lacks it.

        slopes: jacobian (n, p) of the fit.
        """
        weight = weights(fit.residual, sigma)
        best, begin = -math.inf, {}
        here = self.log.simulate(fit.values)
        for value in BY_NAME[name].starts(self.log, self.log.base[name]):
            column = self.log.simulate({**fit.values, name: value}) - here
            columns = self.log.centred(np.column_stack([slopes, column]), weight)
            normal = columns.T @ (columns * weight[:, None])
            right = columns.T @ (weight * fit.residual)
            if normal[-1, -1] / self.log.time.size < 1e-16:
                continue
            if name == "deadband":  # a command is lost or not: half of the change means nothing
                beside = np.linalg.lstsq(normal[:-1, :-1], right[:-1] - normal[:-1, -1], rcond=1e-10)[0]
                solution = np.append(beside, 1.0)
                gain = 2.0 * right @ solution - solution @ normal @ solution
            else:
                solution = np.linalg.lstsq(normal, right, rcond=1e-10)[0]
                gain = right @ solution * (1.0 if 0.2 < solution[-1] < 5.0 else 0.7 if solution[-1] > 0.0 else 0.1)
            if gain > best:
                shifted = {
                    n: self._bounded(n, v + s) for (n, v), s in zip(fit.values.items(), solution[:-1], strict=True)
                }
                best, begin = gain, {**shifted, name: value}
        return best / sigma**2, begin

    def _bounded(self, name: str, value: float) -> float:
        low, high = BY_NAME[name].bounds(self.log)
        return min(max(value, low), high)

    def add(self, fit: Fit, name: str, begin: Mapping[str, float], sigma: float) -> Fit | None:
        """The best fit with one effect more, begun where ``guess`` says; None where the log does not show it."""
        names = fit.names | {name}
        old = self.found.get(names)
        if begin:
            new = self.fit(begin, sigma)
            if old is None or new.loss(sigma) < old.loss(sigma):
                self.found[names] = old = new
        return old


def intervals(fitter: Fitter, fit: Fit, judge: Judge) -> dict[str, tuple[float, float]]:
    """90 % intervals of the fitted parameters from window-clustered errors, or from the noise where it says more."""
    log, weight = fitter.log, weights(fit.residual, judge.sigma)
    slopes = log.centred(fitter.jacobian(fit.values), weight)
    scores = np.add.reduceat(slopes * (weight * fit.residual)[:, None], log.starts, axis=0)
    bread = np.linalg.pinv(slopes.T @ (slopes * weight[:, None]))
    count = len(scores)
    spread = bread @ (scores.T @ scores) @ bread * count / max(count - 1, 1)
    noise = bread * judge.sigma**2 * judge.inflation
    result = {}
    for i, (name, value) in enumerate(fit.values.items()):
        if not slopes[:, i].any():  # any larger limit would do as well
            result[name] = (value, math.inf)
            continue
        half = INTERVAL * math.sqrt(max(spread[i, i], noise[i, i], 0.0))
        low, high = value - half, value + half
        if name == "deadband":  # the log cannot place a threshold closer than the sizes of its commands
            below, above = log.sizes[log.sizes < value], log.sizes[log.sizes >= value]
            low, high = min(low, below.max(initial=0.0)), max(high, above.min(initial=log.fastest))
        result[name] = (float(max(low, BY_NAME[name].bounds(log)[0])), float(high))
    return result


def estimates(log: JointLog, name: str, value: float, interval: tuple[float, float]) -> dict[str, Estimate]:
    """Estimates of the parameters of JointResponse that an effect changes, by name."""
    unit = BY_NAME[name].unit_of(log)
    if name != "action_delay":
        return {name: Estimate(log.base[name], value, *interval, unit)}
    # The sum is known; the change goes to the action delay, and what would make it negative to the observation delay.
    action, observation = log.nominal.action_delay, log.nominal.observation_delay
    left, low, high = (max(v - observation, 0.0) for v in (value, *interval))
    parts = {name: Estimate(action, left, low, high, unit)}
    if value < observation:
        low, high = (min(v, observation) for v in interval)
        parts["observation_delay"] = Estimate(observation, value, low, high, unit)
    return parts
