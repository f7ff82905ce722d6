"""The control side of the log: recorders that the control thread hands its records to.

``Recorder`` packs a record in a few microseconds and puts it into a pipe without waiting; a process of its own
(``robot_io.log.__main__``) encodes it and writes the file. A full pipe drops the record and counts it.
A pipe rather than a socket pair: it takes frames of up to 4 KiB whole or not at all, and holds 1 MiB where
unprivileged sockets hold a few hundred records.
"""

from __future__ import annotations

import fcntl
import json
import os
import pickle
import select
import struct
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self

from robot_io.contract import PAPER, Contract
from robot_io.log.messages import LARGEST, End, Event, Level, LogError, Record
from robot_io.log.writer import SessionWriter, sample_clock_offset, session

PIPE_SIZE = 1 << 20  # bytes, what Linux grants without privileges: more than five seconds of a session
START_TIMEOUT = 30.0  # [s] for the recorder process to import its libraries and open the file
FRAME = struct.Struct("<H")  # length of the packed record that follows
_ATOMIC = LARGEST + FRAME.size


class SessionRecorder:
    """Recorder as the bridge uses it; this one keeps nothing. In a ``with`` block it is closed at its end."""

    dropped: int = 0  # records lost so far

    @property
    def failure(self) -> str | None:
        """Reason why nothing is recorded any more; None while all is well."""
        return None

    def put(self, *records: Record) -> None:
        """Takes records."""

    def close(self) -> Path | None:
        """Finishes the log and returns its path."""
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


NullRecorder = SessionRecorder


class _Process(subprocess.Popen[bytes]):
    """A process with pipes to its input and from its output."""

    stdin: IO[bytes]
    stdout: IO[bytes]


class Recorder(SessionRecorder):
    """Records a session through a process of its own. Used by one thread, the control thread."""

    def __init__(
        self,
        folder: str | Path,
        name: str,
        metadata: Mapping[str, Any],
        attachments: Mapping[str, str | bytes] | None = None,
        robot: Contract = PAPER,
    ) -> None:
        """Starts the recorder process and returns when its file ``folder/name.mcap.part`` is open.

        metadata     facts about the session, such as the artefact's digest and the git state; what is no string is
                     kept as JSON
        attachments  contents of files to be kept whole, such as robot.yaml, by name
        robot        whose joints are recorded

        To be called before the control thread takes real-time priority. Raises LogError when the file exists or cannot
        be made, with the reason.
        """
        self.malformed = 0
        self._reported = (0, 0)  # dropped and malformed, of which the log knows
        self._reason = ""  # why the first malformed record was refused
        self._broken = False
        self._answer: dict[str, Any] | None = None  # the recorder process's last words
        self._result: Path | None = None
        offset, start_time = sample_clock_offset(), time.monotonic()
        self._session = session(folder, name, metadata, attachments or {}, offset, start_time, True, robot)
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
        self._process = _Process(
            [sys.executable, "-m", "robot_io.log"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in the terminal ends the control process only
            env={**os.environ, "PYTHONPATH": path},
        )
        self._pipe = self._process.stdin.fileno()
        try:
            self._hand_over()
        except BaseException as error:
            self._process.kill()
            self._process.wait()
            self._process.stdout.close()
            with suppress(BrokenPipeError):
                self._process.stdin.close()
            if isinstance(error, BrokenPipeError):
                raise LogError(f"{self._session.unfinished}: the recorder process ended at once") from error
            raise

    def _hand_over(self) -> None:
        pickle.dump(self._session, self._process.stdin)
        self._process.stdin.flush()
        answer = self._read_line(START_TIMEOUT)
        if answer is None:
            raise LogError(f"{self._session.unfinished}: the recorder process does not start in {START_TIMEOUT:g} s")
        if "error" in answer:
            raise LogError(answer["error"])
        with suppress(OSError):  # the default still holds a third of a second
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_SIZE)
        os.set_blocking(self._pipe, False)

    @property
    def failure(self) -> str | None:
        if not self._broken:
            return None
        answer = self._read_answer(0.0) or {}
        reason = "it was asked to" if "path" in answer else answer.get("error", "without a word")
        return f"{self._session.unfinished}: the recorder process has ended ({reason}), nothing is recorded any more"

    def put(self, *records: Record) -> None:
        """Hands records over without ever waiting or raising.

        Several records in one call cost one system call, and are kept or dropped together while they fit into 4 KiB.
        What a full pipe or a dead recorder loses is counted in ``dropped``; records that cannot be packed, a mistake of
        the program, in ``malformed``. Both counts get into the log as events and at its end.
        """
        if self._broken:
            self.dropped += len(records)
            return
        frames: list[bytes] = []
        size = 0
        for record in records:
            try:
                packed = record.pack()
                frame = FRAME.pack(len(packed)) + packed
            except Exception as error:  # whatever is wrong with a record, the robot must go on
                self.malformed += 1
                self._reason = self._reason or f"{type(error).__name__}: {error}"
                continue
            if size + len(frame) > _ATOMIC:
                self._send(frames)
                frames, size = [], 0
            frames.append(frame)
            size += len(frame)
        if frames and self._send(frames) and self._reported != (self.dropped, self.malformed):
            self._report(records[-1].log_time)

    def close(self, timeout: float = 10.0) -> Path:
        """Ends the recording and waits until the file is complete; returns its path. May be called again.

        Raises LogError when the log could not be finished, with what is left of it.
        """
        if self._result is not None:
            return self._result
        left = self._session.unfinished
        if self._process.stdout.closed:
            raise LogError(f"{left}: not finished, and closed before")
        end, deadline = End(self.dropped, self.malformed).pack(), time.monotonic() + timeout
        while not self._write(FRAME.pack(len(end)) + end) and not self._broken and time.monotonic() < deadline:
            time.sleep(0.001)  # until there is room
        self._process.stdin.close()
        answer = self._read_answer(timeout) or {"error": f"the recorder process did not answer in {timeout:g} s"}
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._broken = True
        if "error" in answer:
            raise LogError(f"{left}: not finished ({answer['error']}); mjx-tt log salvage {left} saves what it holds")
        self._result = Path(answer["path"])
        return self._result

    def _send(self, frames: list[bytes]) -> bool:
        sent = self._write(b"".join(frames))
        if not sent:
            self.dropped += len(frames)
        return sent

    def _write(self, data: bytes) -> bool:
        try:
            os.write(self._pipe, data)
            return True
        except BlockingIOError:
            return False
        except OSError:
            self._broken = True
            return False

    def _report(self, time: float | None) -> None:
        """Tells the log what it missed, now that there is room again."""
        if time is None:
            return
        dropped, malformed = self.dropped - self._reported[0], self.malformed - self._reported[1]
        text = {"dropped": dropped, "malformed": malformed, "total_dropped": self.dropped, "reason": self._reason[:500]}
        packed = Event(time, Level.WARNING, "log_dropped", json.dumps(text)).pack()
        if self._write(FRAME.pack(len(packed)) + packed):  # else next time
            self._reported = self.dropped, self.malformed

    def _read_answer(self, timeout: float) -> dict[str, Any] | None:
        self._answer = self._answer or self._read_line(timeout)
        return self._answer

    def _read_line(self, timeout: float) -> dict[str, Any] | None:
        """The next line that the recorder process says, None when it says nothing in time."""
        line, deadline, stdout = b"", time.monotonic() + timeout, self._process.stdout
        while not line.endswith(b"\n"):
            if not select.select([stdout], [], [], max(0.0, deadline - time.monotonic()))[0]:
                return None
            part = os.read(stdout.fileno(), 1 << 16)
            if not part:
                return {"error": "the recorder process has ended"}
            line += part
        return json.loads(line)


class FileRecorder(SessionRecorder):
    """The same log written in the calling process: for lock-step runs, where time stands still while it writes."""

    def __init__(
        self,
        folder: str | Path,
        name: str,
        metadata: Mapping[str, Any],
        attachments: Mapping[str, str | bytes] | None = None,
        start_time: float = 0.0,
        clock_offset_ns: int = 0,
        robot: Contract = PAPER,
    ) -> None:
        """As ``Recorder``. Reads no clock and names no host, so that equal runs give equal files.

        ``start_time`` [s] is the session's start on the scheduler's clock, ``clock_offset_ns`` puts that clock's zero
        somewhere else than at the start of 1970.
        """
        made = session(folder, name, metadata, attachments or {}, clock_offset_ns, start_time, False, robot)
        self._writer = SessionWriter(made)
        self._result: Path | None = None

    def put(self, *records: Record) -> None:
        """Writes records. Raises LogError for a malformed one, OSError when the disk refuses."""
        for record in records:
            self._writer.write(record.pack())

    def flush(self) -> None:
        """Brings everything so far into the file, for whoever reads it meanwhile."""
        self._writer.flush()

    def close(self) -> Path:
        """Completes the file and returns its path."""
        if self._result is None:
            self._writer.write(End(0, 0).pack())
            self._result = self._writer.finish()
        return self._result
