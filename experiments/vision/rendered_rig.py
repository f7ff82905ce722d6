"""The rig from pixels: its world is drawn for each camera, and the ball is found, triangulated and tracked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from experiments.vision import render as pictures
from robot_io.emulator.tracker import EmulatedTracker, TrackerParams
from robot_io.emulator.world import World
from robot_io.vision.detector import Detector
from robot_io.vision.rig import CameraRig
from robot_io.vision.tracker import BallTracker, TrackedBall

PAINT, RUBBER, BLADE = np.array([225.0, 105.0, 30.0]), np.array([20.0, 20.0, 20.0]), 0.075


@dataclass(frozen=True)
class RenderedCameras:
    """Makes the tracker of a rig whose ``tracker.cameras`` is "rendered".

    rig        the cameras
    detector   folder of the network
    watch      is told of every frame the reported ball, and where it is [m] (3,); None: there is none
    """

    rig: CameraRig
    detector: Path
    watch: Callable[[TrackedBall | None, np.ndarray | None], None] | None = None

    def open(self, params: TrackerParams, world: World, seed: int) -> RenderedTracker:
        """The tracker of a world; the seed draws the hall, the person and noise."""
        return RenderedTracker(self, params, world, seed)


class RenderedTracker(EmulatedTracker):
    """What it does with a frame is what ``mjx-tt vision run`` does."""

    def __init__(self, cameras: RenderedCameras, params: TrackerParams, world: World, seed: int) -> None:
        super().__init__(params, seed)
        self._world, self._watch, rig = world, cameras.watch, cameras.rig
        self._scenes = [pictures.make_scene(camera, self._random) for camera in rig.cameras]
        for scene in self._scenes:
            scene.exposure, scene.ball = rig.exposure, self._scenes[0].ball
        self._person = pictures.Actors(self._random, clutter=0)
        self._detectors = [Detector(cameras.detector, params.rate) for _ in rig.cameras]
        self.tracker = BallTracker(rig.cameras)
        is_capsule = world.model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
        self._capsules = np.flatnonzero(is_capsule & (world.model.geom_bodyid > 0))

    def step(self, now: float, ball: int, position: np.ndarray | None) -> None:
        """Exposes a frame in whose middle the ball is at a position (3,) [m], or nowhere; its number is not seen."""
        velocity = self._world.ball_velocity

        def path(times: np.ndarray) -> np.ndarray:
            if position is None:
                return pictures.no_ball(times)
            return position + (times - now)[:, None] * velocity

        shapes = [*self._person.person(now, position), *self._robot()]
        guesses = self.tracker.guesses(now)
        found = [
            detector.detect(pictures.render(scene, path, now, self._random, shapes).frame, places)
            for scene, detector, places in zip(self._scenes, self._detectors, guesses, strict=True)
        ]
        tracked = self.tracker.update(now, found)
        if self._watch is not None:
            self._watch(tracked, position)
        if tracked is not None and tracked.seen:
            self._send(now, tracked.number, now, tracked.position, tracked.velocity, tracked.covariance)
        else:
            self._send(now, self.tracker.number, now, None)

    def _robot(self) -> list[pictures.Capsule]:
        """The robot's capsules, and its blade."""
        model, data, shapes = self._world.model, self._world.data, []
        for i in self._capsules:
            place, half = data.geom_xpos[i], data.geom_xmat[i].reshape(3, 3)[:, 2] * model.geom_size[i, 1]
            shapes.append(pictures.Capsule(place - half, place + half, float(model.geom_size[i, 0]), PAINT))
        blade = data.site("paddle").xpos.copy()
        return [*shapes, pictures.Capsule(blade, blade + [0.0, 0.01, 0.0], BLADE, RUBBER)]
