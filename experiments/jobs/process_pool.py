"""The engine that needs nothing: processes on this machine, each on its share of the cores."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection, get_context, parent_process
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from typing import Any

from experiments.errors import RunError
from experiments.jobs.engine import Job, Setup, Stopped, sigterm_interrupts


class ProcessPool:
    """``processes`` workers, which end with this process; ``where`` begins what it says of a worker that was killed."""

    def __init__(self, setup: Setup, processes: int, where: str) -> None:
        self.slots, self._where = processes, where
        context = get_context("spawn")  # a fork of a process in which JAX has run hangs
        shares: SimpleQueue[list[int]] = context.SimpleQueue()
        self._started: SimpleQueue[int] = context.SimpleQueue()
        self._stopping = context.Event()
        cores = sorted(os.sched_getaffinity(0))
        for i in range(processes):
            shares.put(cores[i::processes] or cores)
        given = (setup, shares, self._started, self._stopping)
        self._executor = ProcessPoolExecutor(processes, context, _start, given)

    def submit(self, job: Job) -> Future[Any]:
        """As ``JobEngine``."""
        result: Future[Any] = Future()

        def settle(inner: Future[Any]) -> None:
            error = None if inner.cancelled() else inner.exception()
            if isinstance(error, BrokenProcessPool):
                error = RunError(
                    f"{self._where}: a process was killed, perhaps for want of memory; what is finished is kept. "
                    "The same command continues, --processes with fewer needs less memory"
                )
            if error is not None:
                result.set_exception(error)
            else:
                result.set_result(Stopped("") if inner.cancelled() else inner.result())

        try:
            self._executor.submit(_perform, *job.arguments).add_done_callback(settle)
        except BrokenProcessPool as error:  # of another job's process
            broken: Future[Any] = Future()
            broken.set_exception(error)
            settle(broken)
        return result

    def check(self) -> None:
        """As ``JobEngine``."""

    def stop(self, running: Iterable[Future[Any]], at_once: bool) -> None:
        """As ``JobEngine``."""
        self._stopping.set()  # for those that have not begun
        if at_once:
            self._signal(signal.SIGKILL)
            return
        self._signal(signal.SIGTERM)
        wait(list(running))

    def close(self) -> None:
        """As ``JobEngine``."""
        self._executor.shutdown(cancel_futures=True)

    def _signal(self, number: int) -> None:
        # A process ends only with the pool, or is waited for by it: no other one has its number.
        pids = []
        while not self._started.empty():
            pids.append(self._started.get())
        for pid in pids:
            self._started.put(pid)
            try:
                os.kill(pid, number)
            except ProcessLookupError:
                pass


# -- in a worker ----------------------------------------------------------------------------------------------------

_do: Callable[..., Any]  # does a job
_stopping: Event  # set: no further job is to begin


def _start(setup: Setup, shares: SimpleQueue[list[int]], started: SimpleQueue[int], stopping: Event) -> None:
    """Takes a share of the cores, and prepares the jobs."""
    global _do, _stopping
    _stopping = stopping
    # A terminal's Ctrl-C reaches all processes: the one that was asked passes it on, as SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    started.put(os.getpid())
    os.sched_setaffinity(0, shares.get())
    _do = setup.prepared()


def _end_with_parent() -> None:
    """Nobody would record what an orphan does, and the next start would meet it in the same folder."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _perform(*arguments: Any) -> Any:
    try:
        with sigterm_interrupts():
            if _stopping.is_set():
                raise KeyboardInterrupt
            return _do(*arguments)
    except KeyboardInterrupt as stopped:
        return Stopped(str(stopped))
