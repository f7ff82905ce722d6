"""Fits of effects to one joint's log by SciPy's least squares on a Huber loss, with a free offset in every window."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from mjx_tt.diagnosis.joint.effects import BY_NAME
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.robust import deviation, huber_loss, huber_weights
from mjx_tt.diagnosis.verdict import Estimate

HUBER = 2.5  # noise deviations beyond which a sample counts linearly
SMALLEST_NOISE = 5e-5  # [rad], [m]: no log is believed more exactly
INTERVAL = 1.645  # deviations of a 90 % interval
EVALUATIONS = 15  # of the model, at most
Values = Mapping[str, float]  # parameters of effects by name, the sum of both delays under action_delay


def weights(r: Float[np.ndarray, " n"], sigma: float) -> Float[np.ndarray, " n"]:
    """Weight of each residual in least squares."""
    return huber_weights(np.abs(r), HUBER * sigma)


def scale(r: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of the noise, from the median."""
    return max(float(deviation(r)), SMALLEST_NOISE)


def rms(x: Float[np.ndarray, ...]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x * x)))


def residual(log: JointLog, values: Values, sigma: float) -> Float[np.ndarray, " n"]:
    """Measured - predicted, without each window's robust mean."""
    r = log.centred(log.measured - log.simulate(values))
    for _ in range(2):
        r = log.centred(r, weights(r, sigma))
    return r


def slopes(log: JointLog, values: Values) -> Float[np.ndarray, "n p"]:
    """Derivatives of the prediction by the fitted parameters."""
    here = log.simulate(values)
    columns = []
    for name, value in values.items():
        effect = BY_NAME[name]
        step = effect.step(log, value)
        if value + step > effect.bounds(log)[1]:
            step = -step
        columns.append((log.simulate({**values, name: value + step}) - here) / step)
    return np.array(columns).T.reshape(log.time.size, len(columns))


def fit(log: JointLog, start: Values, sigma: float, mask: Float[np.ndarray, " n"] | float = 1.0) -> dict[str, float]:
    """The parameters of the least loss, from ``start``; mask: 1 for the samples that count."""
    if not start:
        return {}
    values = _place(log, dict(start), sigma) if "deadband" in start else dict(start)
    limits = np.array([BY_NAME[name].bounds(log) for name in values])
    size = np.array([BY_NAME[name].step(log, value) for name, value in values.items()])

    def named(x: np.ndarray) -> dict[str, float]:
        return dict(zip(values, (x * size).tolist(), strict=True))

    found = least_squares(
        lambda x: mask * residual(log, named(x), sigma) / sigma,
        np.clip(list(values.values()), *limits.T) / size,
        lambda x: -np.broadcast_to(mask, log.time.shape)[:, None] * log.centred(slopes(log, named(x))) * size / sigma,
        tuple(limits.T / size),
        loss="huber",
        f_scale=HUBER,
        ftol=1e-5,
        max_nfev=EVALUATIONS,
    )
    return named(found.x)


def _place(log: JointLog, values: dict[str, float], sigma: float) -> dict[str, float]:
    """Best deadband near the given one: the loss is a staircase in it, so that slopes lead nowhere."""

    def cost(trial: Values) -> float:
        return float(np.sum(huber_loss(np.abs(residual(log, trial, sigma)) / sigma, HUBER)))

    least = cost(values)
    for width in (0.12, 0.04, 0.013, 0.004, 0.0013):
        for factor in (1.0 - 2.0 * width, 1.0 - width, 1.0 + width, 1.0 + 2.0 * width):
            trial = {**values, "deadband": min(values["deadband"] * factor, log.fastest)}
            if (reached := cost(trial)) < least:
                least, values = reached, trial
    return values


def intervals(
    log: JointLog, values: Values, sigma: float, temper: float, others: Float[np.ndarray, "n o"]
) -> dict[str, tuple[float, float]]:
    """90 % intervals of the fitted parameters from window-clustered errors, or from the noise where it says more.

    others: by how much [rad], [m] what was not chosen may move the joint all the same.
    """
    r = residual(log, values, sigma)
    weight = weights(r, sigma)
    columns = log.centred(slopes(log, values), weight)
    scores = np.add.reduceat(columns * (weight * r)[:, None], log.starts, axis=0)
    bread = np.linalg.pinv(columns.T @ (columns * weight[:, None]))
    count = len(scores)
    spread = bread @ (scores.T @ scores) @ bread * count / max(count - 1, 1)
    noise = bread * sigma**2 * temper
    hidden = bread @ columns.T @ (log.centred(others, weight) * weight[:, None])
    variance = np.maximum(np.diagonal(spread), np.diagonal(noise)) + (hidden**2).sum(axis=1)
    result = {}
    for i, (name, value) in enumerate(values.items()):
        if not columns[:, i].any():  # any larger limit would do as well
            result[name] = (value, math.inf)
            continue
        half = INTERVAL * math.sqrt(max(variance[i], 0.0))
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
