"""Reads measured balls: tracks in tables and message logs, and published data sets, by suffix and content.

The published forms, which are brought into the table frame (balls towards the robot fly along -y):

- DeepMind: D'Ambrosio et al., "Achieving Human Level Competitive Robot Table Tennis", ICRA 2025 (CC-BY-4.0). A JSON
  list of states right after a hit, in the table frame; their spin rests on their own fluid model and is probably about
  twice the true one.
- AIMY: launcher recordings of Intelligent Soft Robots, Max Planck Institute (BSD-3-Clause). HDF5 with
  ``/originals/<i>/{time_stamps [s] (n,), positions [m] (n, 3), velocities, launch_param}``; the filtered velocities are
  not used. Their x is the direction of flight, y points to its left, z up; they name no origin.
- SpinDOE (cogsys-tuebingen/spindoe): a folder whose ``index.csv`` names files (traj_file) and spins (x_spin, y_spin,
  z_spin [rad/s]); a file holds ``t;x;y;z`` in seconds and metres. An index may say 0 where the file is 000.csv, in its
  own folder or in one below it. The table lies 20 mm below the ball's centre at the bounce.
- Sony's Ace (SonyResearch/ace_public): one CSV of events with player_id, rally_id, type (shot, bounce or net, of which
  shot_p1 is one player's), timestamp, ball_pos, ball_vel_out, ball_spin_out, the last three bracketed triples in
  metres, m/s and rad/s. Their x points towards the human and z up.
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Bool, Float, Int

from ballmodel.constants import BALL_RADIUS, TABLE_LENGTH
from ballmodel.io.messages import read_bag, read_mcap
from ballmodel.io.samples import Samples, TrackOptions, make_dataset
from ballmodel.io.tables import read_table
from ballmodel.state import BallState
from ballmodel.trajectory import LARGEST_COORDINATE, Dataset, Trajectory

GUESS = TrackOptions()
FIELDS = tuple(f"{part}_{axis}" for part in ("pos", "vel", "w_vel") for axis in "xyz")  # DeepMind's
LOWEST_CENTRE = 0.760  # [m] of AIMY's balls: one radius above the table
INDEX = "index.csv"
SPINS = ("x_spin", "y_spin", "z_spin")
EVENTS = ("rally_id", "type", "timestamp", "ball_pos", "ball_vel_out", "ball_spin_out")
KINDS = ("shot", "bounce", "net")
LEAST_SPEED, LARGEST_SPEED = 0.2, 60.0  # [m/s] of a ball after an event
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan", re.IGNORECASE)


@dataclass(frozen=True)
class MeasuredStates:
    """Single ball states without a time series."""

    id: Int[np.ndarray, " n"]
    state: BallState  # (3, n) float64 NumPy arrays
    source: str
    landing: Float[np.ndarray, "2 n"] | None = None  # [m] of the bounce that was seen next, NaN where none was

    def __len__(self) -> int:
        return self.id.size


@dataclass(frozen=True)
class SpinDataset(Dataset):
    """Trajectories whose spins were measured."""

    spin: Float[np.ndarray, "3 n"] = field(default_factory=lambda: np.zeros((3, 0)))  # [rad/s]


@dataclass(frozen=True)
class Events:
    """Shots and bounces in the order of the file, in the table frame."""

    rally: tuple[str, ...]
    shot: Bool[np.ndarray, " n"]  # a bounce otherwise
    time: Float[np.ndarray, " n"]  # [s]
    state: BallState  # (3, n) after the event
    source: str

    def __len__(self) -> int:
        return self.time.size

    @property
    def landings(self) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Indices of the shots that a bounce of the same rally follows, and of these bounces."""
        shots = np.flatnonzero(self.shot[:-1] & ~self.shot[1:])
        same = np.array([self.rally[i] == self.rally[i + 1] for i in shots], bool)
        return shots[same], shots[same] + 1

    def shots(self) -> MeasuredStates:
        """The shots as start states, each with the place of the bounce that follows it."""
        every, (shots, bounces) = np.flatnonzero(self.shot), self.landings
        position, velocity, spin = map(np.asarray, (self.state.position, self.state.velocity, self.state.spin))
        landing = np.full((2, len(self)), np.nan)
        landing[:, shots] = position[:2, bounces]
        state = BallState(position[:, every], velocity[:, every], spin[:, every])
        return MeasuredStates(every, state, self.source, landing[:, every])


def read_deepmind(path: str | os.PathLike) -> MeasuredStates:
    """Reads the JSON. Raises ValueError naming file, entry (from 0) and field that is missing or no finite number."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: a list of ball states is wanted, each with id, {', '.join(FIELDS)}")
    names = (*FIELDS, "id")
    rows = np.empty((len(entries), len(names)))
    for i, entry in enumerate(entries):
        for k, name in enumerate(names):
            value = entry.get(name) if isinstance(entry, dict) else None
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise ValueError(f"{path}: entry {i}, field {name!r}: a finite number is wanted, got {value!r}")
            rows[i, k] = value
    return MeasuredStates(rows[:, -1].astype(int), BallState(*np.split(rows[:, :-1].T, 3)), str(path))


def read_aimy(path: str | os.PathLike) -> Dataset:
    """Reads a recording; the session is the file's stem, a trajectory's name its number.

    Raises ValueError naming file and group of what is missing or malformed.
    """
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path}: not readable as HDF5: {error}") from None
    trajectories = []
    with file:
        if "originals" not in file or not len(file["originals"]):
            raise ValueError(f"{path}: no group /originals with trajectories; found: {', '.join(file) or 'nothing'}")
        for name, group in sorted(file["originals"].items(), key=lambda item: (len(item[0]), item[0])):
            missing = [key for key in ("time_stamps", "positions") if key not in group]
            if missing:
                raise ValueError(f"{path}: /originals/{name} has no {' and no '.join(missing)}")
            positions = group["positions"][()]
            if positions.ndim != 2 or positions.shape[1] != 3:
                raise ValueError(f"{path}: /originals/{name}/positions has shape {positions.shape}, (n, 3) is wanted")
            x, y, z = positions.T
            # Recorded x runs from 0.00 to 2.74 m, the table's length, with the launcher at its end.
            position = np.stack([y, TABLE_LENGTH / 2 - x, z - (LOWEST_CENTRE - BALL_RADIUS)])
            try:
                trajectories.append(Trajectory(Path(path).stem, name, group["time_stamps"][()], position))
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
    return Dataset(tuple(trajectories), str(path))


def read_spindoe(path: str | os.PathLike) -> SpinDataset:
    """Reads a folder, or its index.csv. Raises ValueError naming file and row, FileNotFoundError for a missing file."""
    index = Path(path) / INDEX if Path(path).is_dir() else Path(path)
    if not index.is_file():
        raise FileNotFoundError(f"{index}: no such file; in SpinDOE's form a folder of flights has one")
    units = TrackOptions(length="m", time="s")
    trajectories: list[Trajectory] = []
    spins: list[list[float]] = []
    notes: dict[str, None] = {}
    for number, row in _read_rows(index, ("traj_file", *SPINS)):
        try:
            spins.append([float(row[name]) for name in SPINS])
        except (TypeError, ValueError):
            raise ValueError(
                f"{index}: row {number}: three numbers of rad/s are wanted as {', '.join(SPINS)}"
            ) from None
        flown = _find_file(index.parent, row["traj_file"].strip())
        flight = make_dataset(read_table(flown, units), str(flown), units)
        longest = max(flight, key=len)
        trajectories.append(Trajectory(index.parent.name, flown.stem, longest.time, longest.position))
        notes |= {f"{flown.name}: {note}": None for note in flight.notes}
    return SpinDataset(tuple(trajectories), str(index.parent), tuple(notes), np.array(spins).T)


def read_events(path: str | os.PathLike) -> Events:
    """Reads the CSV, without events that lack numbers or are no ball's.

    Raises ValueError naming file, row and column.
    """
    rows = list(_read_rows(path, EVENTS))
    unique = len({row["rally_id"] for _, row in rows}) == len(rows)  # match/rally/event
    rally, shot, numbers = [], [], []
    for number, row in rows:
        kind = row["type"].strip().lower().partition("_")[0]  # shot_p1: the first player's
        if kind not in KINDS:
            raise ValueError(f"{path}: row {number}, column 'type': {row['type']!r}; allowed: {', '.join(KINDS)}")
        if kind == "net":
            continue
        vectors = [[float(v) for v in NUMBER.findall(row[name])] for name in EVENTS[3:]]
        if any(len(v) not in (0, 3) for v in vectors):
            raise ValueError(f"{path}: row {number}: three numbers in brackets are wanted as {', '.join(EVENTS[3:])}")
        values = [float(row["timestamp"]), *(x for v in vectors for x in v or [np.nan] * 3)]
        speed, away = np.linalg.norm(values[4:7]), np.abs(values[1:4]).max()
        # A shot that does not move, or is somewhere else, stands for none: trackers write zeros or -1 for what is lost.
        if np.all(np.isfinite(values)) and LEAST_SPEED < speed < LARGEST_SPEED and away < LARGEST_COORDINATE:
            rally.append(row["rally_id"].rpartition("/")[0] if unique else row["rally_id"])
            shot.append(kind == "shot")
            numbers.append(values)
    if not numbers:
        raise ValueError(f"{path}: no event has all its numbers")
    time, *table = np.array(numbers).T
    position, velocity, spin = (np.stack([-y, x, z]) for x, y, z in (table[:3], table[3:6], table[6:]))
    return Events(tuple(rally), np.array(shot), time, BallState(position, velocity, spin), str(path))


def _read_rows(path: str | os.PathLike, wanted: tuple[str, ...]) -> Iterable[tuple[int, dict[str, str]]]:
    """The file's number of each row and its cells by the names of the header, which has the wanted ones."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        separator = ";" if ";" in file.readline() else ","
        file.seek(0)
        rows = list(csv.DictReader(file, delimiter=separator))
    missing = [name for name in wanted if not rows or name not in rows[0]]
    if missing:
        raise ValueError(f"{path}: column {', '.join(missing)} is missing; wanted: {', '.join(wanted)}")
    return enumerate(rows, start=2)


def _find_file(folder: Path, name: str) -> Path:
    """A flight's file as the index names it: by its whole name, or by its number."""
    if (folder / name).is_file():
        return folder / name
    number = name.lstrip("0")
    files = sorted(folder.rglob("*.csv"))
    found = [p for p in files if p.name == name or (p.stem.isdigit() and p.stem.lstrip("0") == number)]
    if len(found) != 1:
        raise FileNotFoundError(f"{folder / name}: no such file, though the index names it")
    return found[0]


FORMATS: dict[str, Callable[[Path], Dataset | MeasuredStates]] = {
    "deepmind": read_deepmind,
    "aimy": read_aimy,
    "spindoe": read_spindoe,
    "events": lambda path: read_events(path).shots(),
}
TRACKS: dict[str, Callable[[Path, TrackOptions], Samples]] = {"csv": read_table, "mcap": read_mcap, "bag": read_bag}
TABLES = (".csv", ".tsv", ".txt", ".json", ".jsonl", ".ndjson", ".npy", ".npz", ".parquet")
SUFFIXES = dict.fromkeys(TABLES, "csv") | {".mcap": "mcap", ".bag": "bag", ".hdf5": "aimy", ".h5": "aimy"}


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
