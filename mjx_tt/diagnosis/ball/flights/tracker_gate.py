"""The surprise at which a tracker's filter starts afresh, looked for before anything else is.

Whether a bounce opens the filter depends on the gate by a threshold: from a wrong one no derivative leads to the right.
So a grid of memories and gates is flown, each ball's start and its bounce's own kick left free, so that a table that is
another one does not pass for a filter.
"""

from __future__ import annotations

import numpy as np

from mjx_tt.diagnosis.ball.flights.forward_model import predict
from mjx_tt.diagnosis.ball.flights.linearization import KICK, BallProblem, Linear, Situation

MEMORIES = (0.007, 0.010, 0.012, 0.0145, 0.0175, 0.021, 0.026)  # [s]
GATES = (0.015, 0.020, 0.025, 0.030, 0.036, 0.043, 0.052)  # [m]
LEAST_GAIN = 10.0  # of log-likelihood, below which no filter shows and any gate will do
TIME, GATE = "sensing.filter_time", "sensing.filter_gate"


def likeliest(problem: BallProblem, at: Situation, linear: Linear) -> tuple[float, float] | None:
    """The likeliest memory [s] and gate [m] of a tracker's filter; None where no filter shows."""
    g = problem.grid
    mask = np.broadcast_to(g.mask, linear.residual.shape)

    def rows(x: np.ndarray) -> np.ndarray:
        return np.moveaxis(np.where(mask, x, 0.0), -1, -3).reshape(*x.shape[:-3], g.n, -1)

    free = np.moveaxis(np.concatenate([rows(linear.starts[:6]), rows(linear.starts[KICK])]), 0, -1)
    q = np.linalg.qr(free / np.maximum(np.linalg.norm(free, axis=1, keepdims=True), 1e-12))[0]
    pairs = [(memory, gate) for memory in MEMORIES for gate in GATES]
    values = problem.values(np.repeat(at.theta[:, None, None], len(pairs), axis=1))
    values[TIME], values[GATE] = np.array(pairs).T[:, :, None]
    flown = predict(problem.model, values, np.repeat(at.start[:, None], len(pairs), axis=1), g, problem.axes)
    lags = np.moveaxis(flown.measured - linear.base.measured, 2, 0)
    left = rows(linear.residual) - np.concatenate([np.zeros((1, g.n, free.shape[1])), rows(lags)])
    left = left - np.einsum("nik,nsk->nsi", q, np.einsum("nik,sni->nsk", q, left)).swapaxes(0, 1)
    # Each ball's own noise is unknown, so that one that is fitted badly does not decide for all.
    cost = (1.5 * g.mask.sum(axis=0) * np.log(np.maximum((left**2).sum(axis=2), 1e-12))).sum(axis=1)
    best = int(np.argmin(cost[1:]))
    return pairs[best] if cost[0] - cost[1 + best] > LEAST_GAIN else None
