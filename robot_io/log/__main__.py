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
from contextlib import suppress

from robot_io.log.messages import Event, Level, LogError
from robot_io.log.recorder import FRAME
from robot_io.log.writer import SessionWriter

FLUSH_SECONDS = 0.2
LOOK_SECONDS = 0.05  # between looks into the pipe, which holds more than five seconds
PARTING_SECONDS = 2.0  # that the control process has to end after SIGTERM: a shutdown sends it to both


def take_records(buffer: bytearray) -> list[bytes]:
    """The packed records that are complete in a stream of frames, which leave the buffer."""
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
    buffer, malformed = bytearray(), 0
    next_flush = time.monotonic() + FLUSH_SECONDS
    while True:
        orphaned = os.getppid() != parent  # a child of the control process may hold the pipe open beyond its death
        try:
            data = os.read(stream, 1 << 20)
            if not data:
                return malformed
            buffer += data
        except BlockingIOError:
            if orphaned:
                return malformed
            # Looking now and then instead of being woken: a wake-up per record would disturb the control thread.
            time.sleep(LOOK_SECONDS)
        for packed in take_records(buffer):
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
    with suppress(OSError, AttributeError):  # the control process's priority is not for this one, nor may it preempt it
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(5)
    try:
        writer = SessionWriter(pickle.load(sys.stdin.buffer))  # nothing follows it before the answer
        _send_line({"ready": True})
        malformed = record(sys.stdin.fileno(), writer)
        _send_line({"path": str(writer.finish(malformed))})
        return 0
    except OSError as error:
        reason = str(error)
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {error}"
    _send_line({"error": reason})
    return 1


def _send_line(line: dict) -> None:
    try:
        print(json.dumps(line), flush=True)
    except BrokenPipeError:
        sys.stdout = None  # nobody listens any more; the interpreter would complain when it flushes


if __name__ == "__main__":
    sys.exit(main())
