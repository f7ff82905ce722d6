"""What a Ctrl-C does while a command works."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

PATIENCE = 1.0  # [s] for a Ctrl-C to reach its handler
_handled = threading.Event()  # a Ctrl-C has reached its handler
_interrupted = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Inside, a Ctrl-C that no handler takes within a second is answered by a line; a second one ends the process.

    Python runs handlers between its own instructions, so a compilation delays them by minutes. Not for programs that
    move a robot: the end is that of a killed process.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    handler = signal.getsignal(signal.SIGINT)

    def interrupt(number: int, frame: FrameType | None) -> None:
        _handled.set()
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
def stop_requested(*numbers: signal.Signals, message: str = "") -> Iterator[threading.Event]:
    """The event that the first signal sets, for a loop that polls it; a second one acts as it did before.

    An exception could come between any two instructions: inside Rich it leaves a console that prints nothing any more.
    numbers: which signals, Ctrl-C by default; message: answers a Ctrl-C.
    """
    requested = threading.Event()

    def request(number: int, _frame: FrameType | None) -> None:
        _handled.set()
        requested.set()
        if message and number == signal.SIGINT:
            _write_line(message)
        signal.signal(number, before[number])

    with _handlers(request, *numbers or (signal.SIGINT,)) as before:
        yield requested


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Inside, SIGTERM is a Ctrl-C, also for a worker's job."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handlers(interrupt, signal.SIGTERM):
        yield


@contextmanager
def _handlers(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[dict[int, Any]]:
    """Inside, signals have this handler, except in threads that may set none; yields the handlers from before."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield before
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _write_line(text: str) -> None:
    """Writes a line to stderr; safe in a signal handler."""
    with contextlib.suppress(OSError):
        os.write(2, f"\n{text}\n".encode())


def end_process(status: int) -> NoReturn:
    """Ends the process; after a Ctrl-C during a computation without JAX's own shutdown, which would crash."""
    sys.stdout.flush()
    sys.stderr.flush()
    if _interrupted.is_set():
        os._exit(status)
    sys.exit(status)


def _watch(reading: int) -> None:
    waiting = False  # for a Ctrl-C to reach its handler
    while received := os.read(reading, 1):
        if received[0] != signal.SIGINT:
            continue
        if waiting and not _handled.is_set():
            _write_line("ended at once; the same command continues from what is saved")
            os._exit(130)
        waiting = not _handled.wait(PATIENCE)
        if waiting:
            _write_line("Ctrl-C: stops when the present compilation or computation is done; Ctrl-C again ends at once")
        _handled.clear()
