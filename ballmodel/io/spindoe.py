"""Flights with measured spin in the form of SpinDOE (cogsys-tuebingen/spindoe): a folder, one file per flight.

``index.csv`` names the files (traj_file) and their spins (x_spin, y_spin, z_spin [rad/s]); a flight's file holds
``t;x;y;z`` in seconds and metres, semicolons between, with or without a header. Balls fly towards -y; the table lies
20 mm below the ball's centre at the bounce. Samples whose time does not increase are left out.
"""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Dataset, Trajectory

INDEX = "index.csv"
SPINS = ("x_spin", "y_spin", "z_spin")


@dataclass(frozen=True)
class SpinDataset(Dataset):
    """Trajectories whose spins were measured."""

    spin: Float[np.ndarray, "3 n"]  # [rad/s]
    repeated: int  # samples left out, whose time did not increase


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
    trajectories, spins, repeated = [], [], 0
    for number, row in enumerate(rows, start=2):
        try:
            spins.append([float(row[name]) for name in SPINS])
        except (TypeError, ValueError):
            raise ValueError(
                f"{index}: row {number}: three numbers of rad/s are wanted as {', '.join(SPINS)}"
            ) from None
        file_path = index.parent / row["traj_file"].strip()
        table = _table(file_path)
        later = np.concatenate([[True], np.diff(np.maximum.accumulate(table[:, 0])) > 0.0])
        repeated += int((~later).sum())
        try:
            trajectories.append(Trajectory(index.parent.name, file_path.stem, table[later, 0], table[later, 1:].T))
        except ValueError as error:
            raise ValueError(f"{file_path}: {error}") from None
    return SpinDataset(tuple(trajectories), str(index.parent), np.array(spins).T, repeated)


def _table(path: Path) -> Float[np.ndarray, "n 4"]:
    """Rows t, x, y, z of a flight's file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, though the index names it")
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        fields = [field.strip() for field in line.replace(",", ";").split(";") if field.strip()]
        try:
            rows.append([float(field) for field in fields[:4]])
        except ValueError:
            if number > 1:
                raise ValueError(f"{path}: row {number}: numbers t;x;y;z are wanted, got {line!r}") from None
            continue
        if len(fields) < 4:
            raise ValueError(f"{path}: row {number}: four numbers t;x;y;z are wanted, got {line!r}")
    if not rows:
        raise ValueError(f"{path}: no sample")
    return np.array(rows)
