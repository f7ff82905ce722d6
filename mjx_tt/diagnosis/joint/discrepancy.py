"""Discrepancy: functions without a name of position, velocity, acceleration, reversals and time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.inclusion import Family
from mjx_tt.diagnosis.joint.fit import Values
from mjx_tt.diagnosis.joint.log import JointLog

STEP = 0.005  # [s] of the grid on which the predicted motion is looked at
DECAYS = (0.03, 0.1, 0.3, 1.0, math.inf)  # [s] after a reversal
DELAYS = (*np.arange(0.0, 0.1, 0.02), *np.arange(0.1, 0.45, 0.04))  # [s] of a response to commands
USUAL = 2e-3  # [rad], [m] by which one of them moves a joint, as a root mean square
Named = tuple[str, np.ndarray, Sequence[str]]  # of a family: its name, columns (n, m) and their labels


def build(
    log: JointLog, values: Values, r: Float[np.ndarray, " n"], first: int
) -> tuple[tuple[Family, ...], Float[np.ndarray, "n m"]]:
    """All families and their columns [rad], [m] beside a fit whose residual is r. first: number of the first column."""
    motion = _Motion(log, values)
    position = log.measured - r  # with the noise in it, it would explain the noise
    families, every = [], []
    for name, columns, labels in (
        *_over_time(motion),
        *_over_motion(log, motion, position),
        *_waves(log, r, position),
    ):
        columns = log.centred(columns)
        size = np.sqrt(np.mean(columns**2, axis=0)).max(initial=0.0)
        if size > 1e-9:
            families.append(Family(name, "", first + np.arange(columns.shape[1]), tuple(labels), USUAL))
            every.append(columns / size)
            first += columns.shape[1]
    return tuple(families), np.concatenate(every, axis=1)


class _Motion:
    """The predicted motion of a joint on a fine grid (g,)."""

    def __init__(self, log: JointLog, values: Values) -> None:
        self.time = log.time
        self.grid = np.arange(log.time[0] - 0.5, log.time[-1] + 0.5, STEP)
        self.path = log.simulate(values, self.grid)
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


def _over_time(motion: _Motion) -> Iterator[Named]:
    seconds = motion.time - motion.time[0]
    yield "drift", seconds[:, None], ["velocity at all times"]
    stages, peaks = _hats(motion.grid - motion.grid[0], 7)
    when = [f"time in the log near {peak:.3g} s" for peak in peaks]
    yield "gain over time", motion.integrated(stages * motion.velocity[:, None]), when
    yield "delay over time", _hats(seconds, 7)[0] * motion.sampled(motion.velocity)[:, None], when


def _over_motion(log: JointLog, motion: _Motion, position: np.ndarray) -> Iterator[Named]:
    for name, values, here, count, unit in (
        ("velocity", motion.velocity, motion.sampled(motion.velocity), 9, f"{log.unit}/s"),
        ("acceleration", motion.acceleration, motion.sampled(motion.acceleration), 9, f"{log.unit}/s^2"),
        ("position", np.interp(motion.grid, motion.time, position), position, 11, log.unit),
    ):
        columns, peaks = _hats(here, count)
        yield name, columns, [f"{name} near {peak:.3g} {unit}" for peak in peaks]
        columns, peaks = _hats(values, 9)
        yield f"drive against {name}", motion.integrated(columns), [f"{name} near {peak:.3g} {unit}" for peak in peaks]
    held, since = motion.since_reversal(0.01 * max(log.fastest, 1e-9))
    columns = np.column_stack([motion.sampled(held * np.exp(-since / s)) for s in DECAYS])
    yield "reversal", columns, [f"decay after a reversal near {s:.3g} s" for s in DECAYS]
    columns = np.column_stack([*(motion.sampled(motion.velocity, d) for d in DELAYS), motion.sampled(motion.path)])
    yield "dynamics", columns, [f"response to the command after {d:.3g} s" for d in (*DELAYS, math.inf)]


def _waves(log: JointLog, r: np.ndarray, position: np.ndarray) -> Iterator[Named]:
    """The strongest of many waves in position, and in time."""
    for name, x, frequencies, unit in (
        ("ripple in position", position, np.geomspace(1.0, 300.0, 240), f"1/{log.unit}"),
        ("vibration", log.time - log.time[0], 2.0 * np.pi * np.geomspace(0.7, 45.0, 240), "rad/s"),
    ):
        phase = x[:, None] * frequencies
        power = (r @ np.cos(phase)) ** 2 + (r @ np.sin(phase)) ** 2
        best = frequencies[int(np.argmax(power))]
        yield name, np.column_stack([np.cos(best * x), np.sin(best * x)]), [f"wave number {best:.3g} {unit}"] * 2


def _hats(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Piecewise linear functions (n, count) that sum to one, and their peaks."""
    low, high = np.quantile(x, (0.01, 0.99))
    peaks = np.linspace(low, high, count) if high - low > 1e-9 else np.array([low])
    if peaks.size == 1:
        return np.ones((x.size, 1)), peaks
    width = peaks[1] - peaks[0]
    return np.maximum(0.0, 1.0 - np.abs(np.clip(x, low, high)[:, None] - peaks) / width), peaks
