"""Robust loss of a joint's residual, and when one fit beats another by more than its noise could explain."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.robust import deviation, huber_loss, huber_weights

HUBER = 2.5  # noise deviations beyond which a sample counts linearly
SMALLEST_NOISE = 5e-5  # [rad], [m]: no log is believed more exactly
EVIDENCE = 30.0  # least gain of the loss in units of the noise, for an effect or a further one
ONE_WINDOW = 12.0  # the same without the window that gains most: one glitch names nothing
FLOOR = 5e-4  # [rad], [m] rms movement below which nothing is named
UNIQUE = 3.5e-4  # [rad], [m] rms of it that no other effect takes over
CORRELATED = 0.3  # [s] over which noise may remember itself


def weights(r: Float[np.ndarray, " n"], sigma: float) -> Float[np.ndarray, " n"]:
    """Weight of each residual in least squares."""
    return huber_weights(np.abs(r), HUBER * sigma)


def loss(r: Float[np.ndarray, " n"], sigma: float) -> Float[np.ndarray, " n"]:
    """Huber's loss of each residual in squared noise deviations."""
    return huber_loss(np.abs(r) / sigma, HUBER)


def scale(r: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of the noise, from the median."""
    return max(float(deviation(r)), SMALLEST_NOISE)


def rms(x: Float[np.ndarray, ...]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x * x)))


class Judge:
    """Noise of a joint's residual: its deviation, and what its memory adds to the variance of a sum."""

    def __init__(self, log: JointLog, residual: np.ndarray):
        self.log, self.sigma = log, scale(residual)
        # A smooth effect sums the noise over neighbouring samples: its variance grows by the noise's memory.
        e = residual * weights(residual, self.sigma)
        spacing = (log.time[-1] - log.time[0]) / max(log.time.size - 1, 1)
        most = min(max(int(CORRELATED / spacing), 1), e.size // 4)
        lags = np.arange(1, most + 1)
        power = e @ e + 1e-300
        memory = np.array([e[k:] @ e[:-k] for k in lags]) / power
        self.inflation = max(1.0, 1.0 + 2.0 * float(np.sum((1.0 - lags / (most + 1)) * memory)))
        self.inflation *= max(1.0, power / e.size / self.sigma**2)

    def gain(self, worse: np.ndarray, better: np.ndarray) -> tuple[float, float]:
        """Gain of the loss over the noise, in all and without the window that gains most."""
        return self._in_all(loss(worse, self.sigma) - loss(better, self.sigma))

    def convincing(self, worse: np.ndarray, better: np.ndarray) -> bool:
        """True if the better residual (n,) speaks for its model."""
        total, rest = self.gain(worse, better)
        return total > EVIDENCE and rest > ONE_WINDOW and rms(worse - better) > UNIQUE

    def visible(self, change: np.ndarray) -> bool:
        """True if a change (n,) of the predicted positions would show in this noise."""
        total, rest = self._in_all(change * change / self.sigma**2)
        return rms(change) > FLOOR and total > EVIDENCE and rest > ONE_WINDOW

    def _in_all(self, gains: np.ndarray) -> tuple[float, float]:
        windows = np.add.reduceat(gains, self.log.starts) / self.inflation
        return float(windows.sum()), float(windows.sum() - windows.max())
