"""The tracker that runs: cameras' detections in, the documented datagrams out, and what is wrong as sentences."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.vision.health import Health
from robot_io.vision.process import CameraProcess, Look
from robot_io.vision.rig import CameraRig
from robot_io.vision.sources import Source
from robot_io.vision.tracker import BallTracker

LOOK = 0.25  # [s] between looks at the health
START = 5.0  # [s] that cameras' processes have to start


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
    until: Callable[[], bool] = lambda: False,
) -> Summary:
    """Tracks until the frames end or ``until`` says so.

    Args:
        rig: calibrated cameras.
        sources: of each.
        detector: folder of the network.
        address: where datagrams go; None: nowhere.
        report: is told what is wrong, once each.
        live: stamps are of ``time.monotonic``; else lags are not measured.
        until: is asked after every frame.

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
        while (looks := _together(cameras, rig, health)) is not None and not until():
            stamps = [look.stamp + delay for look, delay in zip(looks, rig.delays, strict=True)]
            ball = tracker.update(stamps[0], [look.detections for look in looks])
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
            health.pair(stamps, [look.detections for look in looks])
            if stamps[0] - looked >= LOOK:
                looked = stamps[0]
                for line in health.problems(max(stamps)):
                    key = line.split(":")[0] + line.split(":")[1].lstrip(" +-0123456789.")
                    if key not in summary.problems:
                        summary.problems[key] = stamps[0]
                        report(line)
    return summary


def _together(cameras: Sequence[CameraProcess], rig: CameraRig, health: Health) -> list[Look] | None:
    """The next frames that all cameras took within half a period; those that lack a partner are passed over."""
    looks: list[Look | None] = [None] * len(cameras)
    while True:
        for i, camera in enumerate(cameras):
            if looks[i] is None:
                look = camera.receive()
                if look is None:
                    return None
                health.frame(i, look.stamp + rig.delays[i], camera.frame(look))
                camera.release()
                looks[i] = look
        complete = [look for look in looks if look is not None]
        stamps = [look.stamp + delay for look, delay in zip(complete, rig.delays, strict=True)]
        if max(stamps) - min(stamps) < 0.5 / rig.rate:
            return complete
        looks[int(np.argmin(stamps))] = None
