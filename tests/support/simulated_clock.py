"""A bridge on a simulated clock with a made-up arm and a scripted ball: everything else but the sockets is real."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from robot_io.contract import N_JOINTS
from robot_io.control.bridge import Bridge, BridgeConfig
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.devices.egm.messages import decode_sensor, encode_robot
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.safety.gate import SafetyGate

CONTROLLER = ("127.0.0.1", 40000)
DEAD_TIME = 0.055  # [s] of the arm's controller


class FollowingAxes:
    """Linear axes that are where they were commanded to be at once; also stands for the thread around them."""

    cycles = late = 0
    fault, homed, answering, homing = None, True, True, False

    def __init__(self, position: np.ndarray) -> None:
        self.position, self.stops, self.closed = np.array(position), 0, False
        self.received = 0.0

    @property
    def state(self):
        return self

    axes = state

    def command(self, position, velocity, now):
        self.position = np.array(position)

    def start(self):
        pass

    def enable(self):
        pass

    def home(self):
        self.homed = True

    def stop(self):
        self.stops += 1

    def close(self):
        self.closed = True

    def preparable(self, now):
        return True

    def problem(self, now):
        return None


class Constant:
    """Policy with one action for ever."""

    def __init__(self, action: Sequence[float] = (0.0,) * N_JOINTS) -> None:
        self.action = np.asarray(action, float)

    def reset(self):
        pass

    def step(self, observation):
        return self.action


class Simulation:
    """1 ms steps; the arm sends every 4 ms, the tracker every 8 ms, the bridge ticks at 75 Hz.

    ball     position (3,) or None by time [s]; ``number`` is its number
    blocked  joints (6,) of the arm that cannot move now
    stalled  whether the control process stands still now, by time
    """

    def __init__(self, policy=None, ball: Callable = lambda t: None, **options) -> None:
        gate = SafetyGate()
        self.home = gate.geometry.home.copy()
        self.now, self.arm = 10.0, self.home[2:].copy()
        self.axes = FollowingAxes(self.home[:2])
        self.ball, self.blocked = ball, np.zeros(6, bool)
        self.stalled: Callable[[float], bool] = lambda t: False
        self.summaries: list = []
        self.replies: list[tuple[float, np.ndarray, np.ndarray]] = []  # time, position, velocity
        options.setdefault("on_episode", self.summaries.append)
        options.setdefault("config", BridgeConfig(balls_needed=0))
        self.bridge = Bridge(
            EgmSession(EgmConfig(CONTROLLER[0], ramp_in=0.0)),  # as this arm, which ramps nothing in
            self.axes,
            Tracker(TrackerConfig()),
            gate,
            policy or Constant(),
            **options,
        )
        self.number = 1
        self.packets: list[bytes] = []
        self.frames: deque[tuple[float, bytes]] = deque()
        self._steps = 0
        self._coming: deque = deque()
        self._command = (self.arm.copy(), np.zeros(6))
        self._next_tick = self.now

    def advance(self) -> None:
        """Arm, axes and cameras go on by 1 ms; what they send waits in ``packets`` and ``frames``."""
        self._steps += 1
        now = self.now = self.axes.received = 10.0 + self._steps / 1000
        while self._coming and self._coming[0][0] <= now:
            self._command = self._coming.popleft()[1:]
        position, velocity = self._command
        speed = velocity + 1.0 * (position - self.arm)  # EGM with PosCorrGain 1
        self.arm = np.where(self.blocked, self.arm, self.arm + 0.001 * speed)
        if self._steps % 8 == 0:
            place = self.ball(now)
            sample = BallSample(self._steps // 8, 0 if place is None else self.number, now, place)
            self.frames.append((now + 0.015, encode(sample)))
        if self._steps % 4 == 0:
            self.packets.append(encode_robot(self._steps // 4, self._steps, self.arm, self.arm, True, True, True))

    def answered(self, reply: bytes) -> None:
        """The arm's controller takes a reply of the bridge."""
        message = decode_sensor(reply)
        self.replies.append((self.now, message.position, message.velocity))
        self._coming.append((self.now + DEAD_TIME, message.position, message.velocity))

    def step(self) -> None:
        self.advance()
        now, bridge = self.now, self.bridge
        if self.stalled(now):
            self.packets = self.packets[-1:]  # the socket's queue is drained to its newest
            return
        while self.packets:
            if bridge.arm_session.receive(self.packets.pop(0), CONTROLLER, now):
                reply = bridge.arm_received(now)
                if reply is not None:
                    self.answered(reply)
        while self.frames and self.frames[0][0] <= now:
            bridge.tracker_received(self.frames.popleft()[1], "127.0.0.1", now)
        if now >= self._next_tick:
            self._next_tick = now + 1 / 75
            bridge.axes_received(self.axes.position, now)
            bridge.tick(now, now)

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        end = self._steps + round(1000 * seconds)
        while self._steps < end and not until():
            self.step()
        return until()
