"""Steps of a study that need nothing of each other, done side by side: one process per share of the machine's cores.

One training on all cores is slower than as many trainings on a core each, and most of a study's steps are independent:
players, seeds, methods. The process that was asked decides what is next, marks what is done and says so; the workers
only do what they are told. What a step makes follows from its name alone, so nothing depends on who does it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from pathlib import Path
from types import FrameType

import jax
from rich.console import Console

from experiments.config.study import Study
from experiments.errors import ConfigError, RunError
from experiments.study.workflow import Journal, Ledger, Step, perform
from mjx_tt import platform


def choose(study: Study, processes: int | None, devices: int | None) -> int:
    """Number of processes for a study's steps: ``processes`` where it is given, else one per core.

    On a robot, on an accelerator, or where a number of devices is asked for, one does them all. Call it when JAX is
    configured. Raises ConfigError for several processes at a robot.
    """
    if study.robot is not None:
        if (processes or 1) > 1:
            raise ConfigError(
                f"--processes {processes}: with a robot the steps are done one after the other; allowed: 1"
            )
        return 1
    if processes is not None:
        return processes
    if devices is not None or study.simulation.devices != "auto":
        return 1
    return len(os.sched_getaffinity(0)) if jax.default_backend() == "cpu" else 1


def run_side_by_side(
    study: Study, folder: Path, steps: list[Step], journal: Journal, console: Console, processes: int
) -> None:
    """Does what is not done yet of a study's steps, each as soon as its inputs are made and a process is free.

    Ctrl-C and SIGTERM stop the workers, which save what they train, and then raise KeyboardInterrupt; so does the first
    error of a step, which is raised when the others have stopped. Raises RunError when a worker was killed.
    """
    ledger = Ledger(steps, journal, console, processes)
    if not ledger.left:
        return
    context = get_context("spawn")  # a fork of a process in which JAX has run hangs
    shares: SimpleQueue[list[int]] = context.SimpleQueue()
    started: SimpleQueue[int] = context.SimpleQueue()
    stopping = context.Event()
    cores = sorted(os.sched_getaffinity(0))
    for i in range(processes):
        shares.put(cores[i::processes] or cores)
    cache = jax.config.values["jax_compilation_cache_dir"]
    executor = ProcessPoolExecutor(processes, context, _start, (study, folder, cache, shares, started, stopping))
    waiting = list(ledger.left)
    running: dict[Future[tuple[str, float]], Step] = {}
    with _sigterm_interrupts():
        try:
            while waiting or running:
                for step in _ready(waiting, list(running.values()))[: processes - len(running)]:
                    running[executor.submit(_perform, step.name)] = step
                    waiting.remove(step)
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    ledger.ended(running[future], *future.result())
                    del running[future]
        except BrokenProcessPool:
            raise RunError(
                f"{folder}: a process was killed, perhaps for want of memory; finished steps are kept. "
                "The same command continues, --processes with fewer needs less memory"
            ) from None
        except BaseException as error:
            said = _stop(running, started, stopping)
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt("\n".join(said)) from None
            raise
        finally:
            executor.shutdown(cancel_futures=True)


def _ready(waiting: list[Step], running: list[Step]) -> list[Step]:
    """The steps, in their order, none of whose inputs is still to be made."""
    coming = {path for step in (*waiting, *running) for path in step.outputs}
    return [step for step in waiting if not coming.intersection(step.inputs)]


def _stop(running: dict[Future[tuple[str, float]], Step], started: SimpleQueue[int], stopping: Event) -> list[str]:
    """Asks the workers to save and stop, and waits for them; what they said. A second Ctrl-C does not wait."""
    stopping.set()  # for those that have not begun
    pids = []
    while not started.empty():
        pids.append(started.get())
    _signal(pids, signal.SIGTERM)
    try:
        wait(running)
    except KeyboardInterrupt:
        _signal(pids, signal.SIGKILL)
    ends = [future.exception() for future in running if future.done() and not future.cancelled()]
    return [str(end) for end in ends if isinstance(end, KeyboardInterrupt) and str(end)]


def _signal(pids: list[int], number: int) -> None:
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            pass


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Inside, SIGTERM is a Ctrl-C, also for a worker's step."""
    if threading.current_thread() is not threading.main_thread():  # where nobody may set handlers
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# -- in a worker ----------------------------------------------------------------------------------------------------

_steps: dict[str, Step] = {}  # of this worker's study, by name
_stopping: Event  # set: no further step is to begin


def _start(
    study: Study,
    folder: Path,
    cache: str | None,
    shares: SimpleQueue[list[int]],
    started: SimpleQueue[int],
    stopping: Event,
) -> None:
    """Takes a share of the cores, and makes the steps."""
    global _stopping
    _stopping = stopping
    # A terminal's Ctrl-C reaches all processes: the one that was asked passes it on, as SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    started.put(os.getpid())
    os.sched_setaffinity(0, shares.get())
    platform.configure(1, cache)
    from experiments.study.pipeline import Loop  # its libraries count the cores when they load

    simulation = study.simulation.model_copy(update={"devices": 1})
    console = Console(force_terminal=False)  # live bars of several processes would overwrite each other
    loop = Loop(study.model_copy(update={"simulation": simulation}), folder, console)
    _steps.update({step.name: step for step in loop.steps()})


def _end_with_parent() -> None:
    """Nobody would mark what an orphan does, and the next start would meet it in the same folder."""
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _perform(name: str) -> tuple[str, float]:
    with _sigterm_interrupts():
        if _stopping.is_set():
            raise KeyboardInterrupt
        return perform(_steps[name])
