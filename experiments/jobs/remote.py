"""A worker that Parsl has started, on any host: prepares itself at its first job, as Parsl has no initialiser."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.errors import LockedError
from experiments.jobs.engine import Setup, Stopped, sigterm_interrupts
from experiments.jobs.signs import Watch

PATIENCE = 120.0  # [s] for the lock of a folder whose worker was lost: network file systems free it late


class WorkerEndedError(Exception):
    """The batch system ended a worker, which saved what it had: another one goes on."""


@dataclass(frozen=True)
class Session:
    """Everything that a worker has to know besides its job.

    signs    folder of the signs of life
    folder   working directory of the process that was asked; paths are the same on all hosts
    """

    setup: Setup
    signs: str
    folder: str


_ready: dict[str, tuple[Any, Watch]] = {}  # by the session's signs


def work(session: Session, name: str, arguments: tuple[Any, ...]) -> Any:
    """Does a job: its result, or ``Stopped``. Raises what the job does, WorkerEndedError for a SIGTERM from outside."""
    if session.signs not in _ready:
        watch = Watch(Path(session.signs))
        if watch.stopping:
            return Stopped("")
        os.chdir(session.folder)
        if session.folder not in sys.path:
            sys.path.insert(0, session.folder)  # as where the command was given: the project's tests are there
        _ready[session.signs] = session.setup.prepared(), watch
    do, watch = _ready[session.signs]
    try:
        with watch.doing(name), sigterm_interrupts():
            if watch.stopping:
                raise KeyboardInterrupt
            return _patiently(do, arguments)
    except KeyboardInterrupt as stopped:
        if watch.stopping:
            return Stopped(str(stopped))
        raise WorkerEndedError(f"{name}: {stopped or 'ended by SIGTERM'}") from None


def _patiently(do: Any, arguments: tuple[Any, ...]) -> Any:
    until = time.monotonic() + PATIENCE
    while True:
        try:
            return do(*arguments)
        except LockedError:
            if time.monotonic() > until:
                raise
            time.sleep(1.0)
