"""Training crops: three frames of one place, fine and coarse, and what is in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from experiments.vision import render as pictures
from experiments.vision.flights import draw_camera
from robot_io.vision.detector import AROUND, FRAMES, SIZE, Detector, cut_windows, widen

PER_SCENE = 80
GAP = 0.008  # [s] between frames of the paper's cameras
SEEN = 0.4  # share of a ball that must be seen for it to count
HARDLY = 0.1  # share below which it counts as hidden


@dataclass(frozen=True)
class Crops:
    """n crops; the newest frame is first on the last axis."""

    fine: np.ndarray  # (n, SIZE, SIZE, 3) uint8, Bayer
    coarse: np.ndarray  # (n, SIZE, SIZE, 3) uint8, grey at half resolution around the same middle
    labels: np.ndarray  # (n, 6): present, u, v [px in the fine crop], velocity u, v [px a frame], radius [px]

    def __len__(self) -> int:
        return len(self.labels)

    def save(self, path: str | Path) -> None:
        """Writes them to an NPZ."""
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, *paths: str | Path) -> Crops:
        """Reads NPZs and joins them."""
        return cls.join([cls(**np.load(path)) for path in paths])

    @classmethod
    def join(cls, parts: Sequence[Crops]) -> Crops:
        """All of several."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


class Shots(NamedTuple):
    """Three frames of a window, and what is in it."""

    frames: list[np.ndarray]  # (h, w) uint8, Bayer, newest first
    corner: np.ndarray  # (2,) [px] of the fine crop in them
    label: np.ndarray  # (6,) as of ``Crops``


def cut(frames: list[np.ndarray], corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fine and coarse crop (SIZE, SIZE, 3) with the fine one's corner (2,) [px, even] in whole frames, newest first."""
    halves = [cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for frame in frames]
    halves = [widen(half, AROUND // 2) for half in halves]
    fine, coarse = (cut_windows(parts, at) for parts, at in ((frames, corner), (halves, corner // 2)))
    return fine.transpose(1, 2, 0), coarse.transpose(1, 2, 0)


def make_crops(
    count: int,
    tracks: np.ndarray,
    rng: np.random.Generator,
    video: bool = False,
    dressed: bool = False,
) -> Crops:
    """Draws crops of rendered scenes.

    Args:
        count: how many.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws all.
        video: longer exposures, fewer frames a second and compression, as of ordinary video.
        dressed: people wear photographs.
    """
    fine = np.empty((count, SIZE, SIZE, 3), np.uint8)
    coarse, labels = np.empty_like(fine), np.zeros((count, 6), np.float32)
    for k, shots in enumerate(draw_shots(count, tracks, rng, float(video), float(dressed))):
        fine[k], coarse[k] = cut(shots.frames, shots.corner)
        labels[k] = shots.label
    return Crops(fine, coarse, labels)


def draw_shots(
    count: int, tracks: np.ndarray, rng: np.random.Generator, video: float, dressed: float
) -> Iterator[Shots]:
    """Random places of random halls.

    Args:
        count: how many.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws all.
        video: share of the halls that are seen as by ordinary video.
        dressed: share of those whose people wear photographs.
    """
    done = 0
    while done < count:
        film, worn = (share >= 1 or (share > 0 and rng.random() < share) for share in (video, dressed))
        scene, actors = pictures.make_scene(draw_camera(rng, film), rng), pictures.Actors(rng, dressed=worn)
        for _ in range(PER_SCENE):
            shots = _draw_shots(scene, actors, tracks, rng, film)
            if shots is not None and done < count:
                done += 1
                yield shots


def _draw_shots(
    scene: pictures.Scene, actors: pictures.Actors, tracks: np.ndarray, rng: np.random.Generator, video: bool
) -> Shots | None:
    """A random place; None where a ball is neither seen nor hidden, or outside of the frame."""
    width, height = scene.camera.size
    gap = GAP if rng.random() < 0.7 else rng.uniform(0.003, 0.04)
    scene.exposure = rng.uniform(0.0005, min(0.0045, 0.6 * gap))
    if video:
        gap = rng.uniform(0.008, 0.04)
        scene.exposure = gap * rng.uniform(0.05, 0.9)
    track = tracks[rng.integers(len(tracks))]
    # The ball may have come into sight within the last frames, as after a stroke or from behind somebody.
    start = -rng.uniform(0, 3) * gap if rng.random() < 0.06 else -1.0
    time = rng.uniform(0.05, 0.9)
    path = pictures.follow(track[max(int(1000 * (time + start)), 0) :], max(time + start, 0.0))
    place = path(np.array([time, time + 5e-4]))
    if np.isnan(place).any() or scene.camera.depth(place).min() < 0.4:
        return None
    now, later = scene.camera.project(place)
    speed = (later - now) / 5e-4 * gap
    kind = rng.random()
    if kind < 0.66:
        middle = now + (rng.normal(0, 5, 2) if rng.random() < 0.5 else rng.uniform(-27, 27, 2))
    elif kind < 0.72:  # where the ball was, or its shadow is
        before = path(np.array([time - gap]))[0]
        middle = scene.camera.project((place[0] if np.isnan(before[0]) else before) * [1, 1, rng.integers(2)])
    elif kind < 0.92:  # people, robots, small things
        shape = (shapes := actors.capsules(time, place[0]))[rng.integers(len(shapes))]
        middle = scene.camera.project(shape.start + (shape.end - shape.start) * rng.random()) + rng.normal(0, 12, 2)
    else:
        middle = rng.uniform([0, 0], [width, height])
    if np.isnan(middle).any():  # behind the camera
        return None
    corner = (np.round((middle - SIZE / 2) / 2) * 2).astype(int)
    if (corner < 0).any() or corner[0] > width - SIZE or corner[1] > height - SIZE:
        return None
    x, y = np.maximum(corner - AROUND, 0)
    right, bottom = np.minimum(corner + SIZE + AROUND, [width, height])
    window = (int(x), int(y), int(right - x), int(bottom - y))
    shots = []
    for at in (time - k * gap for k in range(FRAMES)):
        shapes = actors.capsules(at, path(np.array([at]))[0])
        shots.append(pictures.render(scene, path, at, rng, shapes, window))
    seen, spot = shots[0].seen, now - corner
    inside = (spot > 2).all() and (spot < SIZE - 3).all()
    if not (inside and (seen > SEEN or seen < HARDLY)) and (spot > -12).all() and (spot < SIZE + 12).all():
        return None
    frames: list[np.ndarray] = [shot.frame for shot in shots]
    if video and rng.random() < 0.7:
        quality = int(rng.integers(35, 96))
        frames = [compress(frame, quality) for frame in frames]
    present = bool(inside and seen > SEEN)
    radius = scene.camera.matrix[0, 0] * 0.02 / scene.camera.depth(place[0])
    label = [1.0, *spot, *speed, radius] if present else [0.0] * 6
    return Shots(frames, corner - [x, y], np.array(label))


def compress(bayer: np.ndarray, quality: int) -> np.ndarray:
    """The frame as a compressed colour video has it: halved colours, blocks of 8 pixels; mosaicked again."""
    colours = cv2.cvtColor(bayer, cv2.COLOR_BayerRGGB2BGR)
    _, data = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return pictures.mosaic(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])


def mine_crops(
    detector: Detector,
    scenes: int,
    rng: np.random.Generator,
    frames: int = 12,
    video: bool = False,
) -> Crops:
    """Crops without a ball that a detector takes for one: people and a robot that pretend to play.

    A ball that nobody sees leads the hands and paddles. A low threshold of the detector gives more crops.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(scenes):
        camera = draw_camera(rng, video)
        scene, actors = pictures.make_scene(camera, rng), pictures.Actors(rng, 8, dressed=rng.random() < 0.5)
        gap = rng.uniform(0.008, 0.04) if video else GAP
        begin, quality = rng.uniform(0, 10), int(rng.integers(35, 96))
        ghost = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-2, 2), 0.3])
        speed = rng.uniform([-1, -6, -1], [1, 6, 1])
        width, height = camera.size
        detector.forget()
        kept: list[np.ndarray] = []
        for k in range(frames):
            time = begin + k * gap
            shapes = actors.capsules(time, ghost + speed * k * gap)
            frame = pictures.render(scene, pictures.no_ball, time, rng, shapes).frame
            frame = compress(frame, quality) if video else frame
            kept = [frame, *kept[:2]]
            for detection in detector.detect(frame):
                corner = np.round((detection.centre - SIZE / 2 + rng.uniform(-14, 14, 2)) / 2) * 2
                found.append(cut(kept, np.clip(corner, 0, [width - SIZE, height - SIZE]).astype(int)))
    fine, coarse = (np.array([pair[i] for pair in found], np.uint8).reshape(-1, SIZE, SIZE, 3) for i in (0, 1))
    return Crops(fine, coarse, np.zeros((len(found), 6), np.float32))
