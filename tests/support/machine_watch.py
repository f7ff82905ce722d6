"""A watch over the machine while tests keep real time: a test that fails where the machine itself stood is run again.

A computer shared with others takes its cores away now and then; on one used for this project that was 20 to 40 ms every
few minutes, and emulated hardware, which then stands as well, is rightly taken for dead after 50 ms. One process on
each core wakes up every 2 ms, before all else where the system lets it, so that it is not the tested programs that keep
it waiting. Nothing is run again without such a pause, and no test more than twice.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from functools import cache

import pytest

PERIOD = 0.002  # [s]
PRIORITY = 60  # of SCHED_FIFO: above the control process's and the emulated robot's
PAUSE = 0.02  # [s] of a core that stood, from which on a failure says nothing of the tested program


class MachineWatch:
    """Processes on all cores, of which each measures how long its core stood at most since ``reset``."""

    def __init__(self) -> None:
        cores = sorted(os.sched_getaffinity(0))
        context = multiprocessing.get_context("spawn")
        self._longest = context.Array("d", len(cores), lock=False)
        self.processes = [
            context.Process(target=_watch, args=(self._longest, i, core), daemon=True) for i, core in enumerate(cores)
        ]
        for process in self.processes:
            process.start()
        while not all(self._longest):  # each has woken once
            time.sleep(PERIOD)

    def reset(self) -> None:
        self._longest[:] = [0.0] * len(self._longest)

    def longest(self) -> float:
        """Longest pause [s] of any core since ``reset``."""
        return max(self._longest)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.join()


def _watch(longest: list[float], i: int, core: int) -> None:
    os.sched_setaffinity(0, {core})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        pass  # then what else runs on this core counts as well
    parent = os.getppid()
    before = time.monotonic()
    while os.getppid() == parent:
        time.sleep(PERIOD)
        now = time.monotonic()
        longest[i] = max(longest[i], now - before - PERIOD)
        before = now


@cache
def _machine() -> MachineWatch:
    return MachineWatch()


def _stood() -> bool:
    return _machine().longest() >= PAUSE


@pytest.fixture(autouse=True)
def watched_machine(request: pytest.FixtureRequest) -> Iterator[None]:
    if request.node.get_closest_marker("realtime") is not None:
        _machine().reset()
    yield


def rerun_after_pauses(items: list[pytest.Item]) -> None:
    """Lets a test in real time run again where the machine stood still in it."""
    for item in items:
        if item.get_closest_marker("realtime") is not None:
            item.add_marker(pytest.mark.flaky(reruns=2, condition=_stood))
