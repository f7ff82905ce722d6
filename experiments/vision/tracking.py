"""Where the tracker says that the ball is, against where it was: rendered flights, from pixels to state."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.vision.crops import SEEN
from experiments.vision.evaluation import EDGE, LEAD, play_flights, spread
from robot_io.vision.detector import Detector
from robot_io.vision.rig import CameraRig
from robot_io.vision.tracker import BallTracker

SOON = (0.03, 0.06)  # [s] after the stroke in which velocities are judged
DIFFERENCE = 5e-4  # [s]


@dataclass
class Tracked:
    """What came of flights.

    places    (n,) errors [m] where both cameras see the ball and one is reported
    speeds    (n,) errors [m/s] at the same time, and ``soon`` those right after the stroke
    acquired  [s] from both cameras' first sight to the first report, of each flight; infinite: never
    missed    stereo frames after it in which none was reported, though both saw the ball
    ghosts    stereo frames before there was a ball in which one was reported
    """

    places: list[float] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    soon: list[float] = field(default_factory=list)
    acquired: list[float] = field(default_factory=list)
    missed: int = 0
    ghosts: int = 0

    def lines(self) -> list[str]:
        """The figures, as text."""
        if not self.places:
            return ["no ball was tracked"]
        place, speed = spread(1e3 * np.array(self.places)), spread(self.speeds, ".3f")
        soon = spread(self.soon, ".3f", (50, 90)) if self.soon else "none"
        acquired = np.array(self.acquired)
        within = " / ".join(f"{(acquired <= limit + 1e-6).mean():.3f}" for limit in (0.024, 0.032, 0.06))
        return [
            f"{len(self.places)} stereo frames with a tracked ball, {self.missed} missed, {self.ghosts} ghosts",
            f"place 50 / 90 / 99 %: {place} mm",
            f"velocity 50 / 90 / 99 %: {speed} m/s",
            f"velocity {1e3 * SOON[0]:.0f} to {1e3 * SOON[1]:.0f} ms after the first sight, 50 / 90 %: {soon} m/s",
            f"acquired within 24 / 32 / 60 ms: {within}",
        ]


def evaluate_tracker(
    folder: Path, rig: CameraRig, believed: CameraRig, tracks: np.ndarray, rng: np.random.Generator
) -> Tracked:
    """Flights seen by the cameras of a rig, tracked with the cameras that a calibration believes in.

    Args:
        folder: of the detector.
        rig: the cameras that look on.
        believed: the same as calibrated.
        tracks: flights (n, m, 3) [m] at 1 kHz.
        rng: draws halls, people and noise.
    """
    tracked = Tracked()
    for flight in play_flights(rig.cameras, tracks, rng, rig.rate, rig.exposure):
        detectors = [Detector(folder, rig.rate) for _ in rig.cameras]
        tracker = BallTracker(believed.cameras)
        first, got = None, np.inf
        for count, (time, shots, path) in enumerate(flight):
            guesses = tracker.guesses(time)
            found = [d.detect(s.frame, g) for d, s, g in zip(detectors, shots, guesses, strict=True)]
            ball = tracker.update(time, found)
            truth = path(np.array([time - DIFFERENCE, time, time + DIFFERENCE]))
            if np.isnan(truth).any():
                tracked.ghosts += ball is not None and first is None
                continue
            sees = [camera.sees(truth[1], EDGE) for camera in rig.cameras]
            if not all(sees) or min(shot.seen for shot in shots) <= SEEN or count < LEAD:
                continue
            first = time if first is None else first
            if ball is None:
                tracked.missed += got < np.inf
                continue
            got = min(got, time - first)
            velocity = (truth[2] - truth[0]) / (2 * DIFFERENCE)
            tracked.places.append(float(np.linalg.norm(ball.position - truth[1])))
            tracked.speeds.append(float(np.linalg.norm(ball.velocity - velocity)))
            if SOON[0] <= time - first < SOON[1]:
                tracked.soon.append(tracked.speeds[-1])
        if first is not None:
            tracked.acquired.append(got)
    return tracked
