"""Lines that tell what a command is doing and how long it took, and what a Ctrl-C will do meanwhile."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import FrameType
from typing import NoReturn

from rich.console import Console

Stage = Callable[[str], AbstractContextManager[None]]
PATIENCE = 1.0  # [s] for a Ctrl-C to be acted on
_acted = threading.Event()
_interrupted = threading.Event()


def silent(_text: str) -> AbstractContextManager[None]:
    """A stage without a line."""
    return nullcontext()


def printed(console: Console, name: str) -> Stage:
    """Stages whose lines begin with ``name``: the text when one begins, its seconds when it is done."""

    @contextmanager
    def stage(text: str) -> Iterator[None]:
        console.print(f"{name}: {text} ...", end="", highlight=False, soft_wrap=True, markup=False)
        began, end = time.monotonic(), ""
        try:
            yield
            end = f" {time.monotonic() - began:.1f} s"
        finally:
            console.print(end, highlight=False)

    return stage


def acted_on(_number: int = 0, _frame: FrameType | None = None) -> None:
    """Tells ``interruptible`` that a Ctrl-C has reached its handler."""
    _acted.set()


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside, a Ctrl-C that no handler acts on within a second is answered by a line, a second one ends the process.

    Python's handlers run between its own instructions, so a compilation holds them up for minutes. Not for programs
    that move a robot: the end is that of a process which is killed.
    """
    if threading.current_thread() is not threading.main_thread():  # where nobody may set handlers
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    handler = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, frame: FrameType | None) -> None:
        acted_on()
        if callable(handler):
            handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    watch = threading.Thread(target=_watch, args=(reading,), daemon=True)
    watch.start()
    try:
        yield
    except KeyboardInterrupt:
        _interrupted.set()
        raise
    finally:
        signal.set_wakeup_fd(before)
        signal.signal(signal.SIGINT, handler)
        os.close(writing)
        watch.join()
        os.close(reading)


@contextmanager
def orderly() -> Iterator[threading.Event]:
    """The event that the first Ctrl-C inside sets, for a loop that looks at it; a second one raises KeyboardInterrupt.

    An exception would come between any two instructions: within Rich it leaves a console that prints nothing any more.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # where nobody may set handlers
        yield asked
        return
    handler = signal.getsignal(signal.SIGINT)

    def ask(number: int, frame: FrameType | None) -> None:
        if asked.is_set() and callable(handler):
            handler(number, frame)
        asked.set()

    signal.signal(signal.SIGINT, ask)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, handler)


def say(text: str) -> None:
    """A line on stderr, from a signal's handler too."""
    with contextlib.suppress(OSError):
        os.write(2, f"\n{text}\n".encode())


def leave(status: int) -> NoReturn:
    """Ends the process; after a Ctrl-C in a computation without JAX's own end, which would crash in its threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    if _interrupted.is_set():
        os._exit(status)
    sys.exit(status)


def _watch(reading: int) -> None:
    waiting = False  # for a Ctrl-C to be acted on
    while received := os.read(reading, 1):
        if received[0] != signal.SIGINT:
            continue
        if waiting and not _acted.is_set():
            say("ended at once; the same command continues from what is saved")
            os._exit(130)
        waiting = not _acted.wait(PATIENCE)
        if waiting:
            say("Ctrl-C: stops when the present compilation or computation is done; Ctrl-C again ends at once")
        _acted.clear()
