"""The ball tracker: UDP datagrams at 125 Hz, checked and put in order of capture.

One datagram per camera frame, also when no ball is seen, so that silence and an empty table differ. Little endian,
48 bytes:
    0   4s      magic "TTBL"
    4   u8      version, 1
    5   u8      flags: bit 0 a ball is seen; other bits 0
    6   u16     ball number, counts up with every new ball in play as the tracker sees it
    8   u32     sequence number of the frame, wraps around
    12  i64     capture time of the frame [ns], the clock that TrackerConfig names
    20  3 f64   position x, y, z [m] of the ball's centre in the table frame; zeros when none is seen
    44  u32     CRC-32 (zlib) of bytes 0..43
"""

from __future__ import annotations

import socket
import struct
import zlib
from collections import Counter
from dataclasses import dataclass

import numpy as np

from robot_io.errors import DeviceError
from robot_io.history import History

MAGIC = b"TTBL"
VERSION = 1
SEEN = 1
_BODY = struct.Struct("<4sBBHIq3d")
_CRC = struct.Struct("<I")
SIZE = _BODY.size + _CRC.size
SEQUENCE = 1 << 32
NANO = 1_000_000_000
MAX_DRAIN = 1000  # datagrams per call: a flood must not keep the caller from its control tick
REACH = 10.0  # [m] from the table's centre, beyond which a position is nonsense


@dataclass(frozen=True)
class BallSample:
    """What one frame showed; position (3,) [m] is None where no ball was seen; times in seconds."""

    sequence: int
    ball: int
    captured: float
    position: np.ndarray | None


def encode(sample: BallSample) -> bytes:
    """The datagram of a frame. Raises ValueError for a position that is not finite."""
    position = np.zeros(3) if sample.position is None else np.asarray(sample.position, float)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"position {sample.position}, three finite numbers [m] are needed")
    flags = 0 if sample.position is None else SEEN
    captured = round(sample.captured * NANO)
    body = _BODY.pack(MAGIC, VERSION, flags, sample.ball & 0xFFFF, sample.sequence % SEQUENCE, captured, *position)
    return body + _CRC.pack(zlib.crc32(body))


def decode(datagram: bytes) -> BallSample:
    """The frame of a datagram. Raises ValueError saying what is wrong with it."""
    if len(datagram) != SIZE:
        raise ValueError(f"size: {len(datagram)} bytes, a frame has {SIZE}")
    body = datagram[: _BODY.size]
    if _CRC.unpack(datagram[_BODY.size :])[0] != zlib.crc32(body):
        raise ValueError("checksum: the CRC does not fit")
    magic, version, flags, ball, sequence, captured, *position = _BODY.unpack(body)
    if magic != MAGIC or version != VERSION or flags & ~SEEN:
        raise ValueError(f"format: magic {magic!r}, version {version}, flags {flags}")
    if not flags & SEEN:
        if any(position):
            raise ValueError(f"position: {position} of no ball")
        return BallSample(sequence, ball, captured / NANO, None)
    point = np.array(position)
    if not np.isfinite(point).all() or np.abs(point).max() > REACH:
        raise ValueError(f"position: {position}")
    return BallSample(sequence, ball, captured / NANO, point)


@dataclass(frozen=True)
class TrackerConfig:
    """Where the tracker sends to and what is accepted.

    host, port       address that the bridge listens on
    source           IP address of the tracker; datagrams from elsewhere are ignored
    source_port      port that it sends from; None takes that of the first valid frame, and again after 1 s of silence
    oldest           [s] age at which a frame is too old to be used
    ahead            [s] by which a capture time may lie in the future: clocks that differ by more are refused
    clock_offset     [s] added to capture times: bridge's monotonic clock minus the tracker's clock
    """

    host: str = "127.0.0.1"
    port: int = 6520
    source: str = "127.0.0.1"
    oldest: float = 0.15
    ahead: float = 0.005
    clock_offset: float = 0.0
    source_port: int | None = None


class Tracker:
    """Keeps the ball's track from datagrams; knows no sockets and reads no clock."""

    def __init__(self, config: TrackerConfig) -> None:
        self.config = config
        self.track = History(length=256, longest_hold=0.06)
        self.ball = -1  # number of the ball that the track belongs to
        self.received: float | None = None  # [s] when the last accepted frame came
        self.seen: float | None = None  # [s] capture time of the last frame that showed a ball
        self.newest: BallSample | None = None
        self.counts: Counter[str] = Counter()
        self._sequence: int | None = None

    def receive(self, datagram: bytes, source: str, now: float) -> BallSample | None:
        """Takes one datagram from IP address ``source``; the sample, or None when it was refused and counted."""
        if source != self.config.source:
            self.counts["stranger"] += 1
            return None
        try:
            sample = decode(datagram)
        except ValueError as error:
            self.counts[str(error).split(":")[0]] += 1
            return None
        captured = sample.captured + self.config.clock_offset
        age = now - captured
        if age < -self.config.ahead or age > self.config.oldest:
            self.counts["future" if age < 0 else "stale"] += 1
            return None
        if self._sequence is not None:
            ahead = (sample.sequence - self._sequence) % SEQUENCE
            restarted = self.received is None or now - self.received > 1.0
            if not 0 < ahead < SEQUENCE // 2 and not restarted:
                self.counts["duplicate" if ahead == 0 else "out of order"] += 1
                return None
            if not restarted and captured <= self.newest.captured:
                self.counts["out of order"] += 1
                return None
            self.counts["lost"] += 0 if restarted else ahead - 1
        self._sequence = sample.sequence
        self.counts["accepted"] += 1
        self.received = now
        sample = BallSample(sample.sequence, sample.ball, captured, sample.position)
        self.newest = sample
        if sample.position is not None:
            if sample.ball != self.ball:
                self.track.clear()
                self.ball = sample.ball
            if self.track.add(captured, sample.position):
                self.seen = captured
        return sample


class TrackerSocket:
    """The UDP socket that the tracker sends to."""

    def __init__(self, config: TrackerConfig) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((config.host, config.port))
        except OSError as error:
            self._socket.close()
            raise DeviceError(
                f"tracker: cannot listen on {config.host}:{config.port} ({error.strerror}); "
                "end the program that uses the port or give another one as tracker.port"
            ) from None

    def fileno(self) -> int:
        return self._socket.fileno()

    def drain(self):
        """The datagrams that wait, as (bytes, IP address)."""
        for _ in range(MAX_DRAIN):
            try:
                datagram, address = self._socket.recvfrom(2048)
            except BlockingIOError:
                return
            yield datagram, address[0]

    def close(self) -> None:
        self._socket.close()
