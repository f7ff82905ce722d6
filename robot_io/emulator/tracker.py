"""The ball tracker of the rig: what two cameras and a triangulation make of the world's ball.

Its cameras see the ball as pixels: errors are hence larger in depth than across, and larger far from the cameras.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from ballmodel.io.ranges import Within, check_fields
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.emulator.hidden import NOTHING_HIDDEN, HiddenErrors
from robot_io.vision.camera import look_at
from robot_io.vision.triangulation import intersect

if TYPE_CHECKING:
    from robot_io.emulator.world import World

Offset = Annotated[float, Within(-1.0, 1.0, "m")]
Coordinate = Annotated[float, Within(-10.0, 10.0, "m")]
Place = tuple[Coordinate, Coordinate, Coordinate]
BESIDE = 0.1  # [m]
FORGOTTEN = 0.1  # [s] out of sight after which the ball gets another number


@dataclass(frozen=True)
class CameraParams:
    """Of the emulated tracker's two cameras; only where ``triangulated``, which replaces its ``noise``.

    triangulated  True: the ball's place is computed from two images
    first, second [m] where the cameras are in the table frame; they look at the table's centre
    focal         [pixels]; half_width, half_height [pixels] of the images, beyond which nothing is seen
    pixel_noise   [pixels] standard deviation of the ball's centre in an image
    drop_out      probability per frame that a camera loses the ball, for ``lost_for`` [s] on average
    false_sight   probability per frame that a camera takes something else for the ball, anywhere in its image
    switch        probability per frame that the tracker takes the ball for a new one and changes its number; it does so
                  after every drop-out longer than 0.1 s, too
    """

    triangulated: bool = False
    first: Place = (-2.6, -1.6, 2.2)
    second: Place = (2.6, -1.6, 2.2)
    focal: Annotated[float, Within(100.0, 10000.0, "px")] = 1000.0
    half_width: Annotated[float, Within(10.0, 10000.0, "px")] = 720.0
    half_height: Annotated[float, Within(10.0, 10000.0, "px")] = 540.0
    pixel_noise: Annotated[float, Within(0.0, 100.0, "px")] = 0.7
    drop_out: Annotated[float, Within(0.0, 1.0)] = 0.0
    lost_for: Annotated[float, Within(0.001, 10.0, "s")] = 0.05
    false_sight: Annotated[float, Within(0.0, 1.0)] = 0.0
    switch: Annotated[float, Within(0.0, 1.0)] = 0.0

    def __post_init__(self) -> None:
        for name in ("first", "second"):
            place = getattr(self, name)
            if math.hypot(*place[:2]) < BESIDE:
                raise ValueError(
                    f"{name}: expected a place at least {BESIDE} m beside the table's centre, got {place}; a camera "
                    "that looks straight down has no upper edge"
                )
        if math.dist(self.first, self.second) < BESIDE:
            raise ValueError(f"second: expected a place at least {BESIDE} m away from first, got {self.second}")


@dataclass(frozen=True)
class TrackerParams:
    """Of the emulated tracker.

    rate     [Hz] of the cameras (paper: 125)
    latency  [s] from capture to the datagram (paper: about 15 ms)
    noise    [m] standard deviation on each coordinate
    offset   [m] of the calibration, added to every position
    identity  what a number stands for: "ball", one from its first stroke to the end of the rally; "stroke", one from
             stroke to stroke; "lost", as "ball", but the ball is out of sight from its bounce on the human's half until
             it is struck
    cameras  two that triangulate the ball, lose it and mistake it for another; "rendered": the world is drawn, and the
             ball is found in the pictures, in lock-step only
    """

    rate: Annotated[float, Within(10.0, 1000.0, "Hz")] = 125.0
    latency: Annotated[float, Within(0.0, 1.0, "s")] = 0.015
    noise: Annotated[float, Within(0.0, 1.0, "m")] = 0.003
    offset: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    identity: Literal["ball", "stroke", "lost"] = "ball"
    cameras: CameraParams | Literal["rendered"] = CameraParams()

    def __post_init__(self) -> None:
        check_fields(self)

    def sees(self, world: World) -> tuple[int, bool]:
        """Number of the ball, and True when it is seen."""
        hidden = self.identity == "lost" and not world.answered
        return world.strokes if self.identity == "stroke" else world.number, world.visible and not hidden


class EmulatedTracker(ABC):
    """A tracker of the rig: frames become datagrams that wait for its latency; ``step`` once per 1 / rate seconds."""

    def __init__(self, params: TrackerParams, seed: int) -> None:
        self._params, self._random = params, np.random.default_rng(seed)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._sequence, self._silent_until = 0, -np.inf

    @abstractmethod
    def step(self, now: float, ball: int, position: np.ndarray | None) -> None:
        """Captures a frame: the ball's number and true position (3,) [m], None when there is none."""

    def drop_out(self, until: float) -> None:
        """Sends nothing until then."""
        self._silent_until = until

    def due(self, now: float) -> list[bytes]:
        """Datagrams that are ready to be sent."""
        ready = []
        while self._waiting and self._waiting[0][0] <= now + 1e-9:
            ready.append(self._waiting.popleft()[1])
        return ready

    def _send(self, now: float, ball: int, captured: float, *seen: np.ndarray | None) -> None:
        """A frame of ``now``: ball, stamp, and position, velocity and covariance as far as they are known."""
        if now >= self._silent_until:
            self._waiting.append(
                (now + self._params.latency, encode(BallSample(self._sequence, ball, captured, *seen)))
            )
        self._sequence += 1


class CameraPair:
    """Places and numbers as two cameras make them; ``see`` once per frame."""

    def __init__(self, params: CameraParams, rate: float, random: np.random.Generator) -> None:
        self._params, self._rate, self._random = params, rate, random
        self._centres = np.array([params.first, params.second])
        self._axes = [look_at("", centre, target=(0.0, 0.0, 0.0)).rotation for centre in (params.first, params.second)]
        self._lost = np.zeros(2, int)  # frames that a camera will not see
        self._added, self._unseen, self._number = 0, 0, -1

    def see(self, number: int, ball: np.ndarray | None) -> tuple[int, np.ndarray | None]:
        """Number and place (3,) [m] of the ball that is truly there, None where not both cameras see it."""
        place = None if ball is None else self._place(ball)
        if number != self._number:
            self._number, self._unseen = number, 0
        elif ball is not None and place is None:
            self._unseen += 1
        elif place is not None:
            forgotten = self._unseen > FORGOTTEN * self._rate
            self._added += forgotten or self._random.random() < self._params.switch
            self._unseen = 0
        return number + self._added, place

    def _place(self, ball: np.ndarray) -> np.ndarray | None:
        params, random = self._params, self._random
        self._lost = np.maximum(self._lost - 1, 0)
        ends = random.random(2) < params.drop_out
        self._lost = np.where(
            ends, np.maximum(random.geometric(1 / max(params.lost_for * self._rate, 1), 2), 1), self._lost
        )
        inside = np.array([params.half_width, params.half_height])
        rays = np.empty((2, 3))
        for i, (centre, axes) in enumerate(zip(self._centres, self._axes, strict=True)):
            x, y, depth = axes @ (ball - centre)
            pixel = params.focal * np.array([x, y]) / depth + params.pixel_noise * random.normal(size=2)
            if random.random() < params.false_sight:
                pixel = random.uniform(-inside, inside)
            if depth <= 0.0 or (np.abs(pixel) > inside).any() or self._lost[i]:
                return None
            rays[i] = axes.T @ np.array([*pixel, params.focal])
        return intersect(self._centres, rays / np.linalg.norm(rays, axis=1, keepdims=True))


class TrackerEmulator(EmulatedTracker):
    """The true ball with noise, or as two cameras that triangulate it have it."""

    def __init__(self, params: TrackerParams, seed: int, hidden: HiddenErrors = NOTHING_HIDDEN) -> None:
        super().__init__(params, seed)
        self._hidden, pair = hidden, params.cameras
        if not isinstance(pair, CameraParams):
            raise ValueError(
                "tracker.cameras: expected triangulated cameras in real time, got 'rendered'; it is for lock-step"
            )
        self._cameras = CameraPair(pair, params.rate, self._random) if pair.triangulated else None

    def step(self, now: float, ball: int, position: np.ndarray | None) -> None:
        params = self._params
        if self._cameras is not None:
            ball, position = self._cameras.see(ball, position)
        if position is not None:
            noise = 0.0 if self._cameras else params.noise * self._random.normal(size=3)
            position = self._hidden.seen(position) + noise + np.array(params.offset)
        self._send(now, ball, self._hidden.stamped(now), position)
