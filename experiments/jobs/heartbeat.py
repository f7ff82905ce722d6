"""Heartbeat of the process that gives jobs, and the watchdog of its workers: files of a folder that all hosts see.

FOLDER/heartbeat locked by the process that gives jobs, which counts in it while it lives; STOP in place of the number
                 asks the workers to save and stop; when the file is gone nobody waits for the workers' results
FOLDER/stop      made by anyone: the process that gives jobs stops
FOLDER/doing/    an empty file for every job that a worker is doing
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HEARTBEAT, STOP, DOING = "heartbeat", "stop", "doing"
PERIOD = 2.0  # [s] between beats
TIMEOUT = 60.0  # [s] without a beat after which its process is taken for lost; network file systems keep copies


class Heartbeat:
    """Beats in a new folder of ``place``, and removes folders of processes that are dead."""

    def __init__(self, place: Path) -> None:
        place.mkdir(parents=True, exist_ok=True)
        for other in place.iterdir():
            _remove_if_dead(other)
        # Hosts share process numbers, and one process may begin twice in a millisecond.
        self.folder = Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=place))
        (self.folder / DOING).mkdir()
        self._file = open(self.folder / HEARTBEAT, "w", encoding="utf-8")
        fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._ended, self._writing = threading.Event(), threading.Lock()
        self._write("0")
        threading.Thread(target=self._beat, daemon=True).start()

    def asked_to_stop(self) -> bool:
        """True once someone has made the file ``stop``."""
        return (self.folder / STOP).exists()

    def stop(self) -> None:
        """Asks the workers to save and stop."""
        with self._writing:
            self._ended.set()
            self._write(STOP)

    def busy(self) -> bool:
        """True while a worker is doing a job."""
        return any((self.folder / DOING).iterdir())

    def close(self, keep: bool) -> None:
        """Ends the beats, and with them workers that still live; ``keep``: the folder's other files stay."""
        with self._writing:
            self._ended.set()
            (self.folder / HEARTBEAT).unlink(missing_ok=True)
            self._file.close()
        if not keep:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _beat(self) -> None:
        count = 0
        while not self._ended.wait(PERIOD):
            count += 1
            with self._writing:
                if not self._ended.is_set():
                    self._write(str(count))

    def _write(self, text: str) -> None:
        # In the locked file itself, as one put in its place would not be locked; always as long, so never half of two.
        self._file.seek(0)
        self._file.write(f"{text:<20}\n")
        self._file.flush()


def _remove_if_dead(folder: Path) -> None:
    with suppress(BlockingIOError, FileNotFoundError, NotADirectoryError):
        with open(folder / HEARTBEAT, "rb+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)


class Watchdog:
    """Follows a heartbeat in a worker: while a job is done, STOP or silence sends this process a SIGTERM, once."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._doing, self._told = folder, False, False
        self._last, self._since = "", time.monotonic()
        self._look()
        threading.Thread(target=self._follow, daemon=True).start()

    @property
    def stopping(self) -> bool:
        """True where the process that gives jobs wants no more."""
        return self._last == STOP

    @contextmanager
    def doing(self, name: str) -> Iterator[None]:
        """Inside, the worker does the job of that name."""
        mark = self._folder / DOING / name.replace(os.sep, "_")
        mark.touch()
        self._doing = True
        try:
            yield
        finally:
            self._doing = False
            mark.unlink(missing_ok=True)

    def _look(self) -> None:
        """Reads the beat. Ends this process where nobody waits for what it does: the next start would meet it."""
        try:
            # Opened anew: network file systems answer for an open file from their own copy.
            text = (self._folder / HEARTBEAT).read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            os._exit(1)
        except OSError:
            return
        if text and text != self._last:
            self._last, self._since = text, time.monotonic()

    def _follow(self) -> None:
        while True:
            time.sleep(PERIOD / 4)
            self._look()
            lost = self.stopping or time.monotonic() - self._since > TIMEOUT
            if lost and self._doing and not self._told:
                self._told = True
                os.kill(os.getpid(), signal.SIGTERM)
            elif not lost:
                self._told = False
