"""Chooses the reader of a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from ballmodel.io.messages import read_bag, read_mcap
from ballmodel.io.published import FIELDS, INDEX, MeasuredStates, read_aimy, read_deepmind, read_events, read_spindoe
from ballmodel.io.samples import Samples, TrackOptions, make_dataset
from ballmodel.io.tables import read_table
from ballmodel.trajectory import Dataset

FORMATS: dict[str, Callable[[Path], Dataset | MeasuredStates]] = {
    "deepmind": read_deepmind,
    "aimy": read_aimy,
    "spindoe": read_spindoe,
    "events": lambda path: read_events(path).shots(),
}
TRACKS: dict[str, Callable[[Path, TrackOptions], Samples]] = {"csv": read_table, "mcap": read_mcap, "bag": read_bag}
TABLES = (".csv", ".tsv", ".txt", ".json", ".jsonl", ".ndjson", ".npy", ".npz", ".parquet")
SUFFIXES = dict.fromkeys(TABLES, "csv") | {".mcap": "mcap", ".bag": "bag", ".hdf5": "aimy", ".h5": "aimy"}
GUESS = TrackOptions()


def read(path: str | os.PathLike, format: str | None = None, options: TrackOptions = GUESS) -> Dataset | MeasuredStates:
    """Reads measured balls: tracks from tables and message logs, AIMY and SpinDOE, start states from DeepMind's JSON
    and from Ace's events.

    Args:
        path: a file, or the folder of a ROS 2 bag or of flights with measured spin.
        format: a key of FORMATS or TRACKS; without it suffix and content decide.
        options: what is known of a table or a log; the rest is found out, and the data set's notes say what.

    Raises:
        ValueError: the format is unknown or the content malformed; names file and place, and says what to do.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    format = format or _find_format(path)
    if format in FORMATS:
        return FORMATS[format](path)
    if format not in TRACKS:
        raise ValueError(f"{path}: expected a format of {', '.join((*TRACKS, *FORMATS))}, got {format!r}")
    return make_dataset(TRACKS[format](path, options), str(path), options)


def _find_format(path: Path) -> str:
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "bag"
        if (path / INDEX).is_file():
            return "spindoe"
        raise ValueError(f"{path}: expected a file, a ROS 2 bag or a folder with {INDEX}; give its files one by one")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: suffix {suffix!r} is unknown; expected {', '.join(SUFFIXES)}, or name the format")
    with open(path, "rb") as file:
        head = file.read(4096)
    if suffix == ".json" and all(f'"{name}"'.encode() in head for name in FIELDS[:6]):
        return "deepmind"
    if suffix == ".csv" and b"ball_spin_out" in head:
        return "events"
    return "spindoe" if path.name == INDEX and b"traj_file" in head else SUFFIXES[suffix]
