"""Prediction of a ball's way from the first part of its track, with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Trajectory
from mjx_tt.prediction.flight_fit import Belief, fit_states, fly_on
from mjx_tt.sim.model import SimModel


def predict(
    track: Trajectory, model: SimModel | Belief | None = None, horizon: float | Sequence[float] = 0.3
) -> tuple[Float[np.ndarray, "3 h"], Float[np.ndarray, "3 3 h"]]:
    """Places [m] of the ball ``horizon`` [s] after the track's last sample, and their covariances [m^2].

    track: samples of one flight so far, in the table frame, bounces on the table included. model: the nominal one
    without; a Belief, as ``learn`` makes it of other flights, holds spins, scatter of bounces, and calibrated regions
    as well. The covariance is that of a sample measured there. Raises ValueError for fewer than four samples or a
    horizon that is not ahead.
    """
    ahead = np.atleast_1d(np.asarray(horizon, np.float64))
    if ahead.ndim != 1 or not np.all(np.isfinite(ahead)) or np.any(ahead <= 0.0) or np.any(np.diff(ahead) <= 0.0):
        raise ValueError(f"horizon {ahead.tolist()}: increasing seconds above 0 are wanted")
    belief = model if isinstance(model, Belief) else Belief.of(model or SimModel())
    flown, covariance = fly_on(fit_states([track], belief), (track.time[-1] - track.time[0] + ahead)[:, None])
    return flown.position[:, 1:, 0, 0], np.moveaxis(covariance[0], 0, 2)
