"""Cost of a user's networks beside the paper's: ``python -m benchmarks.own_networks my_task.py [--devices 1]``.

Updates of each network take turns. All policies stay near rest, so that the episodes are of the same length.
"""

from __future__ import annotations

from pathlib import Path
from statistics import median

from benchmarks.harness import Sides, print_table, run
from mjx_tt.env import user_defined

PAPER = "the paper's"
SIZE = ["optimiser.num_directions=100", "optimiser.repeats=10", "optimiser.initial_scale=0.02", "task.sim_rate=150"]
ROUNDS = 5


def main(definitions: Path, *, devices: int = 1) -> None:
    """Measures and prints updates with each network of the file."""
    changes: dict[str, list[str]] = {PAPER: []}
    for name in user_defined.load(definitions.read_text(encoding="utf-8"), str(definitions)).networks:
        changes[name] = [f"definitions={definitions.resolve()}", f"network={name}"]
    with Sides() as sides:
        for name, changed in changes.items():
            sides.add(name, "update", changes=[*SIZE, *changed], devices=devices)
        measured = sides.measure(ROUNDS)
    seconds = {name: median(taken / episodes for taken, episodes in runs) for name, runs in measured.items()}
    rows = [(name, f"{1 / each:,.0f}", f"{each / seconds[PAPER]:.2f}") for name, each in seconds.items()]
    print_table("Updates", ("network", "episodes/s", "time over the paper's"), rows)


if __name__ == "__main__":
    run(main)
