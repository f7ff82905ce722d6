"""The datagram of a ball tracker, sent by UDP for each camera frame.

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

Version 2 has 156 bytes, only for frames that show a ball; one stream may hold both. Bytes 0..43 are those of version 1
but for the version, then:
    44  3 f64   velocity [m/s] in the table frame
    68  21 f32  upper triangle, by rows, of the covariance of position and velocity in m and m/s
   152  u32     CRC-32 (zlib) of bytes 0..151
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np

MAGIC = b"TTBL"
VERSION, MOVING = 1, 2  # versions: a place, and a place with velocity and covariance
SEEN = 1
_BODY = struct.Struct("<4sBBHIq3d")
_CRC = struct.Struct("<I")
_MOTION = struct.Struct("<3d21f")
_UPPER = np.triu_indices(6)
SIZE = _BODY.size + _CRC.size
MOVING_SIZE = SIZE + _MOTION.size
SEQUENCE = 1 << 32
NANO = 1_000_000_000
REACH = 10.0  # [m] from the table's centre, beyond which a position is nonsense
FASTEST = 40.0  # [m/s] of a ball; the fastest strokes that were measured reach 32 m/s


@dataclass(frozen=True)
class BallSample:
    """Content of one frame; position (3,) [m] is None where no ball was seen; times in seconds.

    velocity    (3,) [m/s]; None where the tracker sends none
    covariance  (6, 6) of position and velocity [m], [m/s], beside a velocity
    """

    sequence: int
    ball: int
    captured: float
    position: np.ndarray | None
    velocity: np.ndarray | None = None
    covariance: np.ndarray | None = None


def encode(sample: BallSample) -> bytes:
    """The datagram of a frame, of version 2 where it has a velocity.

    Raises ValueError for what is not finite, and for a velocity without position or covariance.
    """
    position = np.zeros(3) if sample.position is None else np.asarray(sample.position, float)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"position {sample.position}, three finite numbers [m] are needed")
    flags = 0 if sample.position is None else SEEN
    version = VERSION if sample.velocity is None else MOVING
    captured = round(sample.captured * NANO)
    body = _BODY.pack(MAGIC, version, flags, sample.ball & 0xFFFF, sample.sequence % SEQUENCE, captured, *position)
    if sample.velocity is not None:
        covariance = np.full((6, 6), np.nan) if sample.covariance is None else sample.covariance
        motion = np.concatenate([sample.velocity, covariance[_UPPER]])
        if sample.position is None or motion.shape != (24,) or not np.isfinite(motion).all():
            raise ValueError("velocity: expected a seen ball, three finite numbers [m/s] and a covariance (6, 6)")
        body += _MOTION.pack(*motion)
    return body + _CRC.pack(zlib.crc32(body))


def decode(datagram: bytes) -> BallSample:
    """The frame of a datagram. Raises ValueError saying what is wrong with it."""
    if len(datagram) not in (SIZE, MOVING_SIZE):
        raise ValueError(f"size: {len(datagram)} bytes, a frame has {SIZE} or {MOVING_SIZE}")
    body = datagram[: -_CRC.size]
    if _CRC.unpack(datagram[-_CRC.size :])[0] != zlib.crc32(body):
        raise ValueError("checksum: the CRC does not fit")
    magic, version, flags, ball, sequence, captured, *position = _BODY.unpack_from(body)
    moving = len(datagram) == MOVING_SIZE
    allowed = flags == SEEN if moving else not flags & ~SEEN
    if magic != MAGIC or version != (MOVING if moving else VERSION) or not allowed:
        raise ValueError(f"format: magic {magic!r}, version {version}, flags {flags}")
    if not flags & SEEN:
        if any(position):
            raise ValueError(f"position: {position} of no ball")
        return BallSample(sequence, ball, captured / NANO, None)
    point = np.array(position)
    if not np.isfinite(point).all() or np.abs(point).max() > REACH:
        raise ValueError(f"position: {position}")
    if not moving:
        return BallSample(sequence, ball, captured / NANO, point)
    motion = np.array(_MOTION.unpack_from(body, _BODY.size))
    velocity, covariance = motion[:3], np.zeros((6, 6))
    if not np.isfinite(motion).all() or float(velocity @ velocity) > FASTEST**2:
        raise ValueError(f"velocity: {velocity.tolist()}")
    covariance[_UPPER] = motion[3:]
    covariance = covariance + covariance.T - np.diag(np.diag(covariance))
    if np.linalg.eigvalsh(covariance)[0] < -1e-6 * np.trace(covariance) or np.trace(covariance) <= 0.0:
        raise ValueError("covariance: not one of anything")
    return BallSample(sequence, ball, captured / NANO, point, velocity, covariance)
