"""Jobs and their order, and the engine that does them.

A job is known by its name and does what follows from files: killed at any moment and given again, it goes on from what
it left. The process that was asked decides what is next and records what has ended; workers only do what they are told,
so nothing depends on who does it.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.interrupts import sigterm_interrupts
from experiments.jobs import worker
from experiments.jobs.heartbeat import Heartbeat
from experiments.jobs.worker import Stopped
from experiments.options import start_jax

POLL = 0.5  # [s] between looks at whether a stop was asked for, and at which programs are compiled
SAVING = 600.0  # [s] for jobs to save when they are asked to stop: a compilation comes first
FOLDER = ".jobs"  # of the heartbeat and of Parsl's logs, in that of the results


@dataclass(frozen=True)
class Setup:
    """Preparation of a worker, in a form that travels to other hosts.

    prepare    "module:function", called once in each worker with ``given``; returns the function that does a job. Its
               module is loaded when the worker has its cores, which libraries count when they load
    devices    host devices of a worker, the least that its jobs need
    cache      folder of compiled programs; None: the user's
    """

    prepare: str
    given: tuple[Any, ...]
    devices: int = 1
    cache: str | None = None

    def prepared(self) -> Callable[..., Any]:
        """Function that does a job, in a worker."""
        start_jax(self.devices, cache=self.cache)
        module, _, function = self.prepare.partition(":")
        return getattr(importlib.import_module(module), function)(*self.given)


@dataclass(frozen=True)
class Job:
    """One call of the function that a worker has prepared.

    arguments   of the call, in a form that travels
    after       names of jobs that have to end before; others count as done
    program     jobs of one program wait until the first of them has compiled it: then it is in the cache
    compiled    file that is not empty once it has; None: when the first has ended
    """

    name: str
    arguments: tuple[Any, ...]
    after: frozenset[str] = frozenset()
    program: str | None = None
    compiled: Path | None = None


class Engine:
    """Does jobs in workers, which see this process's heartbeat. ``site`` has the two kinds.

    slots: jobs that it takes at a time
    replaces: another worker goes on with the job of one that was ended

    Args:
        setup: preparation of each worker.
        folder: that of the results, which all hosts see at the same path.
    """

    slots: int
    replaces: bool

    def __init__(self, setup: Setup, folder: Path) -> None:
        self.heartbeat = Heartbeat(folder.absolute() / FOLDER)
        self._session = (setup.prepared, str(self.heartbeat.folder), str(Path.cwd()), self.replaces)

    def submit(self, job: Job) -> Future[Any]:
        """Begins a job. Raises nothing."""
        return self._call(worker.work, *self._session, job.name, job.arguments)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Result of the function in a worker."""
        raise NotImplementedError

    def explain(self, job: Job, error: BaseException) -> BaseException:
        """A job's error in words for the person who gave it, where it is not the job's own."""
        raise NotImplementedError

    def end(self) -> None:
        """Ends the workers."""
        raise NotImplementedError


def run(
    engine: Engine,
    jobs: Sequence[Job],
    ended: Callable[[Job, Any], None],
    failed: Callable[[Job, Exception], None] | None = None,
) -> None:
    """Does the jobs, each as soon as those that it comes after have ended and a worker is free; ``ended`` gets results.

    failed: told of a job's error, which then costs no other job; without it the first error stops the others, which
    save what they have, and is raised. Ctrl-C and SIGTERM stop all in the same way and raise KeyboardInterrupt with
    what the jobs said; so does the file ``stop``.
    """
    waiting = list(jobs)
    running: dict[Future[Any], Job] = {}
    warm: set[str] = set()
    erred = False
    with sigterm_interrupts():
        try:
            while waiting or running:
                for job in _ready(waiting, list(running.values()), warm)[: engine.slots - len(running)]:
                    running[engine.submit(job)] = job
                    waiting.remove(job)
                for future in wait(running, POLL, FIRST_COMPLETED).done:
                    job, error = running[future], future.exception()
                    if error is not None:
                        erred, said = True, engine.explain(job, error)
                        if failed is None or not isinstance(said, Exception):
                            raise said
                        failed(job, said)
                    elif isinstance(result := future.result(), Stopped):
                        raise KeyboardInterrupt(result.text)
                    else:
                        ended(job, result)
                    if job.program:
                        warm.add(job.program)
                    del running[future]
                if engine.heartbeat.asked_to_stop():
                    raise KeyboardInterrupt
        except BaseException as error:
            texts = _stop(engine, running)
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt("\n".join(texts)) from None
            raise
        finally:
            engine.end()
            engine.heartbeat.close(keep=erred)


def _ready(waiting: list[Job], running: list[Job], warm: set[str]) -> list[Job]:
    """The jobs, in their order, that nothing holds back."""
    coming = {job.name for job in (*waiting, *running)}
    warm |= {job.program for job in running if job.program and _filled(job.compiled)}
    compiling = {job.program for job in running if job.program} - warm
    found: list[Job] = []
    for job in waiting:
        if coming.intersection(job.after) or job.program in compiling:
            continue
        found.append(job)
        if job.program and job.program not in warm:
            compiling.add(job.program)
    return found


def _filled(path: Path | None) -> bool:
    return path is not None and path.exists() and path.stat().st_size > 0


def _stop(engine: Engine, running: dict[Future[Any], Job]) -> list[str]:
    """Asks the workers to save and to stop, and waits for those that have begun; texts of what the jobs said.

    A second Ctrl-C ends the workers at once.
    """
    try:
        engine.heartbeat.stop()
        until = time.monotonic() + SAVING
        while time.monotonic() < until and engine.heartbeat.busy():
            wait(running, 0.2)
        wait(running, 1.0)  # results under way
    except KeyboardInterrupt:
        engine.heartbeat.close(keep=True)
    ends = [f.result() for f in running if f.done() and f.exception() is None]
    return [end.text for end in ends if isinstance(end, Stopped) and end.text]
