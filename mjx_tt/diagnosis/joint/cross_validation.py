"""Prediction of positions by the named effects, on windows that the fit did not see and over the whole log."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjx_tt.diagnosis.joint.findings import JointGain, JointResidual
from mjx_tt.diagnosis.joint.fit import fit
from mjx_tt.diagnosis.joint.log import JointLog

DRAWS = 400  # of the windows, for an interval


def held_out(log: JointLog, values: Mapping[str, float], sigma: float, rng: np.random.Generator) -> JointGain:
    """Error in every second window of effects fitted to the others, from ``values``."""
    odd = log.window % 2 == 1
    fitted = fit(log, values, sigma, np.where(odd, 0.0, 1.0)) if values and odd.any() else values
    before, after = (log.centred(log.measured - log.simulate(v)) for v in ({}, fitted))
    counts = np.diff(np.append(log.starts, log.time.size))
    chosen = np.arange(counts.size) % 2 == 1 if counts.size > 1 else np.ones(1, bool)
    squares = np.array([np.add.reduceat(r * r, log.starts)[chosen] for r in (before, after)])
    counts = counts[chosen]
    draws = rng.integers(0, counts.size, (DRAWS, counts.size))
    spread = np.sqrt(squares[:, draws].sum(axis=-1) / counts[draws].sum(axis=-1))
    low, high = np.quantile(spread[0] - spread[1], (0.05, 0.95))
    total = np.sqrt(squares.sum(axis=-1) / counts.sum())
    return JointGain(log.record.joint, float(total[0]), float(total[1]), float(low), float(high), log.unit)


def residuals(log: JointLog, values: Mapping[str, float]) -> JointResidual:
    """Measured and predicted positions at every state of the log."""
    time, measured = log.record.state_time[log.every], log.record.state_position[log.every]
    starts, window = log.windows(time)
    count = np.diff(np.append(starts, time.size))
    lines = []
    for parameters in ({}, values):
        line = log.simulate(parameters, time)
        lines.append(line + (np.add.reduceat(measured - line, starts) / count)[window])
    return JointResidual(log.record.joint, time, measured, *lines, unit=log.unit)
