"""Prediction of a ball's way from the first part of its track, with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Trajectory
from mjx_tt.prediction.state_fit import SpinPrior, fit_states, fly_on
from mjx_tt.sim.model import SimModel


def predict(
    track: Trajectory,
    model: SimModel | None = None,
    horizon: float | Sequence[float] = 0.3,
    prior: SpinPrior | None = None,
    noise: float | None = None,
) -> tuple[Float[np.ndarray, "3 h"], Float[np.ndarray, "3 3 h"]]:
    """Places [m] of the ball ``horizon`` [s] after the track's last sample, and their covariances [m^2].

    track: samples of one flight so far, in the table frame, bounces on the table included. model: the nominal one
    without. prior: of the ball's spin, which is estimated with its start; people's spins without. noise: [m] of a
    coordinate, estimated from the track without. The covariance is that of the ball's place, from the posterior of
    start and spin; a measurement of it adds its noise. Raises ValueError for fewer than four samples or a horizon that
    is not ahead.
    """
    ahead = np.atleast_1d(np.asarray(horizon, np.float64))
    if ahead.ndim != 1 or not np.all(np.isfinite(ahead)) or np.any(ahead <= 0.0) or np.any(np.diff(ahead) <= 0.0):
        raise ValueError(f"horizon {ahead.tolist()}: increasing seconds above 0 are wanted")
    fitted = fit_states([track], model or SimModel(), prior, noise=noise)
    flown, derivative = fly_on(fitted, (track.time[-1] - track.time[0] + ahead)[:, None])
    slope = derivative[:, :, :, 0]
    covariance = np.einsum("ati,ij,btj->abt", slope, fitted.covariance[0], slope)
    return flown.position[:, 1:, 0, 0], covariance
