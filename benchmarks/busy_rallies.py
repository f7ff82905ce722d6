"""Rallies in real time beside busy cores: ``python -m benchmarks.busy_rallies ARTEFACT [--seconds 600] [--busy 2]``.

Prints lateness and reply percentiles of the control process, what was lost, faults and rallies.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from experiments.commands.options import RIG, RobotOptions
from experiments.deploy import play


def main(arguments: list[str] | None = None) -> int:
    """Plays and prints; returns the session's exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("artefact", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--busy", type=int, default=2, help="processes that only compute")
    parser.add_argument("--player", default="player3")
    parser.add_argument("--backend", default="auto")
    chosen = parser.parse_args(arguments)
    others = [multiprocessing.Process(target=compute, daemon=True) for _ in range(chosen.busy)]
    for other in others:
        other.start()
    with TemporaryDirectory() as folder:
        setup = RobotOptions(backend=chosen.backend, player=chosen.player)
        status = play.run(chosen.artefact, RIG, Path(folder), Console(), setup, seconds=chosen.seconds)
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
    sys.exit(main())
