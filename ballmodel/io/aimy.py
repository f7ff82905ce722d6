"""Launcher trajectories of Intelligent Soft Robots, Max Planck Institute (BSD-3-Clause).

HDF5 with ``/originals/<i>/{time_stamps [s] (n,), positions [m] (n, 3), velocities, launch_param}``. Their x is the
direction of flight, y points to its left, z up; they name no origin. Into the table frame (balls fly towards -y):

    x = y_aimy                     the lateral origin is kept
    y = TABLE_LENGTH / 2 - x_aimy  recorded x runs from 0.00 to 2.74 m, the table's length: launcher at its end
    z = z_aimy - 0.740             the lowest ball centre of all recordings is 0.760 m, one radius above the table

Spin was not measured; the filtered ``velocities`` are not used.
"""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np

from ballmodel.constants import BALL_RADIUS, TABLE_LENGTH
from ballmodel.trajectory import Dataset, Trajectory

LOWEST_CENTRE = 0.760  # [m]


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
            position = np.stack([y, TABLE_LENGTH / 2 - x, z - (LOWEST_CENTRE - BALL_RADIUS)])
            try:
                trajectories.append(Trajectory(Path(path).stem, name, group["time_stamps"][()], position))
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None
    return Dataset(tuple(trajectories), str(path))
