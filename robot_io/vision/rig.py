"""A rig's YAML: its cameras, their rate, and what ``mjx-tt vision calibrate`` found of each.

The one of ``standard`` has the paper's kind of placement: two cameras above and beside the table, in the robot's half.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import Field
from scipy.spatial.transform import Rotation

from ballmodel.io import validation
from ballmodel.io.atomic_files import replacing
from ballmodel.io.ranges import Within
from ballmodel.io.validation import Name, Section
from robot_io.vision.camera import Camera

STANDARD = Path(__file__).with_name("standard.yaml")

Pixels = Annotated[float, Within(10.0, 100000.0, "px")]
Pixel = Annotated[float, Within(-10000.0, 30000.0, "px")]
Place = Annotated[float, Within(-20.0, 20.0, "m")]
Angle = Annotated[float, Within(-6.3, 6.3, "rad")]
Bend = Annotated[float, Within(-5.0, 5.0)]
Side = Annotated[int, Field(ge=16, le=20000, multiple_of=2)]


class CameraFile(Section):
    """A camera of the rig."""

    size: tuple[Side, Side]
    """Width and height [px], even."""
    focal: tuple[Pixels, Pixels]
    """Focal lengths [px] along width and height."""
    principal: tuple[Pixel, Pixel]
    """Principal point [px]; a pixel's centre has whole coordinates."""
    distortion: tuple[Bend, Bend, Bend, Bend, Bend] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""
    position: tuple[Place, Place, Place]
    """Where it stands in the table's frame [m]."""
    rotation: tuple[Angle, Angle, Angle]
    """Rotation vector [rad] from the table's frame to the camera's (right, down, forward)."""
    delay: Annotated[float, Within(-0.05, 0.05, "s")] = 0.0
    """[s] added to its stamps, so that they are those of the first camera's clock."""
    residual: Annotated[float, Within(0.0, 100.0, "px")] = 0.0
    """Root mean square [px] of its calibration; 0: never calibrated."""

    def build(self, name: str) -> Camera:
        """The camera."""
        (fx, fy), (u, v) = self.focal, self.principal
        rotation = Rotation.from_rotvec(self.rotation).as_matrix()
        matrix = np.array([[fx, 0.0, u], [0.0, fy, v], [0.0, 0.0, 1.0]])
        return Camera(name, self.size, matrix, np.array(self.distortion), rotation, -rotation @ np.array(self.position))


class RigFile(Section):
    """The YAML of a rig of cameras."""

    rate: Annotated[float, Within(10.0, 1000.0, "Hz")] = 125.0
    """Frames a second [Hz]."""
    exposure: Annotated[float, Within(1e-5, 0.02, "s")] = 0.002
    """[s]."""
    bayer: Literal["RGGB", "GRBG", "GBRG", "BGGR", "mono"] = "RGGB"
    """Order of colours in the raw frames."""
    cameras: Annotated[dict[Name, CameraFile], Field(min_length=2, max_length=8)]
    """By name; the first one's clock is the rig's."""


@dataclass(frozen=True, eq=False)
class CameraRig:
    """Cameras that look at one table.

    cameras    in the file's order
    delays     (n,) [s] added to the stamps of each
    residuals  (n,) [px] of each calibration; 0: never calibrated
    rate       [Hz] of frames
    exposure   [s]
    bayer      order of colours
    """

    cameras: tuple[Camera, ...]
    delays: tuple[float, ...]
    residuals: tuple[float, ...]
    rate: float = 125.0
    exposure: float = 0.002
    bayer: str = "RGGB"


def read(path: str | os.PathLike) -> CameraRig:
    """The rig of a YAML file. Raises ValueError with a line for every mistake, OSError where it cannot be opened."""
    file = validation.read(RigFile, path)
    entries = file.cameras.values()
    return CameraRig(
        tuple(camera.build(name) for name, camera in file.cameras.items()),
        tuple(camera.delay for camera in entries),
        tuple(camera.residual for camera in entries),
        file.rate,
        file.exposure,
        file.bayer,
    )


def standard() -> CameraRig:
    """The rig that ships."""
    return read(STANDARD)


def write(path: str | os.PathLike, rig: CameraRig) -> None:
    """Writes the YAML of a rig, which ``read`` gives back to 1e-7 of its units. Raises ValueError and OSError."""
    cameras = {
        camera.name: {
            "size": list(camera.size),
            "focal": _numbers(camera.matrix.diagonal()[:2], 4),
            "principal": _numbers(camera.matrix[:2, 2], 4),
            "distortion": _numbers(camera.distortion, 7),
            "position": _numbers(camera.centre, 7),
            "rotation": _numbers(Rotation.from_matrix(camera.rotation).as_rotvec(), 8),
            "delay": round(float(delay), 7),
            "residual": round(float(residual), 4),
        }
        for camera, delay, residual in zip(rig.cameras, rig.delays, rig.residuals, strict=True)
    }
    data = {"rate": rig.rate, "exposure": rig.exposure, "bayer": rig.bayer, "cameras": cameras}
    validation.validate(RigFile, data, str(path))
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120), "utf-8")


def _numbers(values: np.ndarray, digits: int) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]
