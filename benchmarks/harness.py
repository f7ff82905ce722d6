"""What benchmarks share: their command line, tables, resumable results, and comparisons in turns.

A side of a comparison runs in processes of its own: started, warmed up, then run when told.

Fresh processes give every side its own memory and its own processor cores, and let sides take turns. A side is a
function of ``benchmarks.sides`` that prepares everything and returns its work; the process answers each line on its
standard input with one run of that work.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # a side loads nothing that it does not need: its memory is measured
    import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def run(main: Callable[..., int | None]) -> None:
    """Calls a benchmark with the options of the command line, which its signature and docstring describe."""
    from cyclopts import App, Parameter

    app = App(help=sys.modules["__main__"].__doc__, default_parameter=Parameter(consume_multiple=True))
    app.default(main)
    app()


def print_table(title: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Prints rows of texts and numbers; None is an empty cell."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for i, column in enumerate(head):
        table.add_column(column, justify="right" if i else "left")
    for row in rows:
        table.add_row(*("" if cell is None else str(cell) for cell in row))
    Console().print(table)


def each_missing(folder: Path, name: str, seeds: Iterable[int]) -> Iterator[tuple[int, Path]]:
    """Seeds without a result NAME_SEED.json in the folder, with its path; after each, prints the time left."""
    folder.mkdir(parents=True, exist_ok=True)
    left = [(seed, path) for seed in seeds if not (path := folder / f"{name}_{seed:03d}.json").exists()]
    began = time.monotonic()
    for done, (seed, path) in enumerate(left, 1):
        yield seed, path
        minutes = (time.monotonic() - began) / done * (len(left) - done) / 60.0
        print(f"{path}: {minutes:.0f} min left", flush=True)


def read_all(folder: Path, name: str) -> list[dict[str, Any]]:
    """The results of that name, in the order of their seeds."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob(f"{name}_*.json"))]


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean of values (n,) with its 95 % interval by the bootstrap."""
    import numpy as np

    means = np.random.default_rng(0).choice(values, (2000, values.size)).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(values.mean()), float(low), float(high)


class WorkerError(RuntimeError):
    """A side that could not be prepared or died."""


class Worker:
    """A process that runs ``side`` with the given sizes on ``cpus`` (all cores when None).

    limit: seconds after which the process is ended while one waits for its answer; None: never.
    After ``close``, ``peak_memory`` [MB] holds its largest resident memory.
    """

    def __init__(
        self,
        side: str,
        cpus: set[int] | None = None,
        limit: float | None = None,
        **sizes: Any,
    ) -> None:
        request = json.dumps({"side": side, "cpus": sorted(cpus) if cpus else None, "sizes": sizes})
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.harness", request],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path},
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise WorkerError(f"{side}: its process has no pipes")
        self._orders, self._answers = self._process.stdin, self._process.stdout
        self.side, self._limit = side, limit
        self.peak_memory = math.nan

    def wait_ready(self) -> dict:
        """The side's description of itself, once it is warm. Raises WorkerError."""
        return self._answer()

    def start(self) -> None:
        self._orders.write("\n")
        self._orders.flush()

    def finish(self) -> float:
        """Amount of work done by the run that ``start`` began. Raises WorkerError."""
        return self._answer()["amount"]

    def close(self) -> None:
        if not self._orders.closed:
            self._orders.close()  # the process answers with its memory and ends
            self.peak_memory = self._answer()["peak_memory_mb"]
            self._process.wait()
            self._answers.close()

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self._process.kill()
            self._process.wait()

    def _answer(self) -> dict:
        timer = threading.Timer(self._limit or threading.TIMEOUT_MAX, self._process.kill)
        timer.daemon = True
        timer.start()
        line = self._answers.readline()
        late = not timer.is_alive()
        timer.cancel()
        if not line and late:
            raise WorkerError(f"{self.side}: no answer within {self._limit:g} s")
        if not line:
            raise WorkerError(f"{self.side}: its process ended with status {self._process.wait()}; see above for why")
        return json.loads(line)


def run_once(workers: list[Worker]) -> tuple[float, float]:
    """Starts one run of all the workers of a side at once; seconds until the last is done and the sum of their work."""
    began = time.perf_counter()
    for worker in workers:
        worker.start()
    amount = sum(worker.finish() for worker in workers)
    return time.perf_counter() - began, amount


def take_turns(sides: dict[str, list[Worker]], rounds: int) -> dict[str, list[tuple[float, float]]]:
    """``rounds`` runs of every side, A B C A B C ..., so that other load on the machine meets all alike.

    Returns (seconds, amount) of each run, by side.
    """
    measured: dict[str, list[tuple[float, float]]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, workers in sides.items():
            measured[name].append(run_once(workers))
    return measured


class Sides:
    """The sides of a comparison by name, a context in which their processes live."""

    def __init__(self) -> None:
        self.workers: dict[str, list[Worker]] = {}
        self._stack = ExitStack()

    def add(self, name: str, side: str, cpus: Sequence[set[int] | None] = (None,), **arguments: Any) -> None:
        """Starts ``side`` under a name, in a process for each of ``cpus``."""
        self.workers[name] = [self._stack.enter_context(Worker(side, cores, **arguments)) for cores in cpus]

    def measure(self, rounds: int) -> dict[str, list[tuple[float, float]]]:
        """(seconds, amount) of each of ``rounds`` runs, by side. Raises WorkerError."""
        self.about = {name: [worker.wait_ready() for worker in workers][0] for name, workers in self.workers.items()}
        return take_turns(self.workers, rounds)

    def peak_memory(self, name: str) -> float:
        """Largest resident memory [MB] of the first process of a side, once the comparison has ended."""
        return round(self.workers[name][0].peak_memory, 1)

    def __enter__(self) -> Sides:
        return self

    def __exit__(self, *error: Any) -> bool | None:
        return self._stack.__exit__(*error)


def summary(seconds: list[float]) -> dict[str, float]:
    return {"median": median(seconds), "min": min(seconds), "max": max(seconds), "n": len(seconds)}


def serve(request: str) -> None:
    """The process behind a ``Worker``. Only its answers go to standard output."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # some libraries greet from C
    order = json.loads(request)
    if order["cpus"] and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, order["cpus"])  # before anything starts threads
    from benchmarks import sides

    about, work = getattr(sides, order["side"])(**order["sizes"])
    work()  # warm

    def answer(content: dict) -> None:
        print(json.dumps(content), file=answers, flush=True)

    answer(about)
    for _ in sys.stdin:
        answer({"amount": work()})
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    answer({"peak_memory_mb": peak / (1024.0 if sys.platform == "linux" else 1024.0**2)})


if __name__ == "__main__":
    serve(sys.argv[1])
