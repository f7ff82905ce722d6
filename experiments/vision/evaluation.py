"""What a detector finds in rendered flights, in play without a ball, and in labelled clips."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from experiments.vision import render as pictures
from experiments.vision.clips import Clip, Labels
from experiments.vision.crops import SEEN
from robot_io.vision.camera import Camera
from robot_io.vision.detection import Detection
from robot_io.vision.detector import Detector
from robot_io.vision.tracker import BallTracker

WITHIN = 6.0  # [px] of a rendered ball's centre that count as found
EDGE = 5.0  # [px] from the picture's edge that a ball's centre must be away
LEAD = 3  # frames before a ball that comes into play; enough that the detector has its three
EPIPOLAR = 3.0  # [px] between two cameras' rays that count as one ball
STANDARD_EXPOSURE = 0.002  # [s]


@dataclass(frozen=True)
class Sights:
    """What was found in frames that were judged.

    balls       seen balls, and ``found`` of them
    false       detections that are no ball, in ``frames`` frames
    error       (found,) [px]
    squared     (found,) squared errors over the covariance; their mean is 2 where the covariance is right
    speed       (found,) [px a frame], and ``speed_error`` (found, 2) of its two components
    seconds     of one core per frame
    acquired    [s] from when all cameras see a ball until all found it, of each flight; infinite where never
    """

    frames: int
    balls: int
    false: int
    error: np.ndarray
    squared: np.ndarray
    speed: np.ndarray
    speed_error: np.ndarray
    seconds: float
    acquired: np.ndarray

    @property
    def found(self) -> int:
        """Balls that were found."""
        return len(self.error)

    def lines(self) -> list[str]:
        """The figures, as text."""
        lines = [f"{self.frames} frames, {self.balls} balls seen"]
        if self.balls:
            lines.append(f"found {self.found / self.balls:.4f}")
        lines.append(f"false detections a frame {self.false / max(self.frames, 1):.4f}")
        if self.found:
            half, most, nearly_all = np.percentile(self.error, [50, 90, 99])
            lines.append(f"error 50 / 90 / 99 %: {half:.2f} / {most:.2f} / {nearly_all:.2f} px")
        if len(self.squared):
            lines.append(f"squared error over covariance {self.squared.mean():.2f} (2 is right)")
        for low, high in ((0, 10), (10, 25), (25, 60), (60, 300)) if len(self.speed) else ():
            chosen = (self.speed >= low) & (self.speed < high)
            if chosen.any():
                half, most = np.percentile(np.linalg.norm(self.speed_error[chosen], axis=1), [50, 90])
                lines.append(
                    f"velocity error at {low} to {high} px a frame, 50 / 90 %: {half:.2f} / {most:.2f} px a frame"
                )
        if len(self.acquired):
            shares = [(self.acquired <= limit + 1e-9).mean() for limit in (0.0, 0.008, 0.024, 0.12)]
            lines.append(
                "acquired by all cameras within 0 / 8 / 24 / 120 ms: " + " / ".join(f"{s:.3f}" for s in shares)
            )
        lines.append(f"{1e3 * self.seconds:.2f} ms of a core a frame")
        return lines


def play_flights(
    cameras: tuple[Camera, ...],
    tracks: np.ndarray,
    rng: np.random.Generator,
    rate: float = 125.0,
    exposure: float = STANDARD_EXPOSURE,
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
        ball = path(np.array([time]))[0]
        shapes = actors.capsules(time, None if np.isnan(ball[0]) else ball)
        yield time, [pictures.render(scene, path, time, rng, shapes) for scene in scenes], path


def evaluate_rendered(
    folder: Path,
    cameras: tuple[Camera, ...],
    tracks: np.ndarray,
    rng: np.random.Generator,
    guided: bool = False,
    rate: float = 125.0,
    exposure: float = STANDARD_EXPOSURE,
    report: Callable[[int], object] = lambda done: None,
) -> Sights:
    """Flights seen by all cameras.

    Args:
        folder: of the detector.
        cameras: that look on.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws halls, people and noise.
        guided: give each detector a guess that is some px off, as a tracker does.
        rate: frames a second [Hz].
        exposure: [s].
        report: is told how many flights are done.
    """
    frames = balls = false = 0
    spent, errors, squared, speeds, misses, acquired = 0.0, [], [], [], [], []
    for number, flight in enumerate(play_flights(cameras, tracks, rng, rate, exposure)):
        detectors = [Detector(folder, rate) for _ in cameras]
        first, hit = None, np.inf
        for k, (time, shots, path) in enumerate(flight):
            place = path(np.array([time, time + 5e-4]))
            there, all_found, all_seen = not np.isnan(place).any(), True, True
            for camera, detector, shot in zip(cameras, detectors, shots, strict=True):
                spot, later = camera.project(place)
                inside = there and bool((spot > EDGE).all() and (spot < np.array(camera.size) - 1 - EDGE).all())
                began = clock.process_time()
                found = detector.detect(shot.frame, [spot + rng.normal(0, 5, 2)] if guided and inside else ())
                spent += clock.process_time() - began
                if k < LEAD - 1:
                    continue
                frames += 1
                away = [float(np.linalg.norm(d.centre - spot)) for d in found] if there else []
                false += sum(not a < WITHIN for a in away) if there else len(found)
                if not (inside and shot.seen > SEEN):
                    all_seen = False
                    continue
                balls += 1
                if not away or min(away) >= WITHIN:
                    all_found = False
                    continue
                best = found[int(np.argmin(away))]
                miss = best.centre - spot
                errors.append(min(away))
                squared.append(miss @ np.linalg.solve(best.covariance, miss))
                speed = (later - spot) / 5e-4 / rate
                speeds.append(np.linalg.norm(speed))
                misses.append(best.velocity / rate - speed)
            if all_seen and there:
                first = time if first is None else first
                hit = min(hit, time - first) if all_found else hit
        if first is not None:
            acquired.append(hit)
        report(number + 1)
    return Sights(
        frames, balls, false, np.array(errors), np.array(squared), np.array(speeds),
        np.array(misses).reshape(-1, 2), spent / max(frames, 1), np.array(acquired),
    )  # fmt: skip


@dataclass(frozen=True)
class Ghosts:
    """What was seen where no ball was: ``pairs`` of detections whose rays meet, and frames with a ball ``reported``."""

    stereo_frames: int
    detections: int
    pairs: int
    reported: int

    def lines(self) -> list[str]:
        """The figures, as text."""
        return [
            f"{self.stereo_frames} stereo frames of play without a ball",
            f"detections {self.detections}, {self.detections / max(self.stereo_frames, 1) / 2:.5f} a frame",
            f"pairs of detections whose rays meet {self.pairs}",
            f"frames in which the tracker reports a ball {self.reported}",
        ]


def evaluate_empty(
    folder: Path,
    cameras: tuple[Camera, Camera],
    seconds: float,
    rng: np.random.Generator,
    rate: float = 125.0,
    scene_seconds: float = 4.0,
    report: Callable[[int], object] = lambda done: None,
) -> Ghosts:
    """People and a robot pretend to play for some seconds, in a new hall every few: what is taken for a ball."""
    stereo = detections = pairs = reported = 0
    while stereo < seconds * rate:
        scenes, actors = [pictures.make_scene(camera, rng) for camera in cameras], pictures.Actors(rng)
        detectors, tracker = [Detector(folder, rate) for _ in cameras], BallTracker(cameras)
        begin, phase = rng.uniform(0, 100), rng.uniform(0, 1)
        for k in range(int(scene_seconds * rate)):
            time = begin + k / rate
            # Hands and paddles follow a ball that goes to and fro every second and is not there.
            swing = np.cos(2 * np.pi * (k / rate + phase))
            shapes = actors.capsules(time, np.array([0.3 * np.sin(3 * time), 2.0 * swing, 0.25]))
            shots = [pictures.render(scene, pictures.no_ball, time, rng, shapes) for scene in scenes]
            found = [
                detector.detect(shot.frame, guesses)
                for detector, shot, guesses in zip(detectors, shots, tracker.guesses(time), strict=True)
            ]
            reported += tracker.update(time, found) is not None
            stereo, detections = stereo + 1, detections + sum(len(f) for f in found)
            pairs += sum(rays_meet(cameras, a, b) for a in found[0] for b in found[1])
        report(stereo)
    return Ghosts(stereo, detections, pairs, reported)


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
    detector = Detector(folder, clip.rate, bayer=clip.bayer)
    frames = balls = false = 0
    spent, errors = 0.0, []
    for k, frame in enumerate(clip.frames()):
        last, before = labels.get(k - 1), labels.get(k - 2)
        guesses = [] if last is None or not guided else [last if before is None else 2 * last - before]
        began = clock.process_time()
        found = detector.detect(frame, guesses)
        spent += clock.process_time() - began
        if k not in labels or k < 2:
            continue
        frames += 1
        label = labels[k]
        away = [np.inf if label is None else float(np.linalg.norm(d.centre - label)) for d in found]
        false += sum(a > within for a in away)
        balls += label is not None
        if min(away, default=np.inf) <= within:
            errors.append(min(away))
    none = np.empty(0)
    return Sights(frames, balls, false, np.array(errors), none, none, none.reshape(0, 2), spent / max(frames, 1), none)


def measure_renderer(camera: Camera, track: np.ndarray, rng: np.random.Generator, frames: int = 100) -> float:
    """Whole frames that the renderer makes in a second of one core."""
    scene, actors, path = pictures.make_scene(camera, rng), pictures.Actors(rng), pictures.follow(track)
    began = clock.process_time()
    for k in range(frames):
        time = 0.005 * k
        ball = path(np.array([time]))[0]
        pictures.render(scene, path, time, rng, actors.capsules(time, ball))
    return frames / (clock.process_time() - began)


def use_one_core() -> None:
    """OpenCV on one core, as its times are reported."""
    cv2.setNumThreads(1)
