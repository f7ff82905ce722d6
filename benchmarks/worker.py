"""One side of a comparison in processes of its own: started, warmed up, then run when told.

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
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


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
        environment: dict[str, str] | None = None,
        limit: float | None = None,
        **sizes: Any,
    ) -> None:
        request = json.dumps({"side": side, "cpus": sorted(cpus) if cpus else None, "sizes": sizes})
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker", request],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": path} | (environment or {}),
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
