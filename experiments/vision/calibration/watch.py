"""What a recording holds for a calibration: still pictures, and free flights that the cameras saw together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from ballmodel.constants import BALL_RADIUS
from experiments.vision.calibration.edges import still_picture
from experiments.vision.calibration.solve import Flight
from robot_io.vision.detector import Detector
from robot_io.vision.recording import FrameReader
from robot_io.vision.rig import CameraRig
from robot_io.vision.tracker import BallTracker
from robot_io.vision.triangulation import Detection

STILLS = 15  # frames whose median stands still
SHORTEST, LONGEST = 12, 40  # frames of a flight
NEAR_TABLE = BALL_RADIUS + 0.03  # [m] of height at which a bounce may be
LOOSE = 1.5  # [px] by which cameras may be off

Moment = tuple[float, list[list[Detection]]]  # [s] of the first camera's clock; what each camera saw then
Row = tuple[float, np.ndarray, list[np.ndarray]]  # time [s], place [m], and pixel in each camera


def read_stills(path: Path, rig: CameraRig) -> list[np.ndarray]:
    """Of each camera the picture (h, w) of what stands still in a recording. Raises ValueError for missing cameras."""
    reader = FrameReader(path)
    check_cameras(reader, rig)
    stills = []
    for camera in rig.cameras:
        total = sum(1 for _ in reader.frames(camera.name))
        wanted = set(np.linspace(0, total - 1, min(STILLS, total)).astype(int).tolist())
        frames = [shot.frame for k, shot in enumerate(reader.frames(camera.name)) if k in wanted]
        if not frames:
            raise ValueError(f"{path}: expected frames of camera {camera.name}, found none")
        stills.append(still_picture(np.stack(frames), reader.bayer))
    return stills


def check_cameras(reader: FrameReader, rig: CameraRig) -> None:
    """Raises ValueError where a recording lacks a camera of the rig, or has frames of another size."""
    for camera in rig.cameras:
        if (size := reader.cameras.get(camera.name)) != camera.size:
            raise ValueError(f"{reader.path}: camera {camera.name}: expected frames of {camera.size} px, got {size}")


def pair_frames(path: Path, rig: CameraRig) -> Iterator[tuple[float, list[np.ndarray]]]:
    """Times [s] and frames of all cameras that were exposed within half a period of each other, delays included."""
    reader = FrameReader(path)
    check_cameras(reader, rig)
    delays = {camera.name: delay for camera, delay in zip(rig.cameras, rig.delays, strict=True)}
    waiting: dict[str, tuple[float, np.ndarray]] = {}
    for shot in reader.frames():
        if shot.camera not in delays:
            continue
        stamp = shot.stamp + delays[shot.camera]
        waiting = {name: held for name, held in waiting.items() if stamp - held[0] < 0.5 / rig.rate}
        waiting[shot.camera] = stamp, shot.frame
        if len(waiting) == len(delays):
            yield waiting[rig.cameras[0].name][0], [waiting[camera.name][1] for camera in rig.cameras]
            waiting = {}


def detect_all(frames: Iterable[tuple[float, list[np.ndarray]]], detectors: Sequence[Detector]) -> Iterator[Moment]:
    """What each detector finds in its camera's frames."""
    for time, pictures in frames:
        yield time, [detector.detect(frame) for detector, frame in zip(detectors, pictures, strict=True)]


def find_flights(moments: Iterable[Moment], rig: CameraRig) -> list[Flight]:
    """Free flights between bounces that the first two cameras saw, by a tracker of roughly known cameras."""
    tracker = BallTracker(rig.cameras, LOOSE)
    runs: dict[int, list[Row]] = {}
    for time, detections in moments:
        ball = tracker.update(time, detections)
        if ball is None or tracker.reported is None or tracker.reported.placed != time:
            continue
        sight = min(tracker.sights, key=lambda s: float(np.linalg.norm(s.point - ball.position)))
        pixels = [d.centre for d in sight.detections]
        pixels += [np.full(2, np.nan)] * (len(rig.cameras) - 2)
        runs.setdefault(ball.number, []).append((time, sight.point, pixels))
    flights = []
    for run in runs.values():
        for part in _cut(run, 3.5 / rig.rate):
            times = np.array([row[0] for row in part])
            flights.append(Flight(times - times[0], np.stack([row[2] for row in part], 1)))
    return flights


def _cut(run: list[Row], gap: float) -> Iterator[list[Row]]:
    """Pieces without bounces and gaps, of some length, their ends cut off."""
    pieces: list[list[Row]] = [[run[0]]]
    for last, row in pairwise(run):
        if row[0] - last[0] > gap or row[1][2] < NEAR_TABLE:
            pieces.append([])
        if row[1][2] >= NEAR_TABLE:
            pieces[-1].append(row)
    for piece in pieces:
        inner = piece[2:-2][:LONGEST]
        if len(inner) >= SHORTEST:
            yield inner
