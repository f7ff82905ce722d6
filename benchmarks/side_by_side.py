"""Trainings side by side against one that has all cores: episodes per second of updates as a study makes them.

    python -m benchmarks.side_by_side

One process with a device per core, against one process with one device on each core, both doing updates of
``study_night.yaml``'s size, in turns. What an update costs beside its episodes, and the wait for the slower half, is
what the first loses; the second loses what the cores' shared memory costs, as the first does.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from statistics import median

from rich.console import Console

from benchmarks.worker import Worker, take_turns

CHANGES = ["optimiser.num_directions=100", "optimiser.repeats=10", "task.sim_rate=150"]
ROUNDS = 15


def measure(rounds: int = ROUNDS) -> dict[str, float]:
    """Episodes per second with one process on all cores and with one process per core, medians of ``rounds``."""
    cores = sorted(os.sched_getaffinity(0))
    with ExitStack() as stack:

        def start(cpus: set[int] | None, devices: int) -> Worker:
            return stack.enter_context(Worker("update", cpus, changes=CHANGES, devices=devices))

        sides = {"one process": [start(None, len(cores))], "a process per core": [start({core}, 1) for core in cores]}
        for worker in sum(sides.values(), []):
            worker.wait_ready()
        measured = take_turns(sides, rounds)
    return {name: median(episodes / seconds for seconds, episodes in runs) for name, runs in measured.items()}


def main(console: Console) -> None:
    """Prints the two and their ratio."""
    speed = measure()
    for name, value in speed.items():
        console.print(f"{name}: {value:,.0f} episodes/s", highlight=False)
    console.print(f"ratio: {speed['a process per core'] / speed['one process']:.2f}", highlight=False)


if __name__ == "__main__":
    main(Console())
