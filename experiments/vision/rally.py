"""A policy plays balls on the emulated robot in lock-step, by rendered cameras or by triangulated pixels."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from experiments.config import build
from experiments.config import robot as robots
from experiments.deploy.rig import robot_of
from experiments.stats import wilson
from experiments.vision.rendered_rig import RenderedCameras
from mjx_tt.sim.model import SimModel
from robot_io.control.interfaces import STANDARD_PLAY
from robot_io.emulator.lockstep import LockStep
from robot_io.emulator.tracker import CameraParams, TrackerParams
from robot_io.policy.artefact import Artefact
from robot_io.vision.rig import CameraRig
from robot_io.vision.tracker import TrackedBall

TRIANGULATED = CameraParams(triangulated=True)
LATENCY = 0.011  # [s] from the middle of the exposure to the datagram
POOL = 512  # balls that are drawn


@dataclass
class Played:
    """Outcomes of balls, and errors [m] of the tracked ball where all cameras see it; ``unseen`` frames without one."""

    outcomes: list[str] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    unseen: int = 0
    ghosts: int = 0

    def watch(self, rig: CameraRig, ball: TrackedBall | None, truth: np.ndarray | None) -> None:
        """Takes the ball that is reported and where it is (3,) [m], None: there is none."""
        if truth is None:
            self.ghosts += ball is not None
        elif all(camera.sees(truth, 5.0) for camera in rig.cameras):
            if ball is None:
                self.unseen += 1
            else:
                self.errors.append(float(np.linalg.norm(ball.position - truth)))

    def lines(self) -> list[str]:
        """The figures, as text."""
        count, back = len(self.outcomes), self.outcomes.count("returned")
        low, high = wilson(back, count)
        touched = back + self.outcomes.count("hit")
        lines = [
            f"{count} balls, {touched} touched, {back} returned: {back / max(count, 1):.3f} ({low:.3f} to {high:.3f})"
        ]
        if self.errors:
            half, most, nearly_all = 1e3 * np.percentile(self.errors, [50, 90, 99])
            lines.append(
                f"place 50 / 90 / 99 %: {half:.2f} / {most:.2f} / {nearly_all:.1f} mm in {len(self.errors)} frames; "
                f"{self.unseen} without a ball that is there, {self.ghosts} with one that is not"
            )
        return lines


def play(
    artefact: Artefact,
    rig: CameraRig,
    detector: Path,
    balls: int,
    distribution: str,
    seed: int,
    pixels: bool,
) -> Played:
    """Balls of a distribution; with ``pixels`` by the cameras of a rig, else by the emulator's triangulation."""
    robot = robot_of(artefact)
    cameras = TrackerParams(latency=LATENCY, identity="stroke", cameras="rendered" if pixels else TRIANGULATED)
    params = replace(robots.load_rig(None, robot), tracker=cameras, seed=seed)
    thrown = robots.throws_of(build.distribution(distribution, "--distribution"), SimModel(), POOL, seed)
    played = Played()
    rendered = RenderedCameras(rig, detector, watch=partial(played.watch, rig) if pixels else None)
    config = replace(STANDARD_PLAY, contract=robot.contract)
    lock_step = LockStep(robot.scene(), thrown, artefact.streaming(), params, config, rendered=rendered.open)
    lock_step.start()
    while len(played.outcomes) < balls and (found := lock_step.play(1)):
        played.outcomes.append(found[0].outcome)
    return played
