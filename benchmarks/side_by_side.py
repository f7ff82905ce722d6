"""Trainings side by side against one that has all cores: episodes per second of updates as a study makes them.

    python -m benchmarks.side_by_side

One process with a device per core, against one process with one device on each core, both doing updates of
``study_night.yaml``'s size, in turns. What an update costs beside its episodes, and the wait for the slower half, is
what the first loses; the second loses what the cores' shared memory costs, as the first does.
"""

from __future__ import annotations

import os
from statistics import median

from benchmarks.harness import Sides, run

CHANGES = ["optimiser.num_directions=100", "optimiser.repeats=10", "task.sim_rate=150"]
ROUNDS = 15


def main() -> None:
    """Prints the two and their ratio."""
    cores = sorted(os.sched_getaffinity(0))
    with Sides() as sides:
        sides.add("one process", "update", changes=CHANGES, devices=len(cores))
        sides.add("a process per core", "update", [{core} for core in cores], changes=CHANGES, devices=1)
        measured = sides.measure(ROUNDS)
    speed = {name: median(episodes / seconds for seconds, episodes in runs) for name, runs in measured.items()}
    for name, value in speed.items():
        print(f"{name}: {value:,.0f} episodes/s, {value / speed['one process']:.2f} x")


if __name__ == "__main__":
    run(main)
