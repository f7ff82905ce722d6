"""A worker, in a process of this machine or started by Parsl on any host: prepares itself at its first job."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import connection, parent_process
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

from experiments.errors import LockedError
from experiments.interrupts import sigterm_interrupts
from experiments.jobs.heartbeat import Watchdog

PATIENCE = 120.0  # [s] for the lock of a folder whose worker was lost: network file systems free it late


class WorkerEndedError(Exception):
    """The batch system ended a worker, which saved what it had: another one goes on."""


@dataclass(frozen=True)
class Stopped:
    """Result of a job that saved what it had because it was asked to stop; ``text`` says what."""

    text: str


_ready: dict[str, tuple[Callable[..., Any], Watchdog]] = {}  # by the heartbeat's folder


def work(
    prepare: Callable[[], Callable[..., Any]],
    heartbeat: str,
    folder: str,
    replaced: bool,
    name: str,
    arguments: tuple[Any, ...],
) -> Any:
    """Does a job: its result, or ``Stopped``.

    Args:
        prepare: returns the function that does a job; called once in each worker.
        heartbeat: folder of the heartbeat.
        folder: working directory of the process that gives jobs; paths are the same on all hosts.
        replaced: another worker goes on with the job of one that gets a SIGTERM from outside.
        name: of the job.
        arguments: of the function.

    Raises:
        Exception: what the job does.
        WorkerEndedError: a SIGTERM from outside.
    """
    if heartbeat not in _ready:
        watchdog = Watchdog(Path(heartbeat))
        if watchdog.stopping:
            return Stopped("")
        os.chdir(folder)
        if folder not in sys.path:
            sys.path.insert(0, folder)  # as where the command was given: the project's tests are there
        _ready[heartbeat] = prepare(), watchdog
    do, watchdog = _ready[heartbeat]
    until = time.monotonic() + PATIENCE
    try:
        with watchdog.doing(name), sigterm_interrupts():
            while not watchdog.stopping:
                try:
                    return do(*arguments)
                except LockedError:
                    if time.monotonic() > until:
                        raise
                    time.sleep(1.0)
            return Stopped("")
    except KeyboardInterrupt as stopped:
        if watchdog.stopping or not replaced:
            return Stopped(str(stopped))
        raise WorkerEndedError(f"{name}: {stopped or 'ended by SIGTERM'}") from None


def start_local(shares: SimpleQueue[list[int]]) -> None:
    """Begins a process of this machine, with its share of the cores; it ends with its parent."""
    # A terminal's Ctrl-C reaches all processes: the one that gives jobs passes it on.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.sched_setaffinity(0, shares.get())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Nobody would record what an orphan does, and the next start would meet it in the same folder."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
