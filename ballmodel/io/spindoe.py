"""Flights with measured spin in the form of SpinDOE (cogsys-tuebingen/spindoe): a folder, one file per flight.

``index.csv`` names the files (traj_file) and their spins (x_spin, y_spin, z_spin [rad/s]); a flight's file holds
``t;x;y;z`` in seconds and metres, with or without a header. An index may say 0 where the file is 000.csv, in its own
folder or in one below it. Balls fly towards -y; the table lies 20 mm below the ball's centre at the bounce.
"""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballmodel.io.samples import TrackOptions, make_dataset
from ballmodel.io.tables import read_table
from ballmodel.trajectory import Dataset, Trajectory

INDEX = "index.csv"
SPINS = ("x_spin", "y_spin", "z_spin")
UNITS = TrackOptions(length="m", time="s")


@dataclass(frozen=True)
class SpinDataset(Dataset):
    """Trajectories whose spins were measured."""

    spin: Float[np.ndarray, "3 n"] = field(default_factory=lambda: np.zeros((3, 0)))  # [rad/s]


def read_spindoe(path: str | os.PathLike) -> SpinDataset:
    """Reads a folder, or its index.csv. Raises ValueError naming file and row, FileNotFoundError for a missing file."""
    index = Path(path) / INDEX if Path(path).is_dir() else Path(path)
    if not index.is_file():
        raise FileNotFoundError(f"{index}: no such file; in SpinDOE's form a folder of flights has one")
    delimiter = ";" if ";" in index.read_text(encoding="utf-8-sig").partition("\n")[0] else ","
    with open(index, newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file, delimiter=delimiter))
    missing = [name for name in ("traj_file", *SPINS) if not rows or name not in rows[0]]
    if missing:
        raise ValueError(f"{index}: column {', '.join(missing)} is missing; wanted: traj_file, {', '.join(SPINS)}")
    trajectories: list[Trajectory] = []
    spins: list[list[float]] = []
    notes: dict[str, None] = {}
    for number, row in enumerate(rows, start=2):
        try:
            spins.append([float(row[name]) for name in SPINS])
        except (TypeError, ValueError):
            raise ValueError(
                f"{index}: row {number}: three numbers of rad/s are wanted as {', '.join(SPINS)}"
            ) from None
        flown = _find_file(index.parent, row["traj_file"].strip())
        flight = make_dataset(read_table(flown, UNITS), str(flown), UNITS)
        longest = max(flight, key=len)
        trajectories.append(Trajectory(index.parent.name, flown.stem, longest.time, longest.position))
        notes |= {f"{flown.name}: {note}": None for note in flight.notes}
    return SpinDataset(tuple(trajectories), str(index.parent), tuple(notes), np.array(spins).T)


def _find_file(folder: Path, name: str) -> Path:
    """A flight's file as the index names it: by its whole name, or by its number."""
    if (folder / name).is_file():
        return folder / name
    found = [
        p
        for p in sorted(folder.rglob("*.csv"))
        if p.name == name or (p.stem.isdigit() and p.stem.lstrip("0") == name.lstrip("0"))
    ]
    if len(found) != 1:
        raise FileNotFoundError(f"{folder / name}: no such file, though the index names it")
    return found[0]
