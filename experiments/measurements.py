"""Files of measured balls: several read as one data set, and a data set written as CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballmodel.io import MeasuredStates, TrackOptions, read
from ballmodel.io.atomic_files import replacing
from ballmodel.io.formats import GUESS
from ballmodel.io.tables import COLUMNS
from ballmodel.trajectory import Dataset, Trajectory
from experiments.errors import ConfigError, error_context
from mjx_tt import diagnosis
from mjx_tt.diagnosis.ball.diagnose import FEWEST_BALLS, flights
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.diagnosis.tracks.chains import take_apart
from mjx_tt.diagnosis.tracks.frame import align
from mjx_tt.prediction.flight_fit import fit_states, learn
from mjx_tt.sim.model import SimModel

LEAST_SAMPLES = 8  # of a stroke whose start and spin are fitted


def read_all(
    paths: list[str], format: str | None, options: TrackOptions = GUESS, frame: str | None = None
) -> Dataset | MeasuredStates:
    """The balls of several files together.

    Args:
        paths: the files.
        format: of all of them; None: as suffix and content say.
        options: what is known of tables and logs.
        frame: of tracks, which are then brought into the table frame; "auto": found out; None: they stay as they are.

    Raises:
        ConfigError: a file is not as it should be, or the files hold different kinds of measurements.
    """
    with error_context():
        parts = [read(path, format, options) for path in paths]
    source = ", ".join(part.source for part in parts)
    datasets = [part for part in parts if isinstance(part, Dataset)]
    if len(datasets) == len(parts):
        notes = tuple(f"{part.source}: {note}" for part in datasets for note in part.notes)
        tracks = tuple(trajectory for part in datasets for trajectory in part)
        if frame is not None and max(map(len, tracks)) >= LEAST_SAMPLES:
            with error_context():
                tracks, moved = align(tracks, source, None if frame == "auto" else frame)
            notes += moved
        return Dataset(tracks, source, notes)
    if len(parts) == 1:
        return parts[0]
    kinds = ", ".join(
        f"{path}: {'trajectories' if isinstance(p, Dataset) else 'states'}"
        for path, p in zip(paths, parts, strict=True)
    )
    raise ConfigError(f"several files must all hold trajectories ({kinds}); fit the others one by one")


def read_trajectories(
    paths: Iterable[str | Path], format: str | None = None, options: TrackOptions = GUESS, frame: str | None = None
) -> Dataset:
    """Trajectories of several files together. Raises ConfigError as ``read_all`` does, and for start states."""
    measured = read_all([str(path) for path in paths], format, options, frame)
    if not isinstance(measured, Dataset):
        raise ConfigError(f"{measured.source}: holds start states; measured trajectories are needed")
    return measured


def start_states(
    measured: Dataset, model: SimModel | None, say: Callable[[str], None] | None = None
) -> tuple[MeasuredStates, SimModel, list[str]]:
    """Start states of the strokes in measured tracks, with spins where the ball is lifted, and with measured landings.

    Args:
        measured: tracks in the table frame.
        model: in which they fly; None: the nominal one, as their own diagnosis extends it.
        say: is told what goes on.

    Returns:
        States, the model, and a summary.

    Raises:
        ConfigError: no stroke is left.
    """
    strokes, record = clean(measured.trajectories)
    strokes = tuple(t for t in strokes if len(t) >= LEAST_SAMPLES)
    if not strokes:
        raise ConfigError(f"{measured.source}: no stroke of {LEAST_SAMPLES} samples among {len(measured)} tracks")
    lines = record.lines()
    if model is None and len(flights(strokes)) < FEWEST_BALLS:
        model = SimModel()
        lines.append(f"flown in the nominal model: a diagnosis needs {FEWEST_BALLS} strokes")
    elif model is None:
        with error_context(measured.source):
            found = diagnosis.diagnose(diagnosis.Logs(strokes, (), {}), progress=say)
        model = found.extended.model
        named = ", ".join(cause.name for cause in found.verdict.causes) or "the nominal model"
        lines.append(f"flown as these strokes' own diagnosis says: {named}")
    belief = learn(strokes, model)
    fitted = fit_states(strokes, belief)
    lines.append(f"{len(strokes)} strokes of {len(measured)} tracks; noise {1e3 * fitted.noise:.1f} mm")
    if belief.spins is not None:
        low, middle, high = np.percentile(np.linalg.norm(fitted.start.spin, axis=0), [5, 50, 95])
        lines.append(f"spin {middle:.0f} rad/s in the median, {low:.0f} to {high:.0f} in 90 % of them")
    landing = np.stack([_landing(t) for t in strokes], axis=1)
    return MeasuredStates(np.arange(len(strokes)), fitted.start, measured.source, landing), model, lines


def _landing(stroke: Trajectory) -> Float[np.ndarray, 2]:
    """Place [m] of a stroke's first bounce on the table, NaN where none was measured."""
    met = (j.place[:2] for chain in take_apart(stroke).chains for j in chain.junctions if j.met == "table")
    return next(met, np.full(2, np.nan))


def write_csv(path: Path, dataset: Dataset) -> None:
    """Writes ``session,trajectory,t,x,y,z``, which ``ballmodel.io.read`` reads back exactly."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for trajectory in dataset:
            rows = zip(trajectory.time, *trajectory.position, strict=True)
            writer.writerows((trajectory.session, trajectory.name, *(repr(float(v)) for v in row)) for row in rows)
