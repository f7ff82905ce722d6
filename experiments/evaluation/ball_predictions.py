"""Predictions of a log's strokes as CSV, for ``mjx-tt predict``."""

from __future__ import annotations

from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from ballmodel.trajectory import Dataset
from experiments.errors import ConfigError
from experiments.runs import run_dir
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.prediction.flight_fit import Belief, fit_states, fly_on, learn
from mjx_tt.sim.model import SimModel

PAIRS = tuple(combinations_with_replacement(range(3), 2))
COLUMNS = ("session", "trajectory", "t", "x", "y", "z", "sd_x", "sd_y", "sd_z") + tuple(
    f"cov_{'xyz'[i]}{'xyz'[j]}" for i, j in PAIRS
)
FEWEST = 6  # samples of a stroke
FEWEST_STROKES = 12  # from which is learnt how balls spin and how far predictions miss


def write(path: Path, measured: Dataset, model: SimModel, horizons: tuple[float, ...], seen: float | None) -> list[str]:
    """Writes each stroke's places ``horizons`` [s] after the last sample seen; returns lines for people.

    Raises ConfigError where no stroke has samples enough.
    """
    strokes, record = clean(measured.trajectories)
    parts = [
        t if seen is None else t.part(0, int(np.searchsorted(t.time, t.time[0] + seen + 1e-9, "right")))
        for t in strokes
    ]
    parts = [t for t in parts if len(t) >= FEWEST]
    if not parts:
        raise ConfigError(f"{measured.source}: no stroke of {FEWEST} samples among {len(measured)} tracks")
    belief = learn(strokes, model, seen, horizons) if len(strokes) >= FEWEST_STROKES else Belief.of(model)
    fitted = fit_states(parts, belief)
    ahead = np.array([[t.time[-1] - t.time[0] + h for t in parts] for h in horizons])
    flown, covariance = fly_on(fitted, ahead)
    rows = []
    for n, t in enumerate(parts):
        for h in range(len(horizons)):
            place, spread = flown.position[:, 1 + h, 0, n], covariance[n, h]
            numbers = [t.time[0] + ahead[h, n], *place, *np.sqrt(np.diag(spread)), *(spread[p] for p in PAIRS)]
            rows.append([t.session, t.name, *(f"{v:.9g}" for v in numbers)])
    path.parent.mkdir(parents=True, exist_ok=True)
    run_dir.write_csv(path, COLUMNS, rows)
    return [*record.lines(), f"{path}: {len(parts)} strokes; noise {1e3 * fitted.noise:.1f} mm"]
