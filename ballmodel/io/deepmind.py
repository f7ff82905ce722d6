"""Ball states of D'Ambrosio et al., "Achieving Human Level Competitive Robot Table Tennis", ICRA 2025 (CC-BY-4.0).

A JSON list of states right after a hit, with position [m], velocity [m/s] and the authors' estimate of spin [rad/s], in
the table frame. The spin rests on their own fluid model and is probably about twice the true one.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ballmodel.state import BallState

VECTORS = {"position": "pos", "velocity": "vel", "spin": "w_vel"}
FIELDS = tuple(f"{prefix}_{axis}" for prefix in VECTORS.values() for axis in "xyz")


@dataclass(frozen=True)
class MeasuredStates:
    """Single ball states without a time series."""

    id: Int[np.ndarray, " n"]
    state: BallState  # (3, n) float64 NumPy arrays
    source: str
    landing: Float[np.ndarray, "2 n"] | None = None  # [m] of the bounce that was seen next, NaN where none was

    def __len__(self) -> int:
        return self.id.size


def read_deepmind(path: str | os.PathLike) -> MeasuredStates:
    """Reads the JSON. Raises ValueError naming file, entry (from 0) and field that is missing or no finite number."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path}: a list of ball states is wanted, each with id, {', '.join(FIELDS)}")
    values = np.array([[_number(path, i, entry, field) for field in FIELDS] for i, entry in enumerate(entries)])
    ids = np.array([int(_number(path, i, entry, "id")) for i, entry in enumerate(entries)])
    position, velocity, spin = np.split(values.T, 3)
    return MeasuredStates(ids, BallState(position, velocity, spin), str(path))


def _number(path: str | os.PathLike, index: int, entry: Any, field: str) -> float:
    value = entry.get(field) if isinstance(entry, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{path}: entry {index}, field {field!r}: a finite number is wanted, got {value!r}")
    return value
