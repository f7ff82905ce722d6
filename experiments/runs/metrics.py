"""A run's measurements: one JSON line per update for programs, TensorBoard for eyes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter

from ballmodel.io.atomic_files import replacing


class MetricsLog:
    """Appends to metrics.jsonl and to TensorBoard, continuing after ``update``: later lines of a killed run go.

    TensorBoard gets the last line of each batch, about one a second. Raises OSError when the disk refuses.
    """

    def __init__(self, path: Path, tensorboard: Path, update: int) -> None:
        _truncate(path, update)
        self._file = open(path, "a", encoding="utf-8")
        self._board = SummaryWriter(str(tensorboard), purge_step=update + 1, filename_suffix=f".{update}")

    def write(self, rows: list[dict[str, Any]]) -> None:
        """Adds rows {"update": int, name: number}, oldest first; they are in the file when this returns."""
        self._file.write("".join(f"{json.dumps(row)}\n" for row in rows))
        self._file.flush()
        for name, value in rows[-1].items():
            if name != "update":
                self._board.add_scalar(name if "/" in name else f"training/{name}", value, rows[-1]["update"])

    def sync(self) -> None:
        """Forces what was written to the disk, before a checkpoint that relies on it."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()
        self._board.close()


def read(path: Path) -> list[dict[str, Any]]:
    """The rows of a metrics.jsonl; an unfinished last line is left out, and a missing file has none."""
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break  # only the line being written when a run was killed is no JSON
    return rows


def _truncate(path: Path, update: int) -> None:
    rows = read(path)
    kept = [row for row in rows if row["update"] <= update]
    if rows or path.exists():
        with replacing(path) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in kept), encoding="utf-8")
