"""One linear axis as its drive answers, and where it is held while it follows no commands."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from robot_io.devices.festo.config import Axis
from robot_io.devices.festo.profile import AxisStatus

STANDING_TIME, STANDING_WAY = 0.06, 1e-3  # [s], [m]: an axis that moved less than that in this time stands
# [s] of the same, for one that is held: longer than a drive swings to and fro. At every turn of a swing an axis stands
# for a moment, and a hold that followed it from turn to turn made the swing grow.
STANDING_AGAIN = 0.3
# One that shakes is held as well: [s] after the last command, when it is [m] away from its place, once in [s].
LONGEST_BRAKING, SHAKING_WAY, SHAKING = 0.5, 5e-3, 1.0
# [m/s] at which a drive takes its set-point back to an axis that stands: 0.4 m in less than a second.
BACK = 0.5
FASTEST = 1.5  # times the highest speed: a position that came faster is not believed
JITTER = 0.035  # [s] by which the time between two measurements may differ from that between two cycles


class Channel:
    """State of one axis, and what is wanted of it.

    position  [m] in the robot's coordinate, as last answered; 0 before
    """

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.configured = False
        self.set_up: Iterator[None] | None = None  # while it is compared with what robot.yaml says of it
        self.status: AxisStatus | None = None
        self.received = -math.inf
        self.position = 0.0
        self.on = False  # shall be enabled
        self.was_enabled = False
        self.homing = False  # shall be homed
        self.jumped = False  # its position, as no axis can; until somebody switches it on again
        self.held: float | None = None  # where it is held; None while it moves, brakes or is not known
        self._past: deque[tuple[float, float]] = deque()  # times and positions of the last STANDING_AGAIN
        self._idle_since, self._held_since = math.inf, -math.inf  # [s] without commands; held at this place

    def answered(self, status: AxisStatus, now: float, speed: float) -> None:
        """Take an answer of an axis whose highest speed is ``speed`` [m/s]."""
        position, homed = self.axis.zero + self.axis.direction * status.position, self.status and self.status.homed
        reach = FASTEST * speed * (now - self.received + JITTER)
        self.jumped |= bool(homed and status.homed) and abs(position - self.position) > reach
        self.status, self.received, self.position = status, now, position
        self._past.append((now, position))
        while len(self._past) > 1 and self._past[1][0] <= now - STANDING_AGAIN:
            self._past.popleft()

    def follow(self) -> None:
        """It follows commands, and is held nowhere."""
        self.held, self._idle_since, self._held_since = None, math.inf, -math.inf

    def hold(self, now: float) -> None:
        """Note where to hold an axis that follows no commands: where it is measured, once it stands."""
        self._idle_since = min(self._idle_since, now)
        begin = now - (STANDING_TIME if self.held is None else STANDING_AGAIN)
        recent = [position for time, position in self._past if time >= begin]
        known = len(recent) > 1 and self._past[0][0] <= begin  # an axis that has not answered for long may be anywhere
        stands = known and np.ptp(recent) <= STANDING_WAY
        shakes = min(now - self._idle_since - LONGEST_BRAKING, now - self._held_since - SHAKING) > 0.0
        away = math.inf if self.held is None else abs(self.position - self.held)
        if self.status is None or not self.status.homed or self.homing or self.jumped:
            self.held = None
        elif (stands and away > STANDING_WAY) or (shakes and away > SHAKING_WAY):
            self.held, self._held_since = self.position, now
