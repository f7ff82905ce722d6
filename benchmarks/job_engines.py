"""Cost of a job beside its work: empty jobs by the process pool and by Parsl's workers on this machine.

    python -m benchmarks.job_engines

Start: from the call to the end of the first job: processes start, load JAX and prepare themselves. Each: the rest of
``JOBS`` empty jobs over their number, two workers at a time, one submitted as another ends.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.harness import print_table, run
from experiments.config.site import Site
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.site import Workers

JOBS = 400
WORKERS = 2
HERE = {"provider": {"kind": "local"}, "workers_per_node": WORKERS, "memory_per_worker": 0.5}


def prepare() -> Callable[[], None]:
    """A job of nothing, in a worker."""
    return lambda: None


def measure(workers: Workers, folder: Path) -> dict[str, float]:
    """Seconds to the first end, per further job, and of the end of the workers."""
    ends: list[float] = []
    jobs = [Job(str(i), ()) for i in range(JOBS)]
    began = time.monotonic()
    setup = Setup("benchmarks.job_engines:prepare", ())
    engine.run(workers.engine(setup, folder), jobs, lambda job, result: ends.append(time.monotonic()))
    closed = time.monotonic() - ends[-1]
    rest = ends[WORKERS:]  # each worker has had its first
    return {"start": ends[0] - began, "each": (rest[-1] - rest[0]) / (len(rest) - 1), "end": closed}


def main() -> None:
    """Prints both engines."""
    both = {"process pool": Workers(WORKERS), "Parsl": Workers(1, Site.model_validate(HERE), "here")}
    with tempfile.TemporaryDirectory() as folder:
        took = {name: measure(workers, Path(folder)) for name, workers in both.items()}
    rows = [(name, *(f"{seconds:.4f}" for seconds in found.values())) for name, found in took.items()]
    print_table("Seconds", ("engine", "to the end of the first job", "each further job", "end of the workers"), rows)


if __name__ == "__main__":
    run(main)
