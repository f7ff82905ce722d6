"""Tracks in tables: CSV with any separator, JSON, NumPy arrays and Parquet, by the names that people give columns.

Our own form is CSV with the header ``session,trajectory,t,x,y,z`` in seconds and metres; ``session`` may be left out.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ballmodel.io.samples import FRAMES, LENGTHS, TIMES, Samples, TrackOptions

COLUMNS = ("session", "trajectory", "t", "x", "y", "z")
NUMBERS = ("t", "x", "y", "z")
# Names in small letters without units, blanks and underscores; earlier ones are preferred.
ALIASES = {
    "session": ("session", "match", "recording", "game"),
    "trajectory": (
        "trajectory",
        "trajectoryid",
        "traj",
        "track",
        "trackid",
        "ball",
        "ballid",
        "flight",
        "stroke",
        "id",
    ),
    "t": ("t", "time", "timestamp", "stamp", "seconds", "frame", "frameid", "framenumber", "frameno", "frameidx"),
    **{
        axis: (
            axis,
            *(f"{word}{axis}" for word in ("pos", "position", "ball", "point", "p")),
            f"{axis}pos",
            f"{axis}3d",
        )
        for axis in "xyz"
    },
}
FRAME_NAMES = ("frame", "frameid", "framenumber", "frameno", "frameidx")
CONFIDENCE = ("confidence", "conf", "score", "probability", "visible")
HEADERLESS = {4: NUMBERS, 5: COLUMNS[1:], 6: COLUMNS}
SEPARATORS = (";", "\t", "|", ",")
EVENTS = {"type", "ballpos"}  # columns of a table of events
MISSING = ["-", "lost"]  # besides what pandas takes for it


def read_table(path: str | os.PathLike, options: TrackOptions) -> Samples:
    """Rows of a table, which the suffix tells: .json, .jsonl, .npy, .npz, .parquet, text otherwise.

    Raises:
        ValueError: naming file, row and column at fault, and the option that mends it.
    """
    path = Path(path)
    suffix, first = path.suffix.lower(), 1
    try:
        if suffix in (".json", ".jsonl", ".ndjson"):
            table = _read_json(path)
        elif suffix in (".npy", ".npz"):
            table = _read_arrays(path)
        elif suffix == ".parquet":
            table = _read_parquet(path)
        else:
            table, first = _read_text(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: not readable as a table: {error}") from None
    if not len(table):
        raise ValueError(f"{path}: no row follows the header")
    return _pick(path, table, first, options)


def _read_text(path: Path) -> tuple[pd.DataFrame, int]:
    """A text table, and the number of its first row; columns without a header are named by their count."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if start is None:
        raise ValueError(f"{path}: holds no row")
    head = lines[start]
    separator = max(SEPARATORS, key=head.count)
    if not head.count(separator):
        separator = r"\s+"
    below = " ".join(lines[start : start + 5])
    decimal = "," if separator != "," and re.search(r"\d,\d", below) and not re.search(r"\d\.\d", below) else "."
    cells = re.split(re.escape(separator) if separator in SEPARATORS else separator, head.strip())
    numeric = [_is_number(cell, decimal) for cell in cells]
    bare = sum(numeric) >= max(len(cells) - 2, 1)
    names = HEADERLESS.get(len(cells)) if bare else tuple(cell.strip().strip("\"'") for cell in cells)
    if names is None:
        raise ValueError(
            f"{path}: row {start + 1}: {len(cells)} numbers and no header; write one, such as trajectory,t,x,y,z"
        )
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path}: row {start + 1}: column {name!r} is there {names.count(name)} times")
    roles = {name: role for role, name in find_columns(names).items()}
    table = pd.read_csv(
        path,
        sep=separator,
        decimal=decimal,
        header=None,
        names=list(names),
        skiprows=start + (0 if bare else 1),
        comment="#",
        encoding="utf-8-sig",
        na_values=MISSING,
        index_col=False,
        skipinitialspace=True,
        dtype={name: str for name in names if roles.get(name) in ("session", "trajectory")},
    )
    return table, start + (1 if bare else 2)


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.strip().replace(decimal, "."))
    except ValueError:
        return False
    return True


def _read_parquet(path: Path) -> pd.DataFrame:
    try:
        return pd.read_parquet(path)
    except ImportError:
        raise ValueError(f"{path}: Parquet needs pyarrow: pip install 'mjx-tt[lerobot]'") from None


def _read_json(path: Path) -> pd.DataFrame:
    """A list of objects, an object of lists, or one object a line."""
    text = path.read_text(encoding="utf-8-sig").strip()
    try:
        content: Any = json.loads(text)
    except json.JSONDecodeError:
        content = [json.loads(line) for line in text.splitlines() if line.strip()]
    if isinstance(content, list) and content and all(isinstance(row, dict) for row in content):
        return pd.json_normalize(content)
    if isinstance(content, dict) and content and all(isinstance(column, list) for column in content.values()):
        return pd.DataFrame(content)
    raise ValueError(f"{path}: expected a list of objects with t, x, y, z, got {type(content).__name__}")


def _read_arrays(path: Path) -> pd.DataFrame:
    """An array of rows, or named arrays, of which one may hold all three coordinates."""
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        if loaded.dtype.names:
            return pd.DataFrame({name: loaded[name] for name in loaded.dtype.names})
        names = HEADERLESS.get(loaded.shape[1]) if loaded.ndim == 2 else None
        if names is None:
            raise ValueError(f"{path}: expected rows of t, x, y, z, got an array of shape {loaded.shape}")
        return pd.DataFrame(loaded, columns=list(names))
    columns: dict[str, np.ndarray] = {}
    for name in loaded.files:
        array = loaded[name]
        if array.ndim == 2 and 3 in array.shape:
            columns |= dict(zip("xyz", array.T if array.shape[1] == 3 else array, strict=True))
        elif array.ndim == 1:
            columns[name] = array
    if len({len(column) for column in columns.values()}) != 1:
        shapes = ", ".join(f"{name} {loaded[name].shape}" for name in loaded.files)
        raise ValueError(f"{path}: expected arrays of equal lengths with times and positions, got {shapes}")
    return pd.DataFrame(columns)


def _plain(name: str) -> tuple[str, str]:
    """A column's name without unit, and the unit: "Pos X [mm]" -> "posx", "mm"."""
    words = [word for word in re.split(r"[^a-z0-9]+", str(name).lower().replace("µ", "u")) if word]
    unit = words.pop() if len(words) > 1 and words[-1] in {*LENGTHS, *TIMES} else ""
    return "".join(words), unit


def find_columns(names: tuple[str, ...] | list[str]) -> dict[str, str]:
    """Which of a table's columns is which of COLUMNS."""
    plain = {_plain(name)[0]: name for name in reversed(names)}
    return {
        role: next(plain[a] for a in aliases if a in plain)
        for role, aliases in ALIASES.items()
        if {*aliases} & {*plain}
    }


def _pick(path: Path, table: pd.DataFrame, first: int, options: TrackOptions) -> Samples:
    names = [str(name) for name in table.columns]
    table.columns = pd.Index(names)
    if EVENTS <= {_plain(name)[0] for name in names}:
        raise ValueError(
            f"{path}: holds events, no tracks; with ball_vel_out and ball_spin_out, `mjx-tt fit-human` reads them"
        )
    for role, name in options.columns.items():
        if role not in COLUMNS or name not in names:
            expected = ", ".join(COLUMNS if role not in COLUMNS else names)
            raise ValueError(f"{path}: --columns {role}={name}: expected one of {expected}")
    found = find_columns(names) | dict(options.columns)
    missing = [role for role in NUMBERS if role not in found]
    if missing:
        raise ValueError(
            f"{path}: row {max(first - 1, 1)}: no column is known as {', '.join(missing)}; there are "
            f"{', '.join(names)}. Name them: --columns {','.join(f'{role}=NAME' for role in missing)}"
        )
    numbers = {role: _convert(path, table[found[role]], found[role], first) for role in NUMBERS}
    notes = []
    confidence = next((name for name in names if _plain(name)[0] in CONFIDENCE), None)
    if confidence is not None:
        unseen = pd.to_numeric(table[confidence], errors="coerce").to_numpy(float) <= 0.0
        numbers["x"] = np.where(unseen, np.nan, numbers["x"])
    unused = [name for name in names if name not in found.values() and name != confidence]
    if unused:
        notes.append(f"columns that were not used: {', '.join(unused)}")
    text = {role: _labels(table, found.get(role)) for role in ("session", "trajectory")}
    units = {_plain(found[role])[1] for role in "xyz"} - {""}
    name, unit = _plain(found["t"])
    return Samples(
        numbers["t"],
        np.stack([numbers[axis] for axis in "xyz"]),
        text["session"],
        text["trajectory"],
        tuple(notes),
        units.pop() if len(units) == 1 else None,
        FRAMES if name in FRAME_NAMES else unit or None,
    )


def _labels(table: pd.DataFrame, name: str | None) -> list[str]:
    if name is None:
        return [""] * len(table)
    column = table[name]
    if pd.api.types.is_float_dtype(column) and (column.dropna() % 1 == 0).all():
        column = column.astype("Int64")
    return column.astype("string").fillna("").str.strip().tolist()


def _convert(path: Path, column: pd.Series, name: str, first: int) -> np.ndarray:
    """Numbers of a column, NaN where it is empty."""
    if pd.api.types.is_numeric_dtype(column):
        return column.to_numpy(float, na_value=np.nan)
    values = pd.to_numeric(column, errors="coerce")
    wrong = np.flatnonzero(values.isna() & column.notna())
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(f"{path}: row {first + i}, column {name!r}: {column.iloc[i]!r} is not a number")
    return values.to_numpy(float)
