"""Trajectories in CSV: ``session,trajectory,t,x,y,z`` with a header line; ``session`` may be left out.

Times in seconds, positions in metres in the table frame. Rows of different trajectories may alternate; those of one
trajectory are in the order of time. Columns may come in any order.
"""

from __future__ import annotations

import csv
import difflib
import math
import os
from collections.abc import Iterable

from ballmodel.trajectory import Dataset

COLUMNS = ("session", "trajectory", "t", "x", "y", "z")
NUMBERS = ("t", "x", "y", "z")


def read_csv(path: str | os.PathLike) -> Dataset:
    """Reads trajectories from CSV. Raises ValueError naming file, row (the header is row 1) and column at fault."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        try:
            header = _header(path, next(reader, None))
            samples = _samples(path, ((reader.line_num, row) for row in reader), header)
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: row {reader.line_num + 1}: not readable as CSV in UTF-8: {error}") from None
    if not samples:
        raise ValueError(f"{path}: no row follows the header")
    return Dataset.from_samples(samples, str(path))


def _header(path: str | os.PathLike, row: list[str] | None) -> list[str]:
    names = [name.strip() for name in row or []]
    for name in names:
        if name not in COLUMNS:
            near = difflib.get_close_matches(name, COLUMNS, n=1, cutoff=0.0)[0]
            raise ValueError(
                f"{path}: row 1: column {name!r} is unknown; did you mean {near!r}? Allowed: {', '.join(COLUMNS)}"
            )
        if names.count(name) > 1:
            raise ValueError(f"{path}: row 1: column {name!r} is there {names.count(name)} times")
    missing = [name for name in COLUMNS[1:] if name not in names]
    if missing:
        raise ValueError(f"{path}: row 1: column {', '.join(missing)} is missing; wanted: {','.join(COLUMNS)}")
    return names


def _samples(
    path: str | os.PathLike, rows: Iterable[tuple[int, list[str]]], header: list[str]
) -> dict[tuple[str, str], list[list[float]]]:
    samples: dict[tuple[str, str], list[list[float]]] = {}
    for number, row in rows:
        if not row:
            continue
        place = f"{path}: row {number}"
        if len(row) != len(header):
            raise ValueError(f"{place}: {len(row)} fields, the header has {len(header)} ({','.join(header)})")
        fields = dict(zip(header, row, strict=True))
        values = [_number(place, column, fields[column]) for column in NUMBERS]
        known = samples.setdefault((fields.get("session", ""), fields["trajectory"]), [])
        if known and values[0] <= known[-1][0]:
            raise ValueError(
                f"{place}, column 't': {values[0]:g} does not come after {known[-1][0]:g}, the time of the row before "
                f"in trajectory {fields['trajectory']!r}"
            )
        known.append(values)
    return samples


def _number(place: str, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        unit = "seconds" if column == "t" else "metres"
        raise ValueError(f"{place}, column {column!r}: {text!r} is not a finite number of {unit}")
    return value
