"""Raw frames in an MCAP file, compressed without loss.

A channel ``/camera/NAME`` for each camera; a message's log time is the middle of its exposure. Its data are the four
colours' quarter pictures, each as differences from the left neighbour modulo 256, under Zstandard. The channel's
metadata say width, height, order of the colours and this encoding.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

ENCODING = "mjx-tt-quads-delta-zstd"
LEVEL = 1  # of Zstandard; higher ones gain little on noise and cost much
NANO = 1_000_000_000
TOPIC = "/camera/"


class Recorded(NamedTuple):
    """A frame of a recording."""

    camera: str
    stamp: float  # [s], middle of the exposure
    frame: np.ndarray  # (h, w) uint8


def compress_frame(frame: np.ndarray) -> bytes:
    """A frame (h, w) uint8 with even sides as bytes. Raises ValueError for any other."""
    if frame.ndim != 2 or frame.dtype != np.uint8 or frame.shape[0] % 2 or frame.shape[1] % 2:
        raise ValueError(f"expected a frame (height, width) of uint8 with even sides, got {frame.dtype} {frame.shape}")
    height, width = frame.shape
    quads = np.ascontiguousarray(frame.reshape(height // 2, 2, width // 2, 2).transpose(1, 3, 0, 2))
    delta = quads.copy()
    np.subtract(quads[..., 1:], quads[..., :-1], out=delta[..., 1:])
    return zstandard.ZstdCompressor(LEVEL).compress(delta.tobytes())


def decompress_frame(data: bytes, width: int, height: int) -> np.ndarray:
    """The frame (height, width) of ``compress_frame``'s bytes. Raises ValueError where they are not one."""
    try:
        raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=width * height)
    except zstandard.ZstdError as error:
        raise ValueError(
            f"expected a compressed frame, got {len(data)} other bytes ({error}); record it again"
        ) from None
    if len(raw) != width * height:
        raise ValueError(f"expected a frame of {width} x {height} bytes, got {len(raw)}; record it again")
    delta = np.frombuffer(raw, np.uint8).reshape(2, 2, height // 2, width // 2)
    quads = np.add.accumulate(delta, axis=-1, dtype=np.uint8)
    return quads.transpose(2, 0, 3, 1).reshape(height, width)


class FrameWriter:
    """Writes a recording; closed at the end of a ``with`` block.

    Args:
        path: the .mcap file.
        sizes: width and height [px] of each camera by its name.
        rate: frames a second [Hz].
        bayer: order of the colours.
    """

    def __init__(
        self, path: str | os.PathLike, sizes: Mapping[str, tuple[int, int]], rate: float, bayer: str = "RGGB"
    ) -> None:
        self._writer = Writer(str(path), compression=CompressionType.NONE)
        self._writer.start("mjx-tt")
        self._sizes = dict(sizes)
        self._channels = {
            name: self._writer.register_channel(
                TOPIC + name,
                "application/octet-stream",
                0,
                {"width": str(width), "height": str(height), "bayer": bayer, "encoding": ENCODING, "rate": repr(rate)},
            )
            for name, (width, height) in self._sizes.items()
        }
        self._count = 0

    def write(self, camera: str, stamp: float, frame: np.ndarray) -> None:
        """Adds a camera's frame with the middle of its exposure [s]. Raises ValueError for a wrong size."""
        if frame.shape[::-1] != self._sizes[camera]:
            raise ValueError(f"camera {camera}: expected a frame of {self._sizes[camera]} px, got {frame.shape[::-1]}")
        time = round(stamp * NANO)
        self._writer.add_message(self._channels[camera], time, compress_frame(frame), time, self._count)
        self._count += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.finish()


class FrameReader:
    """A recording: ``rate`` [Hz], ``cameras`` with width and height [px], and its frames in order of time.

    Raises ValueError where the file holds no frames of this encoding, OSError where it cannot be opened.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        with self.path.open("rb") as file:
            try:
                summary = make_reader(file).get_summary()
            except McapError as error:
                raise ValueError(f"{path}: expected a recording (MCAP), got something else: {error}") from None
        channels = summary.channels.values() if summary else ()
        ours = {c.topic.removeprefix(TOPIC): c.metadata for c in channels if c.metadata.get("encoding") == ENCODING}
        if not ours:
            raise ValueError(f"{path}: expected frames ({ENCODING}), found none; record them with mjx-tt vision record")
        self.cameras = {name: (int(data["width"]), int(data["height"])) for name, data in ours.items()}
        self.rate = float(next(iter(ours.values()))["rate"])
        self.bayer = next(iter(ours.values()))["bayer"]

    def frames(self, camera: str | None = None) -> Iterator[Recorded]:
        """All frames, or those of one camera. Raises ValueError for a camera that the file lacks, or broken frames."""
        if camera is not None and camera not in self.cameras:
            raise ValueError(f"{self.path}: expected one of the cameras {', '.join(self.cameras)}, got {camera}")
        topics = [TOPIC + name for name in ([camera] if camera else self.cameras)]
        with self.path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(topics):
                name = channel.topic.removeprefix(TOPIC)
                yield Recorded(name, message.log_time / NANO, decompress_frame(message.data, *self.cameras[name]))
