"""Jobs of tests: they leave a line in a file for every time that they begin and end."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path


def prepare(folder: Path) -> Callable[..., str]:
    """The function that does a job, in a worker: begins, does what it is told, ends."""
    note(folder, f"worker {os.getpid()} {','.join(map(str, sorted(os.sched_getaffinity(0))))}")

    def do(name: str, deed: str) -> str:
        note(folder, f"begin {name} {os.getpid()}")
        if deed == "fail":
            until = time.monotonic() + 60.0
            while {line.split()[1] for line in lines(folder) if line.startswith("begin")} == {name}:
                assert time.monotonic() < until, "no other job has begun"
                time.sleep(0.02)
            raise ValueError(f"{name} cannot be done")
        if deed == "die once" and sum(line.startswith(f"begin {name} ") for line in lines(folder)) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        if deed == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if deed == "accelerators":
            name = os.environ["CUDA_VISIBLE_DEVICES"]
        if deed == "long":
            try:
                time.sleep(600.0)
            except KeyboardInterrupt:
                note(folder, f"saved {name}")
                raise KeyboardInterrupt(f"{name}: saved") from None
        note(folder, f"end {name}")
        return f"{name} done"

    return do


def note(folder: Path, text: str) -> None:
    """Appends a line, whole."""
    with open(folder / "notes.txt", "a") as file:
        file.write(text + "\n")


def lines(folder: Path) -> list[str]:
    """Those that were written so far."""
    path = folder / "notes.txt"
    return path.read_text().splitlines() if path.exists() else []
