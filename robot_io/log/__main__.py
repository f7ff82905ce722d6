"""The recorder process: frames from standard input into an MCAP file, until the input ends.

Started by ``robot_io.log.recorder.Recorder``. It says one line of JSON when the file is open and one when it is done.
The input ends when the control process closes it or dies, however it dies: then the file is completed. If this process
dies as well, all but the last moments stands in complete chunks.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
import time
import traceback

from robot_io.log.messages import Event, Level, LogError
from robot_io.log.recorder import FRAME, SETUP
from robot_io.log.writer import SessionWriter

FLUSH_SECONDS = 0.2
LOOK_SECONDS = 0.05  # between looks into the pipe, which holds more than five seconds
PARTING_SECONDS = 2.0  # that the control process has to end after SIGTERM: a shutdown sends it to both


class Frames:
    """Cuts packed records out of the stream of bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """The records that ``data`` completes."""
        buffer = self._buffer
        buffer += data
        records, start = [], 0
        while start + FRAME.size <= len(buffer):
            end = start + FRAME.size + FRAME.unpack_from(buffer, start)[0]
            if end > len(buffer):
                break
            records.append(bytes(buffer[start + FRAME.size : end]))
            start = end
        del buffer[:start]
        return records


def record(stream: int, writer: SessionWriter) -> int:
    """Writes what comes out of file descriptor ``stream`` until it ends; returns how many records were malformed."""
    parent = os.getppid()
    leave_at: list[float] = []
    signal.signal(signal.SIGTERM, lambda *_: leave_at.append(time.monotonic() + PARTING_SECONDS))
    os.set_blocking(stream, False)
    frames, malformed = Frames(), 0
    next_flush = time.monotonic() + FLUSH_SECONDS
    while True:
        orphaned = os.getppid() != parent  # a child of the control process may hold the pipe open beyond its death
        try:
            data = os.read(stream, 1 << 20)
            if not data:
                return malformed
        except BlockingIOError:
            if orphaned:
                return malformed
            # Looking now and then instead of being woken: a wake-up per record would disturb the control thread.
            data = b""
            time.sleep(LOOK_SECONDS)
        for packed in frames.feed(data):
            try:
                writer.write(packed)
            except LogError as error:
                malformed += 1
                print(f"log: malformed record left out: {error}", file=sys.stderr)
        now = time.monotonic()
        if now >= next_flush:
            writer.flush()
            next_flush = now + FLUSH_SECONDS
        if leave_at and now >= leave_at[0]:
            text = "the recorder process was asked to end before the control process did"
            writer.write(Event(now, Level.ERROR, "log_ended", text).pack())
            return malformed


def main() -> int:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _lower_priority()
    stream = sys.stdin.fileno()
    try:
        setup = _read_exactly(stream, SETUP.unpack(_read_exactly(stream, SETUP.size))[0])
        writer = SessionWriter(pickle.loads(setup))
        _send_line({"ready": True})
        malformed = record(stream, writer)
        _send_line({"path": str(writer.finish(malformed))})
    except OSError as error:
        _send_line({"error": str(error)})
        return 1
    except Exception as error:
        traceback.print_exc()
        _send_line({"error": f"{type(error).__name__}: {error}"})
        return 1
    return 0


def _lower_priority() -> None:
    """The control process's priority is not for this one, which shall not preempt it either."""
    try:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(5)
    except (OSError, AttributeError):
        pass


def _read_exactly(stream: int, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = os.read(stream, count - len(data))
        if not part:
            raise OSError("the control process ended before the log was open")
        data += part
    return data


def _send_line(line: dict) -> None:
    try:
        print(json.dumps(line), flush=True)
    except BrokenPipeError:
        sys.stdout = None  # nobody listens any more; the interpreter would complain when it flushes


if __name__ == "__main__":
    sys.exit(main())
