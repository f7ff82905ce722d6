"""How long tests take, and which of them a newcomer need not wait for.

``tests/durations.json`` holds the seconds of every test that took HALF a second or more, set-up included, when
``make durations`` timed them last. Those above LONGEST are marked ``deferred``: they run with the slow ones, as does
the rest of a file that is half of such tests. A test marked ``smoke`` is never deferred. A test without a record counts
as quick.
"""

from __future__ import annotations

import json
import sys
from functools import cache
from pathlib import Path

import pytest

RECORD = Path(__file__).parents[1] / "durations.json"
LONGEST = 1.5  # [s]
HALF = 0.5  # [s] from which a test is recorded


@cache
def read_seconds() -> dict[str, float]:
    """Seconds by test."""
    return json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}


def mark_deferred(items: list[pytest.Item]) -> None:
    """Marks the tests that took longer than LONGEST, and of a file where they are half of all the others as well.

    The first test that needs a program pays for compiling it: the others of its file would only pay in its place.
    """
    able = [item for item in items if not any(item.get_closest_marker(name) for name in ("slow", "smoke"))]
    long = [read_seconds().get(item.nodeid, 0.0) > LONGEST for item in able]
    share: dict[Path, list[bool]] = {}
    for item, is_long in zip(able, long, strict=True):
        share.setdefault(item.path, []).append(is_long)
    for item, is_long in zip(able, long, strict=True):
        if is_long or 2 * sum(share[item.path]) >= len(share[item.path]):
            item.add_marker(pytest.mark.deferred)


def main(recorded: str) -> None:
    """Keeps of pytest-split's record what is worth keeping, in the order of the tests."""
    seconds = json.loads(Path(recorded).read_text(encoding="utf-8"))
    kept = {name: round(taken, 1) for name, taken in sorted(seconds.items()) if taken >= HALF}
    RECORD.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
    print(f"{RECORD}: {len(kept)} of {len(seconds)} tests, {sum(t > LONGEST for t in kept.values())} of them deferred")


if __name__ == "__main__":
    main(sys.argv[1])
