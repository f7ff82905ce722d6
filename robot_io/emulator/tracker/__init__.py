"""The ball tracker of the rig: what two cameras and a triangulation make of the world's ball."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Protocol, TypeAlias, get_args

import numpy as np

from ballmodel.io.ranges import Within, check_fields
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.emulator.tracker.cameras import CameraPair, CameraParams
from robot_io.emulator.tracker.hidden import NOTHING_HIDDEN, HiddenErrors

if TYPE_CHECKING:
    from robot_io.emulator.world import World

Identity: TypeAlias = Literal["ball", "stroke", "lost"]
IDENTITIES = get_args(Identity)
Offset = Annotated[float, Within(-1.0, 1.0, "m")]


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
    identity: Identity = "ball"
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


class TrackerMaker(Protocol):
    """Makes the tracker of a world whose ``cameras`` is "rendered"."""

    def open(self, params: TrackerParams, world: World, seed: int) -> EmulatedTracker:
        """The tracker of a world; the seed draws all that is random."""
        ...


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
        """Captures a frame: the ball's number and true position (3,) [m], None when there is none."""
        params = self._params
        if self._cameras is not None:
            ball, position = self._cameras.see(ball, position)
        if position is not None:
            noise = 0.0 if self._cameras else params.noise * self._random.normal(size=3)
            position = self._hidden.seen(position) + noise + np.array(params.offset)
        self._send(now, ball, self._hidden.stamped(now), position)
