"""Sizes of the named effects, with 90 % intervals."""

from __future__ import annotations

import math

import numpy as np

from mjx_tt.diagnosis.joint.effects import EFFECTS
from mjx_tt.diagnosis.joint.fit import Fit, Fitter
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.robust import weights
from mjx_tt.diagnosis.joint.scores import Judge

INTERVAL = 1.645  # deviations of a 90 % interval


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
        result[name] = (float(max(low, EFFECTS[name].bounds(log)[0])), float(high))
    return result


def parameters(log: JointLog, name: str, value: float, interval: tuple[float, float]) -> dict:
    """Nominal value, estimate, low, high and unit of each parameter of JointResponse that an effect changes."""
    unit = EFFECTS[name].unit_of(log)
    if name != "action_delay":
        return {name: (log.base[name], value, *interval, unit)}
    # The sum is known; the change goes to the action delay, and what would make it negative to the observation delay.
    action, observation = log.nominal.action_delay, log.nominal.observation_delay
    parts = {name: (action, *(max(v - observation, 0.0) for v in (value, *interval)), unit)}
    if value < observation:
        parts["observation_delay"] = (observation, value, *(min(v, observation) for v in interval), unit)
    return parts
