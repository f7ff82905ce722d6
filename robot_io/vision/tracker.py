"""The ball among several hypotheses: a filter each, of which one is reported.

A hypothesis begins with a place that two cameras agree on and that no other explains. It takes whole places first, and
what one camera sees alone where there is none. A consistent place beside the prediction is no outlier: the ball was
struck. What flies and looks like a ball is believed soon, what is slow later, for hands and paddles are slow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from ballmodel.kalman import Kalman, Physics
from robot_io.vision.camera import Camera
from robot_io.vision.triangulation import Detection, Sight, triangulate

FLOOR = 0.15  # [px] of cameras that were calibrated
AGREE = 16.0  # squared deviation up to which two cameras see the same
GATE, GATE_SPACE = 16.0, 21.0  # the same of a pixel, and of a place, against a prediction
SURE, STRUCK = 0.8, 0.5  # probability of detections that begin a hypothesis; where the ball was just lost
FAST, HITS, SLOW_HITS = 2.5, 2, 10  # [m/s] from which on so many places make a ball; slower ones need more
SCORE, MARGIN = 7.0, 6.0  # evidence that makes a ball; by which another must have more to take its place
SLOWEST = 1.5  # [m/s] below which nothing is a new ball: a hand, a ball that lies, a lamp
FORGET, DROP = 0.1, 0.025  # [s] without a place after which the reported ball is given up; any other hypothesis
ALONE = 0.05  # [s] without a place up to which one camera's sights are enough to report it as seen
REACH = 20.0  # [m/s] within which a struck ball leaves
MOST = 4  # hypotheses that are kept
PHYSICS = Physics(drag=0.141, lift=0.0033, wander=0.1, bounced=(0.5, 0.25, 60.0))
CLUTTER, FADING = 5.0, 0.9  # evidence that a place of clutter has; share of it that is left after a frame
SUREST = 0.993  # probability beyond which more counts no more
EXPECTED = 3.0  # evidence of a place where something fast was expected: clutter is seldom there
UNSEEN = 2.0  # evidence that a frame takes in which no camera saw it
ROOM = np.array([[-4.0, -5.0, -0.8], [4.0, 5.0, 3.0]])  # [m] in which there are balls
PLAY = np.array([[-1.0, -1.8, 0.0], [1.0, 2.3, 1.2]])  # [m] in which one that a single camera sees is sought
STRIDE = 48.0  # [px] between the places where it is sought: a detector's window less the ball
PLACES = 18  # of them, at most: a longer line has them farther apart
SAMPLES = 256  # of a ray
GUESSES = 2 + PLACES  # for a camera, at most: of two hypotheses, and along a ray


@dataclass(eq=False)
class Hypothesis:
    """A ball that may be one.

    ball    its filter at ``time`` [s]
    begun   [s], when it was last seen by a camera, and when last placed by two
    hits    places so far
    score   evidence: logarithms of the odds that its sights were balls, less what clutter brings, the old ones fading
    """

    ball: Kalman
    time: float
    begun: float
    seen: float
    placed: float
    hits: int = 1
    score: float = 0.0

    @property
    def speed(self) -> float:
        """[m/s]"""
        return float(np.linalg.norm(self.ball.mean[3:6]))

    def at(self, time: float) -> np.ndarray:
        """State (9,) expected at a time, of itself or later."""
        ahead = replace(self.ball, covariance=self.ball.covariance.copy())
        if time > self.time:
            ahead.predict(time - self.time)
        return ahead.mean


@dataclass(frozen=True, eq=False)
class TrackedBall:
    """The reported ball: number, place (3,) [m], velocity (3,) [m/s], their covariance (6, 6), whether it was seen."""

    number: int
    position: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray
    seen: bool


@dataclass
class BallTracker:
    """Takes the detections of all cameras, frame by frame; the first two make places, every one corrects them.

    floor  [px] deviation that calibration and lens add to every detection's
    """

    cameras: tuple[Camera, ...]
    floor: float = FLOOR
    hypotheses: list[Hypothesis] = field(default_factory=list)
    reported: Hypothesis | None = None
    number: int = 0
    sights: list[Sight] = field(default_factory=list)  # of the newest frame
    alone: list[Detection | None] = field(default_factory=list)  # of each camera, the surest that no other one shares

    def guesses(self, time: float) -> list[list[np.ndarray]]:
        """Of every camera, the pixels (2,) at which the two likeliest hypotheses will be.

        Where no ball is believed and a camera sees one alone, also those at which it would be for the other.
        """
        ahead = [h.at(time)[:3] for h in self.hypotheses[:2]]
        pixels = [[camera.project(point) for point in ahead] for camera in self.cameras]
        if self.reported is None:
            for seen, camera, other, row in zip(
                self.alone, self.cameras[:2], self.cameras[1::-1], pixels[1::-1], strict=False
            ):
                row += [] if seen is None else find_along(camera, seen, other)
        return [[p for p in row if np.isfinite(p).all()] for row in pixels]

    def update(self, time: float, detections: Sequence[Sequence[Detection]]) -> TrackedBall | None:
        """Takes what each camera saw in the frame exposed at ``time`` [s]; the ball, None where none is believed."""
        self.sights = self._find_sights(detections)
        shared = {id(d) for sight in self.sights for d in sight.detections}
        self.alone = [next((d for d in row if id(d) not in shared), None) for row in detections[:2]]
        for h in self.hypotheses:
            h.ball.predict(time - h.time)
            h.time = time
        free = list(self.sights)
        for h in self.hypotheses:
            self._follow(h, detections, free)
        self._begin(time, free)
        self._choose(time)
        best = self.reported
        if best is None:
            return None
        mean, covariance = best.ball.mean, best.ball.covariance[:6, :6]
        seen = best.seen == time and time - best.placed <= ALONE
        return TrackedBall(self.number, mean[:3].copy(), mean[3:6].copy(), covariance.copy(), seen)

    def _find_sights(self, detections: Sequence[Sequence[Detection]]) -> list[Sight]:
        found = []
        for pair in product(*detections[:2]):
            sight = triangulate(self.cameras[:2], pair, self.floor)
            if sight is None or sight.deviation > AGREE:
                continue
            if (sight.point > ROOM[0]).all() and (sight.point < ROOM[1]).all():
                found.append(sight)
        return found

    def _follow(self, h: Hypothesis, detections: Sequence[Sequence[Detection]], free: list[Sight]) -> None:
        """Corrects a hypothesis by the place that fits best, which is free no more, or by single cameras' sights."""
        fits = sorted((self._distance(h, sight), i) for i, sight in enumerate(free))
        if fits and fits[0][0] < GATE_SPACE:
            sight, fast = free.pop(fits[0][1]), h.speed > FAST
            for camera, detection in zip(self.cameras, sight.detections, strict=False):
                self._take(h, camera, detection, np.inf)
            h.hits, h.seen, h.placed = h.hits + 1, h.time, h.time
            h.score = FADING * h.score + weigh(sight) + EXPECTED * fast
            return
        # Where both cameras see it elsewhere, what one of them sees is none of it.
        if not any(np.linalg.norm(sight.point - h.ball.mean[:3]) < 0.3 for sight in free):
            for camera, seen in zip(self.cameras, detections, strict=True):
                near = [(self._misfit(h, camera, d), i) for i, d in enumerate(seen)]
                if near and min(near)[0] < GATE:
                    self._take(h, camera, seen[min(near)[1]], GATE)
                    h.seen = h.time
        h.score = FADING * h.score - UNSEEN * (h.seen < h.time)

    def _distance(self, h: Hypothesis, sight: Sight) -> float:
        r = sight.point - h.ball.mean[:3]
        return float(r @ np.linalg.solve(h.ball.covariance[:3, :3] + sight.covariance, r))

    def _misfit(self, h: Hypothesis, camera: Camera, detection: Detection) -> float:
        residual, slope, noise = self._seen(h, camera, detection)
        if not np.isfinite(residual).all():
            return np.inf
        return float(residual @ np.linalg.solve(slope @ h.ball.covariance @ slope.T + noise, residual))

    def _seen(self, h: Hypothesis, camera: Camera, detection: Detection) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        slope = np.zeros((2, 9))
        slope[:, :3] = camera.jacobian(h.ball.mean[:3])
        noise = detection.covariance + self.floor**2 * np.eye(2)
        return detection.centre - camera.project(h.ball.mean[:3]), slope, noise

    def _take(self, h: Hypothesis, camera: Camera, detection: Detection, gate: float) -> None:
        h.ball.correct(*self._seen(h, camera, detection))
        slope = np.zeros((2, 9))
        slope[:, 3:6] = camera.jacobian(h.ball.mean[:3])
        noise = detection.velocity_deviation**2 * np.eye(2)
        residual = detection.velocity - slope @ h.ball.mean
        total = slope @ h.ball.covariance @ slope.T + noise
        if float(residual @ np.linalg.solve(total, residual)) < GATE:
            h.ball.correct(residual, slope, noise)

    def _begin(self, time: float, free: list[Sight]) -> None:
        """Hypotheses of places that none explains; where the reported ball was just lost, it is its stroke."""
        old = self.reported
        for sight in sorted(free, key=lambda s: -s.probability):
            struck = old is not None and old is self.reported and 0.0 < time - old.placed <= DROP
            if struck and old is not None:
                away = float(np.linalg.norm(sight.point - old.ball.mean[:3]))
                struck = away < 0.03 + REACH * (time - old.placed)
            if sight.probability < (STRUCK if struck else SURE):
                continue
            new = self._start(time, sight)
            self.hypotheses.append(new)
            if struck:
                self.reported, self.number = new, self.number + 1

    def _start(self, time: float, sight: Sight) -> Hypothesis:
        slope = np.concatenate([c.jacobian(sight.point) for c in self.cameras[:2]])
        weights = np.repeat([d.velocity_deviation**-2 for d in sight.detections], 2)[:, None]
        prior = 8.0**-2 * np.eye(3)
        covariance = np.zeros((9, 9))
        spread = np.linalg.inv(slope.T @ (weights * slope) + prior)
        velocity = spread @ slope.T @ (weights[:, 0] * np.concatenate([d.velocity for d in sight.detections]))
        covariance[:3, :3], covariance[3:6, 3:6] = sight.covariance, spread + 0.3**2 * np.eye(3)
        covariance[6:, 6:] = 100.0**2 * np.eye(3)
        ball = Kalman(np.concatenate([sight.point, velocity, np.zeros(3)]), covariance, PHYSICS)
        return Hypothesis(ball, time, time, time, time, score=weigh(sight))

    def _choose(self, time: float) -> None:
        """Drops what is seen no more, and reports the likeliest."""
        self.hypotheses = [
            h for h in self.hypotheses if time - h.placed <= (FORGET if h is self.reported else DROP) + 1e-9
        ]
        if self.reported not in self.hypotheses:
            self.reported = None
        others = [h for h in self.hypotheses if h is not self.reported and h.placed == time and self._is_ball(h)]
        best, old = max(others, key=lambda h: h.score, default=None), self.reported
        lost = old is None or time - old.placed > DROP
        if best is not None and (lost or old is None or best.score > old.score + MARGIN):
            self.reported, self.number = best, self.number + 1
        order = sorted(self.hypotheses, key=lambda h: (h is not self.reported, -h.hits, h.begun))
        self.hypotheses = order[:MOST]

    def _is_ball(self, h: Hypothesis) -> bool:
        enough = HITS if h.speed > FAST else SLOW_HITS
        return h.speed > SLOWEST and h.hits >= enough and h.score > SCORE


def find_along(camera: Camera, seen: Detection, other: Camera) -> list[np.ndarray]:
    """Pixels (2,) of another camera, about STRIDE apart, at which the ball may be that a camera sees alone."""
    ray = camera.rays(seen.centre[None])[0]
    with np.errstate(divide="ignore"):
        ends = np.sort((PLAY - camera.centre) / ray, axis=0)
    first, last = max(ends[0].max(), 0.0), ends[1].min()
    if first >= last:
        return []
    line = other.project(camera.centre + np.linspace(first, last, SAMPLES)[:, None] * ray)
    line = line[np.isfinite(line).all(axis=1) & (line >= 0.0).all(axis=1) & (line < other.size).all(axis=1)]
    if not len(line):
        return []
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    count = min(int(np.ceil(way[-1] / STRIDE)) + 1, PLACES)
    return list(line[np.searchsorted(way, np.linspace(0.0, way[-1], count))])


def weigh(sight: Sight) -> float:
    """Evidence for a ball, of both cameras."""
    odds = [min(d.probability, SUREST) for d in sight.detections]
    return float(sum(np.log(p / (1.0 - p)) for p in odds)) - CLUTTER
