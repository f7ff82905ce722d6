"""Arcs: the runs of a track's samples that one ball can have flown without touching anything.

A Kalman filter of constant acceleration follows every arc, its covariance shared by the three axes, so nothing here
depends on how the frame is turned. A sample goes to the arc that expects it; one that no arc expects opens an arc of
its own. A bounce or a racket thus ends one arc and opens the next, a second ball in the same track has arcs beside the
first one's, and a wild sample stays alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from mjx_tt.sim.constant_acceleration import Covariance, correct_covariance, predict_covariance

GATE = 0.030  # [m] from where an arc expects it within which a sample belongs to it, however small the noise
GATE_SIGMA = 4.5  # and in standard deviations of the expectation
LEAST_NOISE, MOST_NOISE = 0.003, 0.020  # [m]; a track whose samples scatter by more holds two balls
MATURE = 5  # samples that make an arc
PATIENCE = 0.30  # [s] without a sample after which an arc is over
MISSES = 12  # samples of the track that went elsewhere, after which it is over
SPEED, ACCELERATION = 8.0, 12.0  # [m/s], [m/s^2] standard deviations of what is not known of a new arc
WANDER = 40.0  # [m^2/s^5] growth of the acceleration's variance
ENDS = 14  # samples at an arc's end that tell how it goes on
TRIMMED = 3  # samples at an arc's end that may belong to the next one


@dataclass
class _Filter:
    """Mean and covariance of position, velocity and acceleration along an arc."""

    samples: list[int]
    time: float
    x: Float[np.ndarray, "3"]
    noise: float  # [m^2] variance of a sample
    v: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    a: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    covariance: Covariance = field(init=False)
    missed: int = 0

    def __post_init__(self) -> None:
        self.covariance = (self.noise, 0.0, 0.0, SPEED**2, 0.0, ACCELERATION**2)

    def ahead(self, time: float) -> tuple[Float[np.ndarray, "3"], Covariance]:
        """Expected position at a time, and the covariance there."""
        d = time - self.time
        position = self.x + d * self.v + 0.5 * d * d * self.a
        return position, predict_covariance(self.covariance, d, WANDER)

    def take(self, sample: int, time: float, measured: np.ndarray, ahead: tuple[np.ndarray, Covariance]) -> None:
        """Moves on to a sample that belongs to the arc."""
        (expected, covariance), d = ahead, time - self.time
        innovation, (xx, xv, xa) = measured - expected, covariance[:3]
        gx, gv, ga = (each / (xx + self.noise) for each in (xx, xv, xa))
        self.covariance = correct_covariance(covariance, (gx, gv, ga), self.noise)
        self.v = self.v + d * self.a + gv * innovation
        self.a = self.a + ga * innovation
        self.x, self.time = expected + gx * innovation, time
        self.samples.append(sample)
        self.missed = 0


def noise_of(position: Float[np.ndarray, "3 n"]) -> float:
    """Standard deviation [m] of the samples, from third differences, which a smooth flight does not have."""
    if position.shape[1] < 8:
        return LEAST_NOISE
    middle = np.median(np.abs(np.diff(position, 3, axis=1)), axis=1) / (0.6745 * np.sqrt(20.0))
    return float(np.clip(middle.max(), LEAST_NOISE, MOST_NOISE))


def arcs(
    time: Float[np.ndarray, " n"], position: Float[np.ndarray, "3 n"], noise: float
) -> list[Int[np.ndarray, " k"]]:
    """Indices of the samples of each arc with at least MATURE samples, by their first; noise [m] of a sample."""
    flying: list[_Filter] = []
    over: list[_Filter] = []
    columns, moments = position.T, time.tolist()
    for i, (now, measured) in enumerate(zip(moments, columns, strict=True)):
        best, least = None, (True, math.inf)
        for arc in flying:
            ahead = arc.ahead(now)
            total = ahead[1][0] + arc.noise
            off = measured - ahead[0]
            square = float(off @ off)
            if square > max(GATE * GATE, GATE_SIGMA**2 * total):
                continue
            # Grown arcs first: a new one expects anything.
            rank = (len(arc.samples) < MATURE, square / total + 3.0 * math.log(total))
            if rank < least:
                best, least = (arc, ahead), rank
        if best is None:
            flying.append(_Filter([i], now, measured, noise * noise))
            chosen = flying[-1]
        else:
            chosen = best[0]
            chosen.take(i, now, measured, best[1])
        still: list[_Filter] = []
        for arc in flying:
            arc.missed += arc is not chosen
            patience = MISSES if len(arc.samples) >= MATURE else MATURE
            done = arc.missed > patience or now - arc.time > PATIENCE
            (over if done else still).append(arc)
        flying = still
    grown = [np.array(arc.samples) for arc in over + flying if len(arc.samples) >= MATURE]
    return sorted(grown, key=lambda samples: samples[0])


@dataclass(frozen=True)
class End:
    """Parabola along one end of an arc, about the time ``about`` [s]."""

    about: float
    coefficients: Float[np.ndarray, "3 3"]  # power of the time, axis

    @classmethod
    def of(cls, time: Float[np.ndarray, " k"], position: Float[np.ndarray, "3 k"], noise: float, last: bool) -> End:
        """Parabola along the last or the first samples; an acceleration beyond a ball's is not believed."""
        if last:
            trim = min(TRIMMED, max(len(time) - 2 * MATURE, 0))
            chosen = slice(max(len(time) - trim - ENDS, 0), len(time) - trim)
        else:
            chosen = slice(0, ENDS)
        t, p = time[chosen], position[:, chosen]
        about = float(t[-1] if last else t[0])
        powers = np.stack([np.ones_like(t), t - about, 0.5 * (t - about) ** 2], axis=1)
        prior = np.diag([0.0, (noise / 30.0) ** 2, (noise / ACCELERATION) ** 2])
        return cls(about, np.linalg.solve(powers.T @ powers + prior, powers.T @ p.T))

    def position(self, time: Float[np.ndarray, " m"] | float) -> Float[np.ndarray, "3 m"]:
        """Position [m] at the times."""
        d = np.atleast_1d(np.asarray(time, float)) - self.about
        return np.einsum("pa,pm->am", self.coefficients, np.stack([np.ones_like(d), d, 0.5 * d * d]))

    def velocity(self, time: float) -> Float[np.ndarray, "3"]:
        """Velocity [m/s] at a time."""
        return self.coefficients[1] + (time - self.about) * self.coefficients[2]
