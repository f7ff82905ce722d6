"""Where frames come from: a recording, or a camera through Basler's pylon, which also emulates cameras.

Stamps are seconds, the middle of the exposure, on one clock for all cameras of a rig.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot_io.errors import DeviceError
from robot_io.vision.recording import FrameReader

NANO = 1e-9
PATIENCE = 1000  # [ms] that a frame is waited for
KEPT = 4  # frames that a camera's driver may hold


class Source(Protocol):
    """Frames of one camera; can be sent to another process, where it is opened."""

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """Stamps [s] and raw frames (h, w) uint8, until they end. Raises DeviceError and ValueError."""
        ...


@dataclass(frozen=True)
class RecordedSource:
    """A camera of an MCAP recording.

    paced  as fast as it was recorded, stamps on ``time.monotonic``; else as fast as it can be read
    start  [s] of ``time.monotonic`` at which the recording's first frame is due, the same for all cameras
    """

    path: str
    camera: str
    paced: bool = False
    start: float = 0.0

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """The recorded frames."""
        reader = FrameReader(self.path)
        first = next((shot.stamp for shot in reader.frames()), 0.0)
        for shot in reader.frames(self.camera):
            stamp = shot.stamp
            if self.paced:
                stamp += self.start - first
                time.sleep(max(stamp - time.monotonic(), 0.0))
            yield stamp, shot.frame


@dataclass(frozen=True)
class PylonSource:
    """A Basler camera by its serial number; the environment variable PYLON_CAMEMU says how many are emulated.

    rate, exposure  [Hz], [s]
    size            width and height [px]
    triggered       frames are taken when line 1 rises; the rate is then the trigger's
    """

    serial: str
    rate: float
    exposure: float
    size: tuple[int, int]
    triggered: bool = False

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """Frames until the process ends; stamps by the camera's clock, set against ``time.monotonic`` at the first."""
        try:
            from pypylon import genicam, pylon
        except ImportError:
            raise DeviceError("pylon: install it for Basler cameras: pip install pypylon") from None
        factory = pylon.TlFactory.GetInstance()
        devices = {device.GetSerialNumber(): device for device in factory.EnumerateDevices()}
        if self.serial not in devices:
            raise DeviceError(f"pylon: expected camera {self.serial}, found {', '.join(devices) or 'none'}")
        camera = pylon.InstantCamera(factory.CreateDevice(devices[self.serial]))
        try:
            camera.Open()
            self._configure(camera, genicam)
            camera.MaxNumBuffer = KEPT
            camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
            offset = None
            while camera.IsGrabbing():
                with camera.RetrieveResult(PATIENCE, pylon.TimeoutHandling_ThrowException) as result:
                    if not result.GrabSucceeded():
                        continue  # counted as dropped, by the gap in its stamps
                    taken, frame, now = NANO * result.TimeStamp, np.array(result.Array), time.monotonic()
                if not taken:  # emulated cameras have no clock
                    yield now, frame
                    continue
                offset = now - taken if offset is None else offset
                yield taken + offset + self.exposure / 2, frame
        except genicam.GenericException as error:
            raise DeviceError(f"pylon: camera {self.serial}: {error}") from None
        finally:
            camera.Close()

    def _configure(self, camera, genicam) -> None:  # type: ignore[no-untyped-def]
        values = {
            "PixelFormat": "Mono8" if "Emu" in camera.GetDeviceInfo().GetModelName() else "BayerRG8",
            "Width": self.size[0],
            "Height": self.size[1],
            "ExposureTimeAbs": 1e6 * self.exposure,
            "ExposureTime": 1e6 * self.exposure,
            "AcquisitionFrameRateEnable": not self.triggered,
            "AcquisitionFrameRateAbs": self.rate,
            "AcquisitionFrameRate": self.rate,
            "TriggerMode": "On" if self.triggered else "Off",
        }
        for name, value in values.items():  # models have the old names or the new ones
            node = camera.GetNodeMap().GetNode(name)
            if node is not None and genicam.IsWritable(node):
                node.Value = value
