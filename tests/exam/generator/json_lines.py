"""One JSON object a line: results that survive an interruption."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path


def read_lines(path: Path) -> list[dict]:
    """Records of a JSONL file; a line cut short by an interruption is left out."""
    records = []
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            records.append(json.loads(line))
    return records


def append(path: Path, record: dict) -> None:
    """Adds a line, after the end of one that an interruption cut short."""
    broken = path.exists() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
    with path.open("a") as stream:
        stream.write("\n" * broken + json.dumps(record) + "\n")
