"""Clips to evaluate on: video files through PyAV and recordings, as Bayer frames; and the labels of their balls."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.errors import ConfigError
from experiments.vision.render import mosaic
from robot_io.vision.recording import FrameReader

NAMES = {"img": "frame", "image": "frame", "frame_id": "frame", "u": "x", "v": "y", "visible": "visibility"}


@dataclass(frozen=True)
class Clip:
    """Frames of one camera."""

    path: Path
    rate: float  # [Hz]
    camera: str | None = None  # of a recording
    bayer: str = "RGGB"

    def frames(self) -> Iterator[np.ndarray]:
        """Bayer frames (h, w) uint8 in order; of a video RGGB, and odd sides lose their last pixels."""
        if self.path.suffix == ".mcap":
            yield from (recorded.frame for recorded in FrameReader(self.path).frames(self.camera))
            return
        import av

        with av.open(str(self.path)) as file:
            for image in file.decode(video=0):
                colours = image.to_ndarray(format="rgb24")
                height, width = (side // 2 * 2 for side in colours.shape[:2])
                yield mosaic(colours[:height, :width])


def open_clip(path: str | os.PathLike, camera: str | None = None) -> Clip:
    """A clip of a video file or of a recording's camera.

    Raises:
        ConfigError: the file is neither, PyAV is missing, or a recording of several cameras needs ``camera``.
    """
    path = Path(path)
    if path.suffix == ".mcap":
        try:
            reader = FrameReader(path)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        if camera is None and len(reader.cameras) > 1:
            raise ConfigError(f"{path}: expected --camera, one of {', '.join(reader.cameras)}, got none")
        return Clip(path, reader.rate, camera or next(iter(reader.cameras)), reader.bayer)
    if find_spec("av") is None:
        raise ConfigError(f'{path}: reading video needs PyAV; pip install "mjx-tt[vision]"')
    import av

    try:
        with av.open(str(path)) as file:
            rate = file.streams.video[0].average_rate
    except (av.error.FFmpegError, IndexError) as error:
        raise ConfigError(
            f"{path}: expected a video file or a recording (.mcap), got something else: {error}"
        ) from None
    return Clip(path, float(rate or 25.0))


Labels = dict[int, np.ndarray | None]  # frame, from 0, to the ball's pixel (2,), or None where there is no ball


def read_labels(path: str | os.PathLike) -> Labels:
    """Labels of a clip. Frames that are not in the file are not judged.

    Takes a CSV with the columns frame, x and y (an empty or negative one: no ball) and, where it has one, visibility
    (0: no ball), which is also what BlurBall and TT3D write; and TTNet's JSON of frames with x and y (-1: no ball).

    Raises:
        ConfigError: the file is neither, or a value is no number.
    """
    path = Path(path)
    try:
        if path.suffix == ".json":
            table = pd.DataFrame.from_dict(json.loads(path.read_text("utf-8-sig")), "index").reset_index(names="frame")
        else:
            table = pd.read_csv(path, encoding="utf-8-sig", skipinitialspace=True)
        table = table.rename(columns=lambda name: str(name).strip().lower())
        table = table.rename(columns={other: own for other, own in NAMES.items() if own not in table})
        if missing := [name for name in ("frame", "x", "y") if name not in table]:
            raise ValueError(f"got {', '.join(table)}, which lacks {', '.join(missing)}")
        frames = [int(float(Path(str(frame)).stem)) for frame in table["frame"]]
        places = table[["x", "y"]].to_numpy(float)
        there = (places >= 0).all(1)
        if "visibility" in table:
            there &= table["visibility"].fillna(1) > 0
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ConfigError(f"{path}: expected the columns frame,x,y or a JSON of frames with x and y; {error}") from None
    if not frames:
        raise ConfigError(f"{path}: expected labels, got none")
    return {frame: place if seen else None for frame, place, seen in zip(frames, places, there, strict=True)}


def write_labels(path: str | os.PathLike, labels: Labels) -> None:
    """Writes labels as a CSV with the columns frame, x and y."""
    rows = {frame: (np.nan, np.nan) if place is None else place for frame, place in sorted(labels.items())}
    table = pd.DataFrame.from_dict(rows, "index", columns=["x", "y"]).rename_axis("frame")
    table.to_csv(path, float_format="%.2f", lineterminator="\r\n")
