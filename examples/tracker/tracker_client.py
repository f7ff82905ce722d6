"""Reference tracker client: what a camera system has to send to the bridge. Needs Python's standard library only.

Copy ``Frame`` and ``datagram``, and send one datagram per camera frame to the bridge's UDP port, also while no ball is
seen: silence with a ball in play is a fault. Run as a program, it sends a synthetic ball and prints what it sends:

    python examples/tracker/tracker_client.py 127.0.0.1 6520 10

A robot that is armed plays the synthetic ball like any other: disarm it first. tracker_client.c is the same in C.
docs/how-to/connect-a-tracker.md describes the datagram, the clock and what the bridge refuses.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
import zlib
from dataclasses import dataclass

RATE = 125  # [Hz] frames per second
REACH = 10.0  # [m] the bridge refuses coordinates beyond this
BODY = struct.Struct("<4sBBHIq3d")  # little endian, no padding: 44 bytes, followed by the CRC-32 of these


@dataclass(frozen=True)
class Frame:
    """One camera frame.

    sequence     counts every frame by 1, whether or not it shows a ball; wraps around after 2**32 - 1. Gaps count as
                 lost frames; a number that was sent before, or an earlier one, is refused
    ball         number of the ball in play, 1 more with each new ball; wraps around after 65535. A ball keeps its
                 number while it is out of sight, and frames without a ball repeat the last number
    captured_ns  [ns] when the cameras exposed the frame, not when it was computed or sent. A monotonic clock: it never
                 jumps, and later frames have later times. On the bridge's own computer CLOCK_MONOTONIC (as here); on
                 another one the bridge adds tracker.clock_offset
    position     (x, y, z) [m] of the ball's centre in the table frame: origin at the centre of the table's surface,
                 x across, y along the table towards the human, z up. None while no ball is seen
    """

    sequence: int
    ball: int
    captured_ns: int
    position: tuple[float, float, float] | None


def datagram(frame: Frame) -> bytes:
    """The 48 bytes of a frame. Raises ValueError for a position that the bridge would refuse."""
    position = frame.position or (0.0, 0.0, 0.0)  # zeros where no ball is seen
    if not all(abs(x) <= REACH for x in position):  # NaN fails every comparison
        raise ValueError(f"position is {frame.position}, three finite numbers up to {REACH} m are needed")
    seen = frame.position is not None  # bit 0 of the flags; the other bits are 0
    body = BODY.pack(b"TTBL", 1, seen, frame.ball % 2**16, frame.sequence % 2**32, frame.captured_ns, *position)
    return body + struct.pack("<I", zlib.crc32(body))


def synthetic(sequence: int) -> tuple[int, tuple[float, float, float] | None]:
    """Ball number and position in a frame: each second 0.3 s of empty table, then a ball towards the robot."""
    t = (sequence % RATE) / RATE - 0.3  # [s] since the ball came into play
    if t < 0.0:
        return sequence // RATE, None
    bounce, incoming = 0.437, 1.5  # [s] until it touches the table, [m/s] upwards at first
    z = 0.3 + incoming * t - 4.905 * t * t  # without drag; 0.02 m, the ball's radius, at the bounce
    if t > bounce:
        z = 0.02 + 2.4 * (t - bounce) - 4.905 * (t - bounce) ** 2
    return sequence // RATE + 1, (0.1 * t, 1.5 - 5.0 * t, z)


def main() -> None:
    """Sends the synthetic ball in real time; a line per frame: sequence, ball, captured_ns, position."""
    host, port, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    # One socket, kept for the whole session: the bridge trusts the address and port of the first valid frame.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        began = time.monotonic_ns()
        for sequence in range(int(seconds * RATE)):
            due = began + sequence * 1_000_000_000 // RATE  # absolute times: delays do not add up
            time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
            ball, position = synthetic(sequence)
            frame = Frame(sequence, ball, time.monotonic_ns(), position)
            sender.sendto(datagram(frame), (host, port))
            print(sequence, ball, frame.captured_ns, *(position or ("none",)), flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: tracker_client.py HOST PORT SECONDS")
    main()
