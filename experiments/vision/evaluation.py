"""What a detector finds in rendered flights, in play without a ball, and in labelled clips."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from experiments.vision import render as pictures
from experiments.vision.clips import Clip, Labels
from experiments.vision.crops import SEEN
from robot_io.vision.camera import Camera
from robot_io.vision.detector import Detector
from robot_io.vision.tracker import BallTracker
from robot_io.vision.triangulation import Detection

WITHIN = 6.0  # [px] of a rendered ball's centre that count as found
EDGE = 5.0  # [px] from the picture's edge that a ball's centre must be away
LEAD = 3  # frames before a ball that comes into play; enough that the detector has its three
EPIPOLAR = 3.0  # [px] between two cameras' rays that count as one ball
RATE, EXPOSURE = 125.0, 0.002  # [Hz], [s]
SCENE_SECONDS = 4.0  # of play without a ball in one hall


def spread(values: Sequence[float] | np.ndarray, form: str = ".2f", shares: Sequence[float] = (50, 90, 99)) -> str:
    """Percentiles of values (n,), as text."""
    return " / ".join(f"{value:{form}}" for value in np.percentile(values, shares))


@dataclass
class Sights:
    """What was found in frames that were judged.

    balls        seen balls, and ``found`` of them
    false        detections that are no ball, in ``frames`` frames
    error        (found,) [px]
    squared      (found,) squared errors over the covariance; their mean is 2 where the covariance is right
    speed        (found,) [px a frame], and ``speed_error`` (found, 2) of its two components
    spent        [s] of one core
    acquired     [s] from when all cameras see a ball until all found it, of each flight; infinite where never
    """

    frames: int = 0
    balls: int = 0
    false: int = 0
    error: list[float] = field(default_factory=list)
    squared: list[float] = field(default_factory=list)
    speed: list[float] = field(default_factory=list)
    speed_error: list[np.ndarray] = field(default_factory=list)
    spent: float = 0.0
    acquired: list[float] = field(default_factory=list)

    @property
    def found(self) -> int:
        """Balls that were found."""
        return len(self.error)

    def detect(self, detector: Detector, frame: np.ndarray, guesses: Sequence[np.ndarray]) -> list[Detection]:
        """What a detector finds; counts the time that it takes."""
        began = clock.process_time()
        found = detector.detect(frame, guesses)
        self.spent += clock.process_time() - began
        return found

    def lines(self) -> list[str]:
        """The figures, as text."""
        lines = [f"{self.frames} frames, {self.balls} balls seen"]
        if self.balls:
            lines.append(f"found {self.found / self.balls:.4f}")
        lines.append(f"false detections a frame {self.false / max(self.frames, 1):.4f}")
        if self.found:
            lines.append(f"error 50 / 90 / 99 %: {spread(self.error)} px")
        if self.squared:
            lines.append(f"squared error over covariance {np.mean(self.squared):.2f} (2 is right)")
        for low, high in ((0, 10), (10, 25), (25, 60), (60, 300)):
            pairs = zip(self.speed, self.speed_error, strict=True)
            misses = [float(np.linalg.norm(miss)) for speed, miss in pairs if low <= speed < high]
            if misses:
                figures = spread(misses, shares=(50, 90))
                lines.append(f"velocity error at {low} to {high} px a frame, 50 / 90 %: {figures} px a frame")
        if self.acquired:
            shares = [(np.array(self.acquired) <= limit + 1e-9).mean() for limit in (0.0, 0.008, 0.024, 0.12)]
            lines.append(
                "acquired by all cameras within 0 / 8 / 24 / 120 ms: " + " / ".join(f"{s:.3f}" for s in shares)
            )
        lines.append(f"{1e3 * self.spent / max(self.frames, 1):.2f} ms of a core a frame")
        return lines


def play_flights(
    cameras: tuple[Camera, ...],
    tracks: np.ndarray,
    rng: np.random.Generator,
    rate: float = RATE,
    exposure: float = EXPOSURE,
) -> Iterator[Iterator[tuple[float, list[pictures.Picture], pictures.Path]]]:
    """For each track (m, 3) its stereo frames: time [s], what each camera sees, and the ball's path."""
    for track in tracks:
        scenes = [pictures.make_scene(camera, rng) for camera in cameras]
        for scene in scenes:
            scene.exposure, scene.ball = exposure, scenes[0].ball
        yield _play(scenes, track, rng, rate)


def _play(
    scenes: list[pictures.Scene], track: np.ndarray, rng: np.random.Generator, rate: float
) -> Iterator[tuple[float, list[pictures.Picture], pictures.Path]]:
    actors, begin = pictures.Actors(rng), (LEAD + rng.uniform()) / rate
    path = pictures.follow(track, begin)
    for k in range(LEAD + int(0.75 * rate)):
        time = k / rate
        shapes = actors.capsules(time, path(np.array([time]))[0])
        yield time, [pictures.render(scene, path, time, rng, shapes) for scene in scenes], path


def evaluate_rendered(
    folder: Path, cameras: tuple[Camera, ...], tracks: np.ndarray, rng: np.random.Generator, guided: bool = False
) -> Sights:
    """Flights seen by all cameras.

    Args:
        folder: of the detector.
        cameras: that look on.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws halls, people and noise.
        guided: give each detector a guess that is some px off, as a tracker does.
    """
    sights = Sights()
    for flight in play_flights(cameras, tracks, rng):
        detectors = [Detector(folder, RATE) for _ in cameras]
        first, hit = None, np.inf
        for k, (time, shots, path) in enumerate(flight):
            place = path(np.array([time, time + 5e-4]))
            there, all_found, all_seen = not np.isnan(place).any(), True, True
            for camera, detector, shot in zip(cameras, detectors, shots, strict=True):
                spot, later = camera.project(place)
                inside = there and bool(camera.sees(place[0], EDGE))
                guesses = [spot + rng.normal(0, 5, 2)] if guided and inside else []
                found = sights.detect(detector, shot.frame, guesses)
                if k < LEAD - 1:
                    continue
                sights.frames += 1
                away = [float(np.linalg.norm(d.centre - spot)) if there else np.inf for d in found]
                sights.false += sum(not a < WITHIN for a in away)
                if not (inside and shot.seen > SEEN):
                    all_seen = False
                    continue
                sights.balls += 1
                if min(away, default=np.inf) >= WITHIN:
                    all_found = False
                    continue
                best = found[int(np.argmin(away))]
                miss = best.centre - spot
                sights.error.append(min(away))
                sights.squared.append(float(miss @ np.linalg.solve(best.covariance, miss)))
                speed = (later - spot) / 5e-4 / RATE
                sights.speed.append(float(np.linalg.norm(speed)))
                sights.speed_error.append(best.velocity / RATE - speed)
            if all_seen and there:
                first = time if first is None else first
                hit = min(hit, time - first) if all_found else hit
        if first is not None:
            sights.acquired.append(hit)
    return sights


@dataclass
class Ghosts:
    """What was seen where no ball was: ``pairs`` of detections whose rays meet, and frames with a ball ``reported``."""

    stereo_frames: int = 0
    detections: int = 0
    pairs: int = 0
    reported: int = 0

    def lines(self) -> list[str]:
        """The figures, as text."""
        return [
            f"{self.stereo_frames} stereo frames of play without a ball",
            f"detections {self.detections}, {self.detections / max(self.stereo_frames, 1) / 2:.5f} a frame",
            f"pairs of detections whose rays meet {self.pairs}",
            f"frames in which the tracker reports a ball {self.reported}",
        ]


def evaluate_empty(folder: Path, cameras: tuple[Camera, Camera], seconds: float, rng: np.random.Generator) -> Ghosts:
    """People and a robot pretend to play for some seconds, in a new hall every few: what is taken for a ball."""
    ghosts = Ghosts()
    while ghosts.stereo_frames < seconds * RATE:
        scenes, actors = [pictures.make_scene(camera, rng) for camera in cameras], pictures.Actors(rng)
        detectors, tracker = [Detector(folder, RATE) for _ in cameras], BallTracker(cameras)
        begin, phase = rng.uniform(0, 100), rng.uniform(0, 1)
        for k in range(int(SCENE_SECONDS * RATE)):
            time = begin + k / RATE
            # Hands and paddles follow a ball that goes to and fro every second and is not there.
            swing = np.cos(2 * np.pi * (k / RATE + phase))
            shapes = actors.capsules(time, np.array([0.3 * np.sin(3 * time), 2.0 * swing, 0.25]))
            shots = [pictures.render(scene, pictures.no_ball, time, rng, shapes) for scene in scenes]
            found = [
                detector.detect(shot.frame, guesses)
                for detector, shot, guesses in zip(detectors, shots, tracker.guesses(time), strict=True)
            ]
            ghosts.reported += tracker.update(time, found) is not None
            ghosts.stereo_frames += 1
            ghosts.detections += sum(len(f) for f in found)
            ghosts.pairs += sum(rays_meet(cameras, a, b) for a in found[0] for b in found[1])
    return ghosts


def rays_meet(cameras: tuple[Camera, Camera], first: Detection, second: Detection) -> bool:
    """Whether two cameras' detections can be one thing before both: their rays pass within EPIPOLAR px."""
    (a,), (b,) = (camera.rays(d.centre[None]) for camera, d in zip(cameras, (first, second), strict=True))
    across = np.cross(a, b)
    gap = cameras[1].centre - cameras[0].centre
    distance = abs(across @ gap) / np.linalg.norm(across)
    along = np.linalg.lstsq(np.stack([a, -b], 1), gap, rcond=None)[0]
    return bool((along > 0).all() and distance * cameras[0].matrix[0, 0] / along.mean() < EPIPOLAR)


def evaluate_clip(folder: Path, clip: Clip, labels: Labels, guided: bool, within: float = 10.0) -> Sights:
    """Labelled frames of a clip.

    Args:
        folder: of the detector.
        clip: the frames.
        labels: where the ball is.
        guided: give the detector the place that the two labels before lead to, as a tracker does.
        within: [px] of the label that count as found.
    """
    detector, sights = Detector(folder, clip.rate, bayer=clip.bayer), Sights()
    for k, frame in enumerate(clip.frames()):
        last, before = labels.get(k - 1), labels.get(k - 2)
        guesses = [] if last is None or not guided else [last if before is None else 2 * last - before]
        found = sights.detect(detector, frame, guesses)
        if k not in labels or k < 2:
            continue
        sights.frames += 1
        label = labels[k]
        away = [np.inf if label is None else float(np.linalg.norm(d.centre - label)) for d in found]
        sights.false += sum(a > within for a in away)
        sights.balls += label is not None
        if min(away, default=np.inf) <= within:
            sights.error.append(min(away))
    return sights


def measure_renderer(camera: Camera, track: np.ndarray, rng: np.random.Generator) -> float:
    """Whole frames that the renderer makes in a second of one core."""
    scene, actors, path = pictures.make_scene(camera, rng), pictures.Actors(rng), pictures.follow(track)
    began = clock.process_time()
    for k in range(100):
        time = 0.005 * k
        pictures.render(scene, path, time, rng, actors.capsules(time, path(np.array([time]))[0]))
    return 100 / (clock.process_time() - began)


def use_one_core() -> None:
    """OpenCV on one core, as its times are reported."""
    cv2.setNumThreads(1)
