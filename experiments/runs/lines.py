"""Files of lines that survive a kill and a power cut: each line is on the disk before the next work begins."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from ballmodel.io.atomic_files import sync_folder
from experiments.errors import RunError


def read(path: Path, take: Callable[[bytes], None], what: str) -> None:
    """Gives every line of a file to ``take``, and drops an unfinished last one from the file.

    Raises RunError for any other line that ``take`` refuses by ValueError, KeyError or TypeError; what: it should be.
    """
    if not path.exists():
        return
    lines, whole = path.read_bytes().splitlines(keepends=True), 0
    for i, line in enumerate(lines):
        try:
            if not line.endswith(b"\n"):
                raise ValueError("the line has no end")
            take(line)
        except (ValueError, KeyError, TypeError) as error:
            if i == len(lines) - 1:
                break
            raise RunError(f"{path}: line {i + 1} is no {what} ({error}); restore the file") from None
        whole += len(line)
    os.truncate(path, whole)


def append(path: Path, line: bytes) -> None:
    """Adds a line; it is on the disk when this returns. Raises OSError when the disk refuses."""
    with open(path, "ab", buffering=0) as file:
        start = file.seek(0, os.SEEK_END)
        try:
            while line:
                line = line[file.write(line) :]
            os.fsync(file)
        except OSError:
            file.truncate(start)  # no half a line in the middle, should there be room again
            raise
    if not start:
        sync_folder(path.parent)
