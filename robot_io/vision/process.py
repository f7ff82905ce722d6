"""A process for each camera: it takes frames, looks for balls, and says what it found; frames stay in shared memory."""

from __future__ import annotations

import multiprocessing
import time
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from robot_io.errors import DeviceError
from robot_io.vision.camera import Camera
from robot_io.vision.detection import Detection
from robot_io.vision.sources import Source
from robot_io.vision.tracker import GUESSES

RING = 8  # frames in shared memory: those that the detector compares, and those that are looked at outside
START_TIME = 20.0  # [s]


class Look(NamedTuple):
    """What a camera's process says of a frame: stamp [s], place in the ring, detections, time [s] that it was ready."""

    stamp: float
    slot: int
    detections: tuple[Detection, ...]
    ready: float


class CameraProcess:
    """A camera's process; use as a context manager. Raises DeviceError where it does not start or ends by an error."""

    def __init__(self, camera: Camera, source: Source, detector: Path, rate: float, bayer: str) -> None:
        self.camera = camera
        width, height = camera.size
        self._memory = SharedMemory(create=True, size=RING * width * height + 8 * (1 + 2 * GUESSES))
        self._frames, self._guesses = _views(self._memory, camera.size)
        self._guesses[:] = np.nan
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe(duplex=False)
        self._free = context.Semaphore(RING - 3)  # the detector holds three
        self._process = context.Process(
            target=_run,
            args=(source, detector, rate, bayer, camera.size, self._memory.name, theirs, self._free),
            name=f"camera-{camera.name}",
            daemon=True,
        )
        self._process.start()
        theirs.close()

    def receive(self) -> Look | None:
        """The next frame's detections, waiting for them; None when frames have ended. Raises DeviceError."""
        try:
            look = self.pipe.recv()
        except EOFError:
            raise DeviceError(f"camera {self.camera.name}: its process ended; start again") from None
        if isinstance(look, str):
            raise DeviceError(f"camera {self.camera.name}: {look}")
        return look

    def frame(self, look: Look) -> np.ndarray:
        """The frame (h, w), until ``release``."""
        return self._frames[look.slot]

    def release(self) -> None:
        """Lets the oldest frame be overwritten."""
        self._free.release()

    def guess(self, pixels: list[np.ndarray]) -> None:
        """Says where balls are expected (2,) [px]; a frame that is looked at just then may have half of it."""
        self._guesses[:] = np.nan
        for i, pixel in enumerate(pixels[:GUESSES]):
            self._guesses[2 * i : 2 * i + 2] = pixel

    def close(self) -> None:
        """Ends the process."""
        self._process.terminate()
        self._process.join(5.0)
        self.pipe.close()
        del self._frames, self._guesses
        self._memory.close()
        self._memory.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _views(memory: SharedMemory, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    width, height = size
    frames = np.ndarray((RING, height, width), np.uint8, memory.buf)
    return frames, np.ndarray((2 * GUESSES,), np.float64, memory.buf, frames.nbytes)


def _run(
    source: Source,
    folder: Path,
    rate: float,
    bayer: str,
    size: tuple[int, int],
    name: str,
    pipe: Connection,
    free: Semaphore,
) -> None:
    import cv2

    from robot_io.vision.detector import Detector

    cv2.setNumThreads(1)
    memory = SharedMemory(name=name, **({"track": False} if "track" in SharedMemory.__init__.__annotations__ else {}))
    frames, guesses = _views(memory, size)
    try:
        detector = Detector(folder, rate, bayer=bayer)
        for count, (stamp, frame) in enumerate(source.frames()):
            if frame.shape != frames.shape[1:]:
                pipe.send(f"expected frames of {size} px, got {frame.shape[::-1]}; correct size in the rig's YAML")
                return
            free.acquire()
            slot = count % RING
            frames[slot] = frame
            expected = [pair for pair in guesses.reshape(-1, 2).copy() if np.isfinite(pair).all()]
            found = tuple(detector.detect(frames[slot], expected))
            pipe.send(Look(stamp, slot, found, time.monotonic()))
        pipe.send(None)
    except (DeviceError, ValueError, OSError) as error:
        pipe.send(str(error))
    except KeyboardInterrupt:
        pass
    finally:
        del frames, guesses, frame
        memory.close()
