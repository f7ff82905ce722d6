"""Signs between the process that was asked and workers on any host, as files of a folder that all of them see.

FOLDER/owner     locked by the process that was asked, which counts in it while it lives; STOP in place of the number
                 asks the workers to save and stop; when it is gone nobody waits for the workers' results any more
FOLDER/stop      made by anyone: the process that was asked stops
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
from contextlib import contextmanager
from pathlib import Path

OWNER, STOP, DOING = "owner", "stop", "doing"
BEAT = 2.0  # [s] between signs of life
SILENCE = 60.0  # [s] without one after which the process that was asked is taken for lost; file systems keep copies


class Owner:
    """The signs of the process that was asked, in a new folder of ``place``; takes those of dead ones away."""

    def __init__(self, place: Path) -> None:
        place.mkdir(parents=True, exist_ok=True)
        for other in place.iterdir():
            _end_if_dead(other)
        # Hosts share process numbers, and one process may begin twice in a millisecond.
        self.folder = Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=place))
        (self.folder / DOING).mkdir()
        self._file = open(self.folder / OWNER, "w", encoding="utf-8")
        fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._stopping, self._closed, self._writing = threading.Event(), threading.Event(), threading.Lock()
        self._write("0")
        threading.Thread(target=self._beat, daemon=True).start()

    def asked_to_stop(self) -> bool:
        """True once someone has made the file."""
        return (self.folder / STOP).exists()

    def stop(self) -> None:
        """Asks the workers to save and stop."""
        with self._writing:
            self._stopping.set()
            self._write(STOP)

    def busy(self) -> bool:
        """True while a worker is doing a job."""
        return any((self.folder / DOING).iterdir())

    def close(self, keep: bool) -> None:
        """Ends the signs; ``keep``: the folder's other files stay."""
        with self._writing:
            self._closed.set()
            (self.folder / OWNER).unlink(missing_ok=True)
            self._file.close()
        if not keep:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _beat(self) -> None:
        count = 0
        while not self._closed.wait(BEAT):
            count += 1
            with self._writing:
                if not self._stopping.is_set() and not self._closed.is_set():
                    self._write(str(count))

    def _write(self, text: str) -> None:
        # In the locked file itself, as one put in its place would not be locked; always as long, so never half of two.
        self._file.seek(0)
        self._file.write(f"{text:<20}\n")
        self._file.flush()


def _end_if_dead(folder: Path) -> None:
    try:
        with open(folder / OWNER, "rb+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, FileNotFoundError, NotADirectoryError):
        return
    shutil.rmtree(folder, ignore_errors=True)


class Watch:
    """A worker's look at the signs: on STOP it gets a SIGTERM once while it does a job, as when they stay away."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._doing = folder, False
        self._last, self._since = "", time.monotonic()
        self._told = threading.Event()
        self.look()
        threading.Thread(target=self._follow, daemon=True).start()

    @property
    def stopping(self) -> bool:
        """True where the process that was asked wants no more."""
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

    def look(self) -> None:
        """Reads the signs. Ends this process where nobody waits for what it does: the next start would meet it."""
        try:
            # Opened anew: network file systems answer for an open file from their own copy.
            text = (self._folder / OWNER).read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            os._exit(1)
        except OSError:
            return
        if text and text != self._last:
            self._last, self._since = text, time.monotonic()

    def _follow(self) -> None:
        while True:
            time.sleep(BEAT / 2)
            self.look()
            lost = time.monotonic() - self._since > SILENCE
            if self._doing and (self.stopping or lost) and not self._told.is_set():
                self._told.set()
                os.kill(os.getpid(), signal.SIGTERM)
            elif not lost and not self.stopping:
                self._told.clear()
