"""Rallies in real time beside busy cores: ``python -m benchmarks.busy_rallies ARTEFACT [--seconds 600] [--busy 2]``.

Prints lateness and reply percentiles of the control process, what was lost, faults and rallies.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from benchmarks.harness import run
from experiments.deploy import play
from experiments.options import RIG, RobotOptions


def main(
    artefact: Path, *, seconds: float = 600.0, busy: int = 2, player: str = "player3", backend: str = "auto"
) -> int:
    """Plays and prints; returns the session's exit status.

    Args:
        busy: processes that only compute
    """
    others = [multiprocessing.Process(target=compute, daemon=True) for _ in range(busy)]
    for other in others:
        other.start()
    with TemporaryDirectory() as folder:
        setup = RobotOptions(backend=backend, player=player)
        status = play.run(artefact, RIG, Path(folder), Console(), setup, seconds=seconds)
        report = json.loads(next(Path(folder).glob("*.json")).read_text("utf-8"))
    for other in others:
        other.kill()
    lost = {name: report[name] for name in ("axes_late", "tracker_counts", "log_dropped")}
    print(json.dumps(lost | {"egm": report["egm"], "timings": report["timings"], "faults": report["faults"]}))
    print(f"load averages {os.getloadavg()}, {os.cpu_count()} cores")
    return status


def compute() -> None:
    """Never ends."""
    while True:
        sum(range(10**6))


if __name__ == "__main__":
    run(main)
