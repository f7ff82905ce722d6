"""The tracker that runs: a process for each camera, the documented datagrams out, and what is wrong as sentences.

A camera's process takes frames, looks for balls, and says what it found; the frames stay in shared memory.
"""

from __future__ import annotations

import multiprocessing
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from multiprocessing.synchronize import Semaphore
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np

from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.errors import DeviceError
from robot_io.vision.camera import Camera
from robot_io.vision.detector import Detector
from robot_io.vision.health import Health
from robot_io.vision.rig import CameraRig
from robot_io.vision.sources import Source
from robot_io.vision.tracker import GUESSES, BallTracker
from robot_io.vision.triangulation import Detection

LOOK = 0.25  # [s] between looks at the health
START = 5.0  # [s] that cameras' processes have to start
RING = 8  # frames in shared memory: those that the detector compares, and those that are looked at outside


@dataclass
class Summary:
    """What a run did: stereo frames, those with a ball, times [s] from exposure to datagram, sentences of problems."""

    frames: int = 0
    balls: int = 0
    lags: list[float] = field(default_factory=list)
    problems: dict[str, float] = field(default_factory=dict)  # by sentence up to its first digit, when first [s]

    def lines(self) -> list[str]:
        """The figures, as text."""
        lines = [f"{self.frames} frames of all cameras, a ball in {self.balls}"]
        if self.lags:
            half, most, nearly_all = 1e3 * np.percentile(self.lags, [50, 90, 99])
            lines.append(f"exposure to datagram 50 / 90 / 99 %: {half:.1f} / {most:.1f} / {nearly_all:.1f} ms")
        return lines


def run(
    rig: CameraRig,
    sources: Sequence[Source],
    detector: Path,
    address: tuple[str, int] | None,
    report: Callable[[str], object],
    live: bool,
) -> Summary:
    """Tracks until the frames end.

    Args:
        rig: calibrated cameras.
        sources: of each.
        detector: folder of the network.
        address: where datagrams go; None: nowhere.
        report: is told what is wrong, once each.
        live: stamps are of ``time.monotonic``; else lags are not measured.

    Raises:
        DeviceError: a camera's process ended.
    """
    tracker, health, summary = BallTracker(rig.cameras), Health(rig), Summary()
    looked = -np.inf
    with ExitStack() as stack:
        wire = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        cameras = [
            stack.enter_context(CameraProcess(camera, source, detector, rig.rate, rig.bayer))
            for camera, source in zip(rig.cameras, sources, strict=True)
        ]
        while (looks := _together(cameras, rig, health)) is not None:
            stamps = [look.stamp + delay for look, delay in zip(looks, rig.delays, strict=True)]
            detections = [look.detections for look in looks]
            ball = tracker.update(stamps[0], detections)
            sample = BallSample(summary.frames, tracker.number, stamps[0], None)
            if ball is not None and ball.seen:
                sample = BallSample(
                    summary.frames, ball.number, stamps[0], ball.position, ball.velocity, ball.covariance
                )
            if address is not None:
                wire.sendto(encode(sample), address)
            summary.lags += [time.monotonic() - stamps[0]] if live else []
            summary.frames, summary.balls = summary.frames + 1, summary.balls + (sample.position is not None)
            for camera, places in zip(cameras, tracker.guesses(stamps[0] + 1.0 / rig.rate), strict=True):
                camera.guess(places)
            health.pair(stamps, detections)
            if stamps[0] - looked >= LOOK:
                looked = stamps[0]
                for line in health.problems(max(stamps)):
                    key = line.split(":")[0] + line.split(":")[1].lstrip(" +-0123456789.")
                    if key not in summary.problems:
                        summary.problems[key] = stamps[0]
                        report(line)
    return summary


class Look(NamedTuple):
    """What a camera's process says of a frame: stamp [s], place in the ring, detections."""

    stamp: float
    slot: int
    detections: tuple[Detection, ...]


class CameraProcess:
    """A camera's process, within a ``with`` block. Raises DeviceError where it does not start or ends by an error."""

    def __init__(self, camera: Camera, source: Source, detector: Path, rate: float, bayer: str) -> None:
        self._name = camera.name
        width, height = camera.size
        self._memory = SharedMemory(create=True, size=RING * width * height + 8 * (1 + 2 * GUESSES))
        self.frames, self._guesses = _views(self._memory, camera.size)
        self._guesses[:] = np.nan
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe(duplex=False)
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
            look = self._pipe.recv()
        except EOFError:
            raise DeviceError(f"camera {self._name}: its process ended; start again") from None
        if isinstance(look, str):
            raise DeviceError(f"camera {self._name}: {look}")
        return look

    def release(self) -> None:
        """Lets the oldest of ``frames`` (RING, h, w) be overwritten."""
        self._free.release()

    def guess(self, pixels: list[np.ndarray]) -> None:
        """Says where balls are expected (2,) [px]; a frame that is looked at just then may have half of it."""
        self._guesses[:] = np.nan
        for i, pixel in enumerate(pixels[:GUESSES]):
            self._guesses[2 * i : 2 * i + 2] = pixel

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.join(5.0)
        self._pipe.close()
        del self.frames, self._guesses
        self._memory.close()
        self._memory.unlink()


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
    cv2.setNumThreads(1)
    memory = SharedMemory(name=name, **({"track": False} if "track" in SharedMemory.__init__.__annotations__ else {}))
    frames, guesses = _views(memory, size)
    frame = None
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
            pipe.send(Look(stamp, slot, tuple(detector.detect(frames[slot], expected))))
        pipe.send(None)
    except (DeviceError, ValueError, OSError) as error:
        pipe.send(str(error))
    except KeyboardInterrupt:
        pass
    finally:
        del frames, guesses, frame
        memory.close()


def _together(cameras: Sequence[CameraProcess], rig: CameraRig, health: Health) -> list[Look] | None:
    """The next frames that all cameras took within half a period; those that lack a partner are passed over."""
    looks: list[Look | None] = [None] * len(cameras)
    while True:
        for i, camera in enumerate(cameras):
            if looks[i] is None:
                look = camera.receive()
                if look is None:
                    return None
                health.frame(i, look.stamp + rig.delays[i], camera.frames[look.slot])
                camera.release()
                looks[i] = look
        complete = [look for look in looks if look is not None]
        stamps = [look.stamp + delay for look, delay in zip(complete, rig.delays, strict=True)]
        if max(stamps) - min(stamps) < 0.5 / rig.rate:
            return complete
        looks[int(np.argmin(stamps))] = None
