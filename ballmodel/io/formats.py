"""Chooses the reader of a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from ballmodel.io.aimy import read_aimy
from ballmodel.io.csv import read_csv
from ballmodel.io.deepmind import MeasuredStates, read_deepmind
from ballmodel.io.mcap import read_mcap
from ballmodel.io.spindoe import read_spindoe
from ballmodel.trajectory import Dataset

FORMATS: dict[str, Callable[[Path], Dataset | MeasuredStates]] = {
    "csv": read_csv,
    "mcap": read_mcap,
    "deepmind": read_deepmind,
    "aimy": read_aimy,
    "spindoe": read_spindoe,
}
SUFFIXES = {".csv": "csv", ".mcap": "mcap", ".json": "deepmind", ".hdf5": "aimy", ".h5": "aimy"}


def read(path: str | os.PathLike, format: str | None = None) -> Dataset | MeasuredStates:
    """Reads measured balls: trajectories from CSV, MCAP, AIMY and SpinDOE, start states from a DeepMind JSON.

    ``format`` is a key of FORMATS; without it the file's suffix decides. Raises ValueError for an unknown format or
    suffix and for malformed content, FileNotFoundError when there is no such file.
    """
    path = Path(path)
    if format is None:
        format = SUFFIXES.get(path.suffix.lower())
        if format is None:
            raise ValueError(
                f"{path}: suffix {path.suffix!r} is unknown; known: {', '.join(SUFFIXES)}, or name the format"
            )
    if format not in FORMATS:
        raise ValueError(f"{path}: format {format!r} is unknown; known: {', '.join(FORMATS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return FORMATS[format](path)
