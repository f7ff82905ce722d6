"""A command of ``mjx-tt`` on a terminal of its own, as a person has it: keys in, what the screen shows out."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time

from tests.support.paths import ROOT

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")
ROWS, COLUMNS = 60, 220  # as large as nothing has to be cut


class Terminal:
    """Use as a context manager; what still runs at its end is killed."""

    def __init__(self, *command: str) -> None:
        self._hand, end = pty.openpty()
        fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "experiments.cli", *command],
            cwd=ROOT,
            env=os.environ | {"TERM": "xterm-256color"},
            stdin=end,
            stdout=end,
            stderr=end,
            start_new_session=True,
        )
        os.close(end)
        self._text = ""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._hand)

    def press(self, key: str) -> None:
        """Type a key; what was shown before it is forgotten."""
        self.read(0.0)
        self._text = ""
        os.write(self._hand, key.encode())

    def read(self, seconds: float) -> str:
        """All that was shown since the last key, after ``seconds`` more."""
        end = time.monotonic() + seconds
        while select.select([self._hand], [], [], max(end - time.monotonic(), 0.0))[0]:
            try:
                self._text += os.read(self._hand, 65536).decode(errors="replace")
            except OSError:  # the command has ended
                break
        return ESCAPES.sub("", self._text)

    def wait(self, pattern: str, seconds: float = 60.0) -> str:
        """Text shown since the last key, once ``pattern`` is in it."""
        end = time.monotonic() + seconds
        while not re.search(pattern, text := self.read(0.1)):
            assert time.monotonic() < end, f"{pattern!r} was not shown within {seconds:g} s, but:\n{text[-4000:]}"
        return text

    def ended(self, seconds: float = 60.0) -> int:
        """Exit status, once the command has ended."""
        end = time.monotonic() + seconds
        while self.process.poll() is None:
            assert time.monotonic() < end, f"it still runs:\n{self.read(0.0)[-4000:]}"
            self.read(0.1)
        return self.process.returncode
