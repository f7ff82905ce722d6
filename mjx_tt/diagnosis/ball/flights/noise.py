"""Measurement noise as the residuals show it: its scale, its memory, its outliers, and shaking time stamps.

An honest noise model decides whether "something is wrong" means anything: trackers filter, so their noise remembers
itself; it grows with distance; some samples are plain wrong. Scale and memory are estimated from the residuals,
outliers are weighted down by Huber's rule, and every test downstream takes its spread from ball to ball.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np

from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.robust import GAUSSIAN, OUTLIER, huber_weights

HUBER = 3.0  # whitened distance beyond which a sample counts linearly; a Gaussian's is beyond it in 3 % of cases
JITTER_Z = 4.5  # standard errors of a jitter of the time stamps
LEAST_SHARE = 0.7  # of the noise along the flight beyond that across it which must grow with the speed's square
NOMINAL_SCALE = 0.003  # [m] before anything is known
LARGEST_MEMORY = 0.97
ALIKE = np.zeros(3)  # [m/s]: no bounce has a kick of its own
LEAST_SCATTER = 1e-4  # [m/s] of bounces, where they scatter at all


@dataclass(frozen=True)
class Noise:
    """Noise of n balls: a first-order autoregression along the flight, across it, and upright to both.

    Time stamps that shake make noise along the flight: in the table's axes it would leak into every one.
    """

    frame: np.ndarray  # (3, 3, T, n) unit vectors: axis, component
    scale: np.ndarray  # (3, n) [m] standard deviation of a sample along each axis
    memory: np.ndarray  # (3,) correlation of neighbouring samples
    interval: float  # [s] usual time between neighbours
    # (3,) [m/s] deviation of what a bounce adds to a ball's velocity beside the model, along the axes of its spin:
    # across its way, against it, up. Zero where all bounces are alike.
    scatter: np.ndarray = field(default_factory=ALIKE.copy)


def nominal_noise(g: Grid) -> Noise:
    """Independent noise of NOMINAL_SCALE."""
    frame = np.broadcast_to(np.eye(3)[:, :, None, None], (3, 3, *g.time.shape))
    return Noise(frame, np.full((3, g.n), NOMINAL_SCALE), np.zeros(3), _interval(g))


def flight_frame(velocity: np.ndarray) -> np.ndarray:
    """(3, 3, T, n) axes of flights with velocities (3, T, n): along, across (level), upright to both."""
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=0), 1e-9)
    across = np.stack([-along[1], along[0], np.zeros_like(along[0])])
    across = across / np.maximum(np.linalg.norm(across, axis=0), 1e-9)
    return np.stack([along, across, np.cross(along, across, axis=0)])


def _interval(g: Grid) -> float:
    gaps = np.diff(g.time, axis=0)[g.mask[1:] & (np.diff(g.time, axis=0) > 0.0)]
    return float(np.median(gaps)) if gaps.size else 1.0


def estimate(residual: np.ndarray, frame: np.ndarray, g: Grid, unknowns: int = 6) -> Noise:
    """Noise of residuals (3, T, n) after a fit of ``unknowns`` numbers to each ball, along the axes of ``frame``."""
    residual = np.einsum("actn,ctn->atn", frame, residual)
    interval = _interval(g)
    samples = g.mask.sum(axis=0)
    freedom = np.sqrt(3.0 * samples / np.maximum(3.0 * samples - unknowns, 1.0))
    gaps = np.diff(g.time, axis=0)
    near = g.mask[1:] & g.mask[:-1] & (gaps < 1.5 * interval)
    masked = np.where(g.mask, residual, np.nan)
    steps = np.where(near, np.diff(residual, axis=1), np.nan)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a ball without neighbouring samples
        level = np.nanmedian(GAUSSIAN * np.nanmedian(np.abs(masked), axis=1) * freedom, axis=1)  # (3,)
        own = GAUSSIAN * np.nanmedian(np.abs(steps), axis=1) / np.sqrt(2.0)  # (3, n)
    # One axis against another, and one ball against another, by what neighbouring samples differ: noise does, a misfit
    # is smooth. An axis or a ball that the model does not fit must not hide behind a noise of its own.
    shared = np.nanmedian(own, axis=1, keepdims=True)
    shared = np.maximum(shared, 0.1 * np.sqrt(np.mean(shared**2)) + 1e-9)
    # A ball's own scale, shrunk to the others': it carries about as much information as half its samples.
    share = (samples / (samples + 20.0))[None]
    own = np.where(np.isfinite(own), own, shared)
    scale = np.exp(share * np.log(np.maximum(own, 1e-9)) + (1.0 - share) * np.log(shared))
    scale = np.maximum(scale, 0.3 * shared) * np.sqrt(np.mean(level**2) / np.mean(shared**2)) + 1e-7
    z = np.clip(np.where(g.mask, residual / scale[:, None], 0.0), -HUBER, HUBER)
    memory = np.zeros(3)
    for a in range(3):
        pairs, square = (z[a, 1:] * z[a, :-1])[near].sum(), 0.5 * ((z[a, 1:] ** 2 + z[a, :-1] ** 2)[near]).sum()
        r = pairs / max(square, 1e-12)
        # The fit takes a share of the slow part: 1 + 3 r over the number of samples is the usual correction.
        r = r + (1.0 + 4.0 * max(r, 0.0)) * (unknowns / 3.0) / max(float(samples.mean()), 1.0) * 0.5
        memory[a] = np.clip(r, 0.0, LARGEST_MEMORY)
    return Noise(frame, scale, memory, interval)


def surprise(residual: np.ndarray, bounce_time: np.ndarray, g: Grid) -> float:
    """Deviation [m] of what surprises a tracker's filter, by residuals (3, T, n) before the bounce (n,) [s].

    A filter's output has the variance K r, its surprises have r / (1 - K): between 2.0 and 2.3 of the output's
    deviation for gains K of 0.3 to 0.7. It is told by what neighbouring samples differ, which a misfit of the flight
    is not in; the output's memory of about a half makes that 1.4 times too small.
    """
    free = g.mask & (g.time < bounce_time)
    pairs = free[1:] & free[:-1]
    if not pairs.any():
        return g.surprise
    steps = np.median(np.abs(np.diff(residual, axis=1)[:, pairs]), axis=1)
    return 2.1 * 1.4 * GAUSSIAN / np.sqrt(2.0) * float(np.sqrt(np.mean(steps**2)))


def without_memory(noise: Noise, most: float = 0.0) -> Noise:
    """The noise with no more memory than ``most``.

    What a model does not explain yet is smooth along a flight and would pass for noise that remembers itself, which
    hides the very thing.
    """
    return replace(noise, memory=np.minimum(noise.memory, most))


class Whitening:
    """Turns columns (3, T, n) into units of independent noise, one at a time: so that each stays in the cache."""

    def __init__(self, noise: Noise, g: Grid) -> None:
        self._mask = g.mask
        self._turn = noise.frame / noise.scale[:, None, None]
        gap = np.zeros_like(g.time)
        gap[1:] = np.diff(g.time, axis=0) / noise.interval
        decay = np.where(g.mask, noise.memory[:, None, None] ** gap[None], 0.0)
        decay[:, 0] = 0.0
        self._decay = decay[:, 1:] if noise.memory.any() else None
        self._unit = np.where(g.mask, 1.0 / np.sqrt(1.0 - decay**2), 0.0)

    def __call__(self, column: np.ndarray) -> np.ndarray:
        """The column whitened; zero where there is no sample."""
        x = np.where(self._mask, column, 0.0)
        out = self._turn[:, 0] * x[0]
        for c in (1, 2):
            out += self._turn[:, c] * x[c]
        if self._decay is not None:
            out[:, 1:] -= self._decay * out[:, :-1]
        out *= self._unit
        return out

    def distance(self, residual: np.ndarray) -> np.ndarray:
        """(T, n) of each sample, in standard deviations."""
        return np.sqrt((self(residual) ** 2).sum(axis=0))

    def rows(self, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Whitened and weighted rows (n, 3 T, k) of columns (k, 3, T, n); weight: (n, T)."""
        balls, weight = self._mask.shape[1], weight.T
        out = np.empty((balls, len(x), 3 * len(self._mask)))
        for k, column in enumerate(x):
            out[:, k] = (self(column) * weight).reshape(-1, balls).T
        return out.swapaxes(1, 2)


def robust_weights(residual: np.ndarray, noise: Noise, g: Grid) -> np.ndarray:
    """Square roots (n, T) of Huber's weights of the samples."""
    return weights_at(Whitening(noise, g).distance(residual))


def weights_at(distance: np.ndarray) -> np.ndarray:
    """The same (n, T) at distances (T, n) in standard deviations."""
    return np.sqrt(huber_weights(distance, HUBER)).T


@dataclass(frozen=True)
class Jitter:
    """Deviation of the time stamps."""

    seconds: float
    low: float
    high: float
    shift: float  # [m] rms along the flight


def time_jitter(left: np.ndarray, velocity: np.ndarray, g: Grid) -> Jitter | None:
    """Jitter in residuals [m] of the best model; None where nothing grows with the speed.

    A moment's error dt shifts a sample by v dt; noise that is merely larger along the flight does not grow with speed.
    Neighbouring samples are subtracted from each other: what is smooth along the flight is a misfit, not a shaking
    clock.
    """
    near = g.mask[1:] & g.mask[:-1] & (np.diff(g.time, axis=0) < 1.5 * np.median(np.diff(g.time, axis=0)[g.mask[1:]]))
    step, mean = np.diff(left, axis=1) / np.sqrt(2.0), 0.5 * (velocity[:, 1:] + velocity[:, :-1])
    square = (mean**2).sum(axis=0)
    along = (step * mean).sum(axis=0) / np.sqrt(np.maximum(square, 1e-9))
    across = 0.5 * ((step**2).sum(axis=0) - along**2)
    cap = OUTLIER * np.median((step**2).sum(axis=0)[near])
    excess = np.where(near, np.minimum(along**2, cap) - np.minimum(across, cap), 0.0)
    count = near.sum(axis=0)
    design = np.stack([count, np.where(near, square, 0.0).sum(axis=0)])
    gram = np.array([[count.sum(), design[1].sum()], [design[1].sum(), np.where(near, square**2, 0.0).sum()]])
    right = np.array([excess.sum(), (excess * square).sum()])
    constant, slope = np.linalg.solve(gram, right)
    rest = np.where(near, excess - constant - slope * square, 0.0)
    scores = np.stack([rest.sum(axis=0), (rest * square).sum(axis=0)])
    inverse = np.linalg.inv(gram)
    error = float(np.sqrt((inverse @ scores @ scores.T @ inverse)[1, 1]))
    typical = float(np.median(square[near]))
    if slope < JITTER_Z * error or slope * typical < LEAST_SHARE * max(constant + slope * typical, 1e-12):
        return None
    low, high = (np.sqrt(max(slope + s * 1.645 * error, 0.0)) for s in (-1, 1))
    return Jitter(float(np.sqrt(slope)), float(low), float(high), float(np.sqrt(slope * typical)))
