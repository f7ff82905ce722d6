"""What is wrong with cameras that run, named within a second of frames: rate, light, lens, pose, clocks.

Pose is watched in the still picture, by the table's lines: a bump moves them, balls or not. Clocks are watched
by the ball: between cameras that are out of step its rays miss each other by its speed across the epipolar line times
the skew. No gate of the tracker comes first, for it would hide just these sights.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from robot_io.vision.camera import Camera
from robot_io.vision.rig import CameraRig
from robot_io.vision.triangulation import Detection, intersect

WINDOW = 1.0  # [s] that is judged
SILENT = 0.1  # [s] without a frame
DROPPED = 2  # frames missing in the window
COVERED = 0.3  # share of brightness or contrast that is left behind a cover
DARKER, BRIGHTER = 0.8, 1.25  # factors on the brightness at the start
SATURATED = 0.2  # share of pixels at the top
SETTLE = 20  # frames from which the normal brightness is taken
LOOK = 0.1  # [s] between looks at the pose
STILLS = 4  # looks that the lines' places at the start are taken from
LINE = 0.02  # [m] width of the table's lines
ACROSS = np.arange(-5.0, 5.5, 0.5)  # [half px] of a profile
FEWEST = 20  # profiles with a line
MOVED = 0.4  # [px] in the picture's middle
JUDGED = 0.8  # [s] of sights that clocks are judged by
PAIRS = 20  # of detections that clocks are judged by
FLYING = 2.0, 30.0  # [m/s] of what is taken for a ball
MISSED = 0.3  # [px] deviation of the mean miss of calibrated cameras
MISS, BIAS = 12.0, 0.5  # [px] between rays of one ball at most; on average
SKEW, SURE = 4e-4, 5.0  # [s]; deviations of an estimate that make it one
DRIFT = 5e-4  # [s] that stamps of frames taken together may wander apart


@dataclass(eq=False)
class _Eye:
    """One camera's recent frames, and how it looked at the start."""

    camera: Camera
    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=2000))
    light: deque[tuple[float, float, float, float]] = field(default_factory=lambda: deque(maxlen=2000))
    normal: tuple[float, float] | None = None
    stills: list[np.ndarray] = field(default_factory=list)  # profiles (n, m) at the start
    turns: deque[float] = field(default_factory=lambda: deque(maxlen=3))  # [px]
    looked: float = -np.inf

    @cached_property
    def lines(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, m, 2) [half px] of the profiles across the table's lines, in the half-size picture; and slopes
        (n, 3) [half px/rad] by which a turn about the camera's axes moves the lines across."""
        along, camera = np.linspace(-0.95, 0.95, 24), self.camera
        x, y = TABLE_WIDTH / 2 - LINE / 2, TABLE_LENGTH / 2 - LINE / 2
        sides = [(np.full_like(along, sign * x), along * y) for sign in (-1, 1)]
        sides += [(along * x, np.full_like(along, sign * y)) for sign in (-1, 1)]
        points = np.concatenate([np.stack([u, v, 0.0 * u], -1) for u, v in sides])
        ways = np.repeat(np.eye(3)[[1, 1, 0, 0]], len(along), axis=0)
        seen = camera.sees(points, 16.0)
        slopes, places = [], []
        for point, way in zip(points[seen], ways[seen], strict=True):
            jacobian = camera.jacobian(point)
            course = jacobian @ way
            normal = np.array([-course[1], course[0]]) / np.linalg.norm(course)
            local = camera.rotation @ point + camera.translation
            # A turn w of the camera moves a point in its frame by w x p.
            slopes.append(0.5 * normal @ jacobian @ camera.rotation.T @ np.cross(np.eye(3), local).T)
            places.append((camera.project(point) - 0.5) / 2.0 + ACROSS[:, None] * normal)
        return np.array(places, np.float32), np.array(slopes)

    def look(self, frame: np.ndarray) -> None:
        """Adds the turn since the start, by how far the table's lines moved across their own direction."""
        half = cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # colours mix
        places, _ = self.lines
        profiles = cv2.remap(half, places[..., 0], places[..., 1], cv2.INTER_LINEAR).astype(float)
        if len(self.stills) < STILLS:
            self.stills.append(profiles)
        else:
            self.turns.append(self._turn(profiles) * self.camera.matrix[0, 0])

    def _turn(self, profiles: np.ndarray) -> float:
        """Angle [rad] by which the camera turned, from profiles (n, m) of now."""
        was, (_, slopes) = np.mean(self.stills, axis=0), self.lines
        shifts, trust = np.zeros(len(was)), np.zeros(len(was))
        for i, (old, rise, new) in enumerate(zip(was, np.gradient(was, ACROSS, axis=1), profiles, strict=True)):
            basis = np.stack([old, rise, np.ones_like(old)], 1)  # new = gain (old - shift rise) + offset
            (gain, moved, _), *_ = np.linalg.lstsq(basis, new, rcond=None)
            if gain > 0.2 and np.ptp(old) > 10.0:
                shifts[i], trust[i] = -moved / gain, 1.0
        if trust.sum() < FEWEST:
            return 0.0
        weight, turn = trust, np.zeros(3)
        for _ in range(6):  # what hides a line has no say
            root = np.sqrt(weight)[:, None]
            turn = np.linalg.lstsq(slopes * root, shifts * root[:, 0], rcond=None)[0]
            away = np.abs(shifts - slopes @ turn)
            scale = max(1.5 * float(np.median(away[trust > 0])), 0.02)
            weight = trust / (1.0 + (away / (2.0 * scale)) ** 2) ** 2
        return float(np.linalg.norm(turn))


class Health:
    """Watches a rig; ``frame`` once for each camera's frame, ``pair`` once for detections of frames taken together."""

    def __init__(self, rig: CameraRig) -> None:
        self._rig = rig
        self._eyes = [_Eye(camera) for camera in rig.cameras]
        self._pairs: deque[tuple[float, float, float]] = deque(maxlen=1000)  # time, miss [px], speed across [px/s]
        self._last: tuple[float, np.ndarray, np.ndarray] | None = None
        self._apart: deque[tuple[float, float]] = deque(maxlen=1000)
        self._together: float | None = None

    def frame(self, camera: int, stamp: float, frame: np.ndarray) -> None:
        """Takes a frame (h, w) exposed at a stamp [s]."""
        eye = self._eyes[camera]
        eye.stamps.append(stamp)
        few = frame[::16, ::16]
        eye.light.append((stamp, float(few.mean()), float(few.std()), float((few >= 250).mean())))
        if eye.normal is None and len(eye.light) >= SETTLE:
            eye.normal = tuple(np.median(np.array(eye.light)[:, 1:3], axis=0).tolist())
        if eye.normal is not None and stamp - eye.looked >= LOOK:
            eye.looked = stamp
            eye.look(frame)

    def pair(self, stamps: Sequence[float], detections: Sequence[Sequence[Detection]]) -> None:
        """Takes stamps [s] and detections of the first two cameras' frames that were taken together."""
        self._apart.append((stamps[0], stamps[1] - stamps[0]))
        if self._together is None and len(self._apart) >= SETTLE:
            self._together = float(np.median([apart for _, apart in self._apart]))
        first, second = (max(seen, key=lambda d: d.probability, default=None) for seen in detections[:2])
        if first is None or second is None:
            self._last = None
            return
        cameras = self._rig.cameras[:2]
        rays = np.concatenate([c.rays(d.centre[None]) for c, d in zip(cameras, (first, second), strict=True)])
        point = intersect(np.stack([c.centre for c in cameras]), rays)
        across = cameras[1].jacobian(point) @ np.cross(rays[0], rays[1])  # the epipolar line's normal in the second
        across /= np.linalg.norm(across)
        miss = float(2.0 * across @ (second.centre - cameras[1].project(point)))  # half is seen in either
        last, self._last = self._last, (stamps[1], second.centre, point)
        if abs(miss) > MISS or last is None or stamps[1] - last[0] > 2.5 / self._rig.rate:
            return
        if not FLYING[0] < float(np.linalg.norm(point - last[2])) / (stamps[1] - last[0]) < FLYING[1]:
            return
        speed = float(across @ (second.centre - last[1])) / (stamps[1] - last[0])
        self._pairs.append((stamps[1], miss, speed))

    def problems(self, now: float) -> list[str]:
        """What is wrong at a time [s] of the stamps' clock, each as a sentence with its remedy; [] nothing."""
        found = [line for eye in self._eyes for line in self._of_rate(eye, now)]
        return [*found, *self._of_light(now), *self._of_poses(), *self._of_clocks(now)]

    def _of_rate(self, eye: _Eye, now: float) -> list[str]:
        name, period = eye.camera.name, 1.0 / self._rig.rate
        if not eye.stamps or now - eye.stamps[-1] > SILENT:
            return [f"camera {name}: silent; look at its cable, power and trigger"]
        stamps = np.array([s for s in eye.stamps if s > now - WINDOW])
        gaps = np.rint(np.diff(stamps) / period) - 1.0
        if (missing := int(gaps[gaps > 0].sum())) >= DROPPED:
            return [f"camera {name}: {missing} frames dropped within {WINDOW:g} s; look at the USB budget and the load"]
        if len(stamps) > SETTLE and abs(float(np.median(np.diff(stamps))) / period - 1.0) > 0.02:
            return [f"camera {name}: {1 / np.median(np.diff(stamps)):.1f} frames a second, not {self._rig.rate:g}"]
        return []

    def _of_light(self, now: float) -> list[str]:
        """A covered lens is dark in one camera and has no contrast; a lamp is missing in all."""
        factors, lines = [], []
        for eye in self._eyes:
            recent = np.array([row for row in eye.light if row[0] > now - 0.3])
            if eye.normal is None or not len(recent):
                return []
            _, mean, contrast, top = np.median(recent, axis=0)
            factors.append((mean / max(eye.normal[0], 1.0), contrast / max(eye.normal[1], 1.0), top))
        bright = np.array([factor[0] for factor in factors])
        if (bright < DARKER).all() and np.ptp(bright) < 0.3:
            return [f"light: {100 * (1 - bright.mean()):.0f} % darker in all cameras; is a lamp off?"]
        for eye, (mean, contrast, top) in zip(self._eyes, factors, strict=True):
            name = eye.camera.name
            if contrast < COVERED:
                lines.append(f"camera {name}: its picture has no contrast; is the lens covered?")
            elif not DARKER < mean < BRIGHTER:
                lines.append(
                    f"camera {name}: brightness {mean:.2f} of that at the start; look at exposure and aperture"
                )
            if top > SATURATED:
                lines.append(f"camera {name}: {100 * top:.0f} % of its pixels are saturated; expose for less time")
        return lines

    def _of_poses(self) -> list[str]:
        return [
            f"camera {eye.camera.name}: turned by about {np.median(eye.turns):.1f} px; calibrate it again with "
            f"mjx-tt vision calibrate --bumped {eye.camera.name}"
            for eye in self._eyes
            if len(eye.turns) == 3 and min(eye.turns) > MOVED
        ]

    def _of_clocks(self, now: float) -> list[str]:
        lines = []
        recent = [apart for time, apart in self._apart if time > now - 0.3]
        if self._together is not None and recent and abs(drift := float(np.median(recent)) - self._together) > DRIFT:
            lines.append(f"stamps: the cameras' wandered apart by {1e3 * drift:.2f} ms; trigger them by one signal")
        rows = np.array([row[1:] for row in self._pairs if row[0] > now - JUDGED])
        if len(rows) < PAIRS:
            return lines
        basis = np.stack([np.ones(len(rows)), rows[:, 1]], 1)
        weight, scale = np.ones(len(rows)), 1.0
        for _ in range(5):  # iteratively reweighted: false pairs have no say
            known = np.array([[scale / MISSED, 0.0]])  # the intercept, by a calibration that was checked
            fit = np.linalg.lstsq(
                np.concatenate([basis * weight[:, None], known]), np.append(rows[:, 0] * weight, 0.0), rcond=None
            )[0]
            away = np.abs(rows[:, 0] - basis @ fit)
            scale = max(1.5 * float(np.median(away)), 0.1)
            weight = 1.0 / (1.0 + (away / (2.0 * scale)) ** 2)
        normal = (basis * weight[:, None] ** 2).T @ basis / scale**2 + np.diag([MISSED**-2, 0.0])
        spread = np.linalg.inv(normal)
        bias, skew = fit
        deviation = np.sqrt(np.diag(spread))
        if abs(skew) > max(SKEW, SURE * deviation[1]):
            lines.append(f"clocks: {1e3 * skew:+.2f} ms of skew between the cameras; calibrate with flights")
        if min(abs(bias), abs(float(np.median(rows[:, 0])))) > max(BIAS, SURE * deviation[0]):
            lines.append(
                f"epipolar: rays of one ball miss each other by {bias:+.2f} px; a camera moved, calibrate again"
            )
        return lines
