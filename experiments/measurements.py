"""Files of measured balls: several read as one data set, and a data set written as CSV."""

from __future__ import annotations

import csv
from pathlib import Path

from ballmodel.io import MeasuredStates, read
from ballmodel.io.atomic_files import replacing
from ballmodel.io.csv import COLUMNS
from ballmodel.trajectory import Dataset
from experiments.errors import ConfigError, checked


def read_all(paths: list[str], format: str | None) -> Dataset | MeasuredStates:
    """The balls of several files together. Raises ConfigError for files that hold different kinds of measurements."""
    parts = [checked("", read, path, format) for path in paths]
    source = ", ".join(part.source for part in parts)
    datasets = [part for part in parts if isinstance(part, Dataset)]
    if len(datasets) == len(parts):
        return Dataset(tuple(trajectory for part in datasets for trajectory in part), source)
    if len(parts) == 1:
        return parts[0]
    kinds = ", ".join(
        f"{path}: {'trajectories' if isinstance(p, Dataset) else 'states'}"
        for path, p in zip(paths, parts, strict=True)
    )
    raise ConfigError(f"several files must all hold trajectories ({kinds}); fit the others one by one")


def read_trajectories(paths: list[Path]) -> Dataset:
    """Trajectories of several files together. Raises ConfigError as ``read_all`` does, and for start states."""
    measured = read_all([str(path) for path in paths], None)
    if not isinstance(measured, Dataset):
        raise ConfigError(f"{measured.source}: holds start states; measured trajectories are needed")
    return measured


def write_csv(path: Path, dataset: Dataset) -> None:
    """Writes ``session,trajectory,t,x,y,z``, which ``ballmodel.io.read_csv`` reads back exactly."""
    with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for trajectory in dataset:
            rows = zip(trajectory.time, *trajectory.position, strict=True)
            writer.writerows((trajectory.session, trajectory.name, *(repr(float(v)) for v in row)) for row in rows)
