"""Tracks in tables: CSV with any separator, JSON, NumPy arrays and Parquet, by the names that people give columns.

Our own form is CSV with the header ``session,trajectory,t,x,y,z`` in seconds and metres; ``session`` may be left out.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ballmodel.io.samples import FRAMES, LENGTHS, TIMES, Samples, TrackOptions

COLUMNS = ("session", "trajectory", "t", "x", "y", "z")
NUMBERS = COLUMNS[2:]
FRAME_NAMES = ("frame", "frameid", "framenumber", "frameno", "frameidx")
# Names in small letters without units, blanks and underscores; earlier ones are preferred.
ALIASES: dict[str, tuple[str, ...]] = {
    "session": ("session", "match", "recording", "game"),
    "trajectory": tuple("trajectory trajectoryid traj track trackid ball ballid flight stroke id".split()),
    "t": ("t", "time", "timestamp", "stamp", "seconds", *FRAME_NAMES),
    **{a: (a, f"pos{a}", f"position{a}", f"ball{a}", f"point{a}", f"p{a}", f"{a}pos", f"{a}3d") for a in "xyz"},
}
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
    reader = READERS.get(path.suffix.lower())
    try:
        table, first = (reader(path), 1) if reader else _read_text(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: not readable as a table: {error}") from None
    if not len(table):
        raise ValueError(f"{path}: no row follows the header")
    return _pick(path, table.rename(columns=str), first, options)


def _read_text(path: Path) -> tuple[pd.DataFrame, int]:
    """A text table, and the number of its first row; columns without a header are named by their count."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if start is None:
        raise ValueError(f"{path}: holds no row")
    head, below = lines[start], " ".join(lines[start : start + 5])
    most = max(SEPARATORS, key=head.count)
    separator = most if most in head else None  # blanks
    decimal = "," if separator != "," and re.search(r"\d,\d", below) and not re.search(r"\d\.\d", below) else "."
    cells = [cell.strip() for cell in head.strip().split(separator)]
    bare = sum(_is_number(cell.replace(decimal, ".")) for cell in cells) >= max(len(cells) - 2, 1)
    names = HEADERLESS.get(len(cells)) if bare else tuple(cell.strip("\"'") for cell in cells)
    row = f"{path}: row {start + 1}:"
    if names is None:
        raise ValueError(f"{row} {len(cells)} numbers and no header; write one, such as trajectory,t,x,y,z")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{row} column {name!r} is there {names.count(name)} times")
    skipped = start if bare else start + 1
    table = pd.read_csv(
        path,
        sep=separator or r"\s+",
        decimal=decimal,
        header=None,
        names=list(names),
        skiprows=skipped,
        comment="#",
        encoding="utf-8-sig",
        na_values=MISSING,
        index_col=False,
        skipinitialspace=True,
        dtype={name: str for role, name in _find_columns(names).items() if role not in NUMBERS},
    )
    return table, skipped + 1


def _is_number(text: str) -> bool:
    try:
        float(text)
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


def _read_array(path: Path) -> pd.DataFrame:
    """Rows of numbers, or a structured array."""
    array = np.load(path, allow_pickle=False)
    if array.dtype.names:
        return pd.DataFrame({name: array[name] for name in array.dtype.names})
    names = HEADERLESS.get(array.shape[1]) if array.ndim == 2 else None
    if names is None:
        raise ValueError(f"{path}: expected rows of t, x, y, z, got an array of shape {array.shape}")
    return pd.DataFrame(array, columns=list(names))


def _read_arrays(path: Path) -> pd.DataFrame:
    """Named arrays, of which one may hold all three coordinates."""
    arrays = dict(np.load(path, allow_pickle=False))
    columns: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if array.ndim == 2 and 3 in array.shape:
            columns |= dict(zip("xyz", array.T if array.shape[1] == 3 else array, strict=True))
        elif array.ndim == 1:
            columns[name] = array
    if len({len(column) for column in columns.values()}) != 1:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"{path}: expected arrays of equal lengths with times and positions, got {shapes}")
    return pd.DataFrame(columns)


READERS: dict[str, Callable[[Path], pd.DataFrame]] = {
    **dict.fromkeys((".json", ".jsonl", ".ndjson"), _read_json),
    ".npy": _read_array,
    ".npz": _read_arrays,
    ".parquet": _read_parquet,
}


def _split_unit(name: str) -> tuple[str, str]:
    """A column's name in ALIASES' form, and its unit: "Pos X [mm]" -> "posx", "mm"."""
    words = [word for word in re.split(r"[^a-z0-9]+", name.lower().replace("µ", "u")) if word]
    unit = words.pop() if len(words) > 1 and words[-1] in {*LENGTHS, *TIMES} else ""
    return "".join(words), unit


def _find_columns(names: Sequence[str]) -> dict[str, str]:
    """Which of a table's columns is which of COLUMNS."""
    plain = {_split_unit(name)[0]: name for name in reversed(names)}
    found = {role: [plain[alias] for alias in aliases if alias in plain] for role, aliases in ALIASES.items()}
    return {role: columns[0] for role, columns in found.items() if columns}


def _pick(path: Path, table: pd.DataFrame, first: int, options: TrackOptions) -> Samples:
    names = list(table.columns)
    plain = {name: _split_unit(name)[0] for name in names}
    if EVENTS <= {*plain.values()}:
        raise ValueError(
            f"{path}: holds events, no tracks; with ball_vel_out and ball_spin_out, `mjx-tt fit-human` reads them"
        )
    for role, name in options.columns.items():
        if role not in COLUMNS or name not in names:
            expected = ", ".join(COLUMNS if role not in COLUMNS else names)
            raise ValueError(f"{path}: --columns {role}={name}: expected one of {expected}")
    found = _find_columns(names) | dict(options.columns)
    missing = [role for role in NUMBERS if role not in found]
    if missing:
        raise ValueError(
            f"{path}: row {max(first - 1, 1)}: no column is known as {', '.join(missing)}; there are "
            f"{', '.join(names)}. Name them: --columns {','.join(f'{role}=NAME' for role in missing)}"
        )
    time, *position = (_convert(path, table[found[role]], found[role], first) for role in NUMBERS)
    confidence = next((name for name in names if plain[name] in CONFIDENCE), None)
    if confidence is not None:
        unseen = pd.to_numeric(table[confidence], errors="coerce").to_numpy(float) <= 0.0
        position[0] = np.where(unseen, np.nan, position[0])
    unused = [name for name in names if name not in found.values() and name != confidence]
    units = {_split_unit(found[axis])[1] for axis in "xyz"} - {""}
    return Samples(
        time,
        np.stack(position),
        _labels(table, found.get("session")),
        _labels(table, found.get("trajectory")),
        (f"columns that were not used: {', '.join(unused)}",) if unused else (),
        units.pop() if len(units) == 1 else None,
        FRAMES if plain[found["t"]] in FRAME_NAMES else _split_unit(found["t"])[1] or None,
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
