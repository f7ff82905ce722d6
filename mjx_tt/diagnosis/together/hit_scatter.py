"""Scatter from hit to hit: delays that each hit has of its own, and what is left of six numbers beside them.

Ball, arm and axes are late by another time in every episode (the paper's table of latencies has deviations of 8 to
9 ms), which moves the paddle against the ball by a centimetre and more. A robot that plays sees the same late ball, so
how late a hit is and how the paddle moves at it go together: taken for noise, it leads the mean delays and the rubber
astray. So each hit has two unknowns, ball and axes against the arm, about which only their covariance is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.hits.diagnose import HUBER, spread
from mjx_tt.diagnosis.robust import huber_weights
from mjx_tt.sim.model import LatencyParams

ROUNDS = 12  # of expectation and maximisation
LEAST, MOST = 0.2, 2.0  # times the believed deviations: what delays of hits may scatter by
RIDGE = 0.05  # of each number's own variance


@dataclass(frozen=True)
class HitScatter:
    """Covariances of what hits scatter by, and how much each hit counts."""

    left: Float[np.ndarray, "6 6"]  # of place [m] and velocity [m/s] behind the paddle
    delays: Float[np.ndarray, "2 2"]  # [s^2] of ball and axes against the arm
    weight: Float[np.ndarray, " n"]

    def covariance(self, slopes: Float[np.ndarray, "2 6 n"]) -> Float[np.ndarray, "n 6 6"]:
        """Of a hit's six numbers, delays and all. slopes: [m/s], [m/s^2] of the six numbers by the two delays."""
        return self.left + np.einsum("kcn,kl,ldn->ncd", slopes, self.delays, slopes)

    def gain(self, slopes: Float[np.ndarray, "2 6 n"]) -> Float[np.ndarray, "n 2 6"]:
        """Delays of a hit per unit of each of its six numbers, as Kalman's gain has it."""
        return np.einsum("kl,lcn->nkc", self.delays, slopes) @ np.linalg.inv(self.covariance(slopes))

    def own(self, y: Float[np.ndarray, "6 n"], slopes: Float[np.ndarray, "2 6 n"]) -> Float[np.ndarray, "2 n"]:
        """Each hit's delays [s], as far as they show: the mean of their posterior."""
        return np.einsum("nkc,cn->kn", self.gain(slopes), y)


def believed_delays(latency: LatencyParams) -> Float[np.ndarray, "2 2"]:
    """Covariance [s^2] of the delays of ball and axes against the arm's, from hit to hit."""
    ball, arm, axes = (
        float(np.mean(std)) ** 2
        for std in (latency.ball_observation_std, latency.abb_observation_std, latency.festo_observation_std)
    )
    return np.array([[ball + arm, arm], [arm, axes + arm]])


def scatter(
    y: Float[np.ndarray, "6 n"], slopes: Float[np.ndarray, "2 6 n"], believed: Float[np.ndarray, "2 2"]
) -> HitScatter:
    """The scatter of residuals by expectation and maximisation, outliers with Huber's weights.

    y: what remains of hits, delays of their own included; believed: covariance of these, of which the hits say how
    large it is, not of what shape.
    """
    root, weight = spread(y)
    left, size = np.linalg.inv(root.T @ root), 1.0
    inverse = np.linalg.inv(believed + 1e-12 * np.eye(2))
    for _ in range(ROUNDS):
        now = HitScatter(left, size * believed, weight)
        own = now.own(y, slopes)
        open_ = now.delays - np.einsum("nkc,lcn,lm->nkm", now.gain(slopes), slopes, now.delays)  # (n, 2, 2)
        rest = y - np.einsum("kn,kcn->cn", own, slopes)
        distance = np.sqrt(np.einsum("cn,ncd,dn->n", y, np.linalg.inv(now.covariance(slopes)), y))
        weight = huber_weights(distance, HUBER)
        bounded = weight**2  # so that a hit beside all others adds at most HUBER^2 (Maronna's M-estimate)
        left = (rest * bounded) @ rest.T + np.einsum("kcn,nkl,ldn,n->cd", slopes, open_, slopes, bounded)
        left = left / bounded.sum()
        left = left + RIDGE * np.diag(np.diagonal(left))
        expected = np.einsum("kn,kl,ln->n", own, inverse, own) + np.einsum("kl,nlk->n", inverse, open_)
        size = float(np.clip((bounded * expected).sum() / (2.0 * bounded.sum()), LEAST**2, MOST**2))
    return HitScatter(left, size * believed, weight)
