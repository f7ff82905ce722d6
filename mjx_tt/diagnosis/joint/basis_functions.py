"""Functions without a name that a residual is held against: of position, velocity, acceleration, reversals and time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.joint.fit import Fit
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.scores import scale, weights

STEP = 0.005  # [s] of the grid on which the predicted motion is looked at
DECAYS = np.array([0.03, 0.1, 0.3, 1.0, math.inf])  # [s] after a reversal
DELAYS = np.concatenate([np.arange(0.0, 0.1, 0.02), np.arange(0.1, 0.45, 0.04)])  # [s] of a response to commands

Where = Callable[[np.ndarray], tuple[str, str]]  # coefficients (m,) -> where and in which direction they are largest


@dataclass(frozen=True)
class Block:
    """Functions of the samples, (n, m)."""

    name: str
    columns: np.ndarray
    where: Where
    tried: int = 1  # how many such blocks this one was chosen from


class _Motion:
    """The predicted motion of a joint on a fine grid (g,)."""

    def __init__(self, log: JointLog, fit: Fit):
        self.time = log.time
        self.grid = np.arange(log.time[0] - 0.5, log.time[-1] + 0.5, STEP)
        self.path = log.simulate(fit.values, self.grid)
        self.velocity = np.gradient(self.path, STEP)
        self.acceleration = np.gradient(np.convolve(self.velocity, np.full(5, 0.2), "same"), STEP)

    def sampled(self, values: np.ndarray, delay: float = 0.0) -> np.ndarray:
        """Values (g,) at the samples (n,), as they were a delay before."""
        return np.interp(self.time - delay, self.grid, values)

    def integrated(self, columns: np.ndarray) -> np.ndarray:
        """Movement (n, m) at the samples that velocities (g, m) make."""
        sums = np.cumsum(columns, axis=0) * STEP
        return np.column_stack([self.sampled(column) for column in sums.T])

    def since_reversal(self, slowest: float) -> tuple[np.ndarray, np.ndarray]:
        """Last direction (g,) of motion faster than ``slowest``, and the time (g,) since it began [s]."""
        moving = np.abs(self.velocity) > slowest
        direction = np.sign(self.velocity) * moving
        held = direction[self._last(moving)]
        turned = np.concatenate([[True], held[1:] != held[:-1]])
        return held, self.grid - self.grid[self._last(turned)]

    def _last(self, true: np.ndarray) -> np.ndarray:
        """Index (g,) of the last grid time at which it was true."""
        return np.maximum.accumulate(np.where(true, np.arange(self.grid.size), 0))


def blocks(log: JointLog, fit: Fit) -> list[Block]:
    """All blocks for the residual of a fit."""
    motion = _Motion(log, fit)
    position = log.measured - fit.residual  # with the noise in it, it would explain the noise
    return [*_over_time(motion), *_over_motion(log, motion, position), *_waves(log, fit, position)]


def _over_time(motion: _Motion) -> Iterator[Block]:
    seconds = motion.time - motion.time[0]
    yield Block("drift", seconds[:, None], lambda c: ("velocity at all times", "+" if c[0] > 0 else "-"))
    stages, peaks = _hats(motion.grid - motion.grid[0], 7)
    when = _peak(peaks, "time in the log", "s")
    yield Block("gain over time", motion.integrated(stages * motion.velocity[:, None]), when)
    yield Block("delay over time", _hats(seconds, 7)[0] * motion.sampled(motion.velocity)[:, None], when)


def _over_motion(log: JointLog, motion: _Motion, position: np.ndarray) -> Iterator[Block]:
    for name, values, here, count, of in (
        ("velocity", motion.velocity, motion.sampled(motion.velocity), 9, f"{log.unit}/s"),
        ("acceleration", motion.acceleration, motion.sampled(motion.acceleration), 9, f"{log.unit}/s^2"),
        ("position", np.interp(motion.grid, motion.time, position), position, 11, log.unit),
    ):
        columns, peaks = _hats(here, count)
        yield Block(name, columns, _peak(peaks, name, of))
        columns, peaks = _hats(values, 9)
        yield Block(f"drive against {name}", motion.integrated(columns), _peak(peaks, name, of))
    held, since = motion.since_reversal(0.01 * max(log.fastest, 1e-9))
    columns = np.column_stack([motion.sampled(held * np.exp(-since / s)) for s in DECAYS])
    yield Block("reversal", columns, _peak(DECAYS, "decay after a reversal", "s"))
    columns = np.column_stack([*(motion.sampled(motion.velocity, d) for d in DELAYS), motion.sampled(motion.path)])
    yield Block("dynamics", columns, _peak(np.append(DELAYS, math.inf), "response to the command after", "s"))


def _waves(log: JointLog, fit: Fit, position: np.ndarray) -> Iterator[Block]:
    """The strongest of many waves in position, and in time."""
    weight = weights(fit.residual, scale(fit.residual)) * fit.residual
    for name, x, frequencies, of in (
        ("ripple in position", position, np.geomspace(1.0, 300.0, 240), f"1/{log.unit}"),
        ("vibration", log.time - log.time[0], 2.0 * np.pi * np.geomspace(0.7, 45.0, 240), "rad/s"),
    ):
        phase = x[:, None] * frequencies
        power = (weight @ np.cos(phase)) ** 2 + (weight @ np.sin(phase)) ** 2
        best = frequencies[int(np.argmax(power))]
        columns = np.column_stack([np.cos(best * x), np.sin(best * x)])
        place = (f"wave number {best:.3g} {of}", "both")
        yield Block(name, columns, _always(*place), frequencies.size)


def _hats(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Piecewise linear functions (n, count) that sum to one, and their peaks."""
    low, high = np.quantile(x, (0.01, 0.99))
    peaks = np.linspace(low, high, count) if high - low > 1e-9 else np.array([low])
    if peaks.size == 1:
        return np.ones((x.size, 1)), peaks
    width = peaks[1] - peaks[0]
    return np.maximum(0.0, 1.0 - np.abs(np.clip(x, low, high)[:, None] - peaks) / width), peaks


def _always(place: str, direction: str) -> Where:
    return lambda coefficients: (place, direction)


def _peak(peaks: np.ndarray, what: str, of: str) -> Where:
    """Place of the peak at which the coefficients are largest."""

    def where(coefficients: np.ndarray) -> tuple[str, str]:
        shape = coefficients - coefficients.mean() if coefficients.size > 1 else coefficients
        i = int(np.argmax(np.abs(shape)))
        return f"{what} near {peaks[i]:.3g} {of}", "+" if shape[i] > 0 else "-"

    return where
