"""The linear axes' settings and state; one axis: its drive's answers, its motion, and where it is held at rest.

To follow a velocity v, the target is put beyond the place where braking from v would have to start, so that the drive
runs at the given speed; the speed is v plus a correction,

    u = v + k (r(t - L) - x(t)),   |k (...)| <= max_correction

of the measured position x against the commanded one r as it was the whole latency L ago, which is when it should be
there. The correction is a proportional controller around a pure delay, without overshoot while k L <= 1/e.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within
from robot_io.devices.festo.modbus_link import RegisterLink
from robot_io.devices.festo.profile import AxisCommand, AxisProfile, AxisStatus

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


@dataclass(frozen=True)
class AxesConfig:
    """Settings of the motion and of the supervision; SI units.

    speed, acceleration  highest that are commanded
    latency              L: from a commanded velocity to its effect in the position that is read back [s]
    gain, max_correction k [1/s] and the bound of the correction [m/s]
    lead                 how far ahead of the braking distance the target lies, in time at the speed [s]; longer than
                         the longest gap between two cycles plus the timing error of the position
    hold_speed           for reaching a target whose velocity is 0
    max_error            deviation from the commanded position that is a fault [m]
    node_guard           silence after which a drive stops by itself [s]; set at start-up where the profile can
    command_timeout      age of a command at which the axes stop and hold [s]; never more than the gate's ``late``
    state_timeout        age of the state at which it counts as unknown [s]
    acknowledge_timeout, enable_timeout, homing_timeout [s]
    overtravel           how far beyond either end of the range a search for the reference may take an axis [m]: to
                         switches and stops, as measured on the robot
    """

    speed: Annotated[float, Within(0.01, 2.0, "m/s")] = 2.0
    acceleration: Annotated[float, Within(0.1, 15.0, "m/s^2")] = 15.0
    latency: Annotated[float, Within(0.001, 0.3, "s")] = 0.0645 + 0.033
    gain: Annotated[float, Within(0.001, 20.0, "1/s")] = 3.0
    max_correction: Annotated[float, Within(0.001, 0.5, "m/s")] = 0.3
    lead: Annotated[float, Within(0.001, 0.1, "s")] = 0.05
    hold_speed: Annotated[float, Within(0.001, 0.5, "m/s")] = 0.1
    max_error: Annotated[float, Within(0.005, 0.15, "m")] = 0.1
    node_guard: Annotated[float, Within(0.02, 0.2, "s")] = 0.1
    command_timeout: Annotated[float, Within(0.02, 0.1, "s")] = 0.03
    state_timeout: Annotated[float, Within(0.02, 0.1, "s")] = 0.05
    acknowledge_timeout: Annotated[float, Within(0.1, 10.0, "s")] = 1.0
    enable_timeout: Annotated[float, Within(0.1, 30.0, "s")] = 5.0
    homing_timeout: Annotated[float, Within(0.1, 120.0, "s")] = 30.0
    overtravel: Annotated[float, Within(0.0, 0.5, "m")] = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and (value > 0 or (value == 0 and name == "overtravel"))):
                raise ValueError(f"{name}: expected a positive, finite number, got {value}")
        if self.gain * self.latency > 1 / math.e:
            raise ValueError(
                f"gain: expected at most {1 / math.e / self.latency:.2f} / s with a latency of {self.latency} s, got "
                f"{self.gain}; more overshoots"
            )


@dataclass(frozen=True, eq=False)
class AxesState:
    """State of the drives by their answers.

    position  (2,) [m], velocity (2,) [m/s], read-only
    received  ``now`` of the older of the two answers [s]
    enabled, homed  both are
    """

    position: np.ndarray
    velocity: np.ndarray
    received: float
    enabled: bool
    homed: bool


@dataclass(frozen=True)
class AxesFault:
    """Reason why the axes were stopped: a short name and a sentence.

    Names: axis_lost, drive_fault, switched_off, acknowledge_timeout, enable_timeout, homing_timeout, node_guard,
    units, bad_answer, following_error.
    """

    cause: str
    sentence: str


@dataclass(frozen=True)
class Axis:
    """One axis of the robot.

    lower, upper  range that is ever commanded [m], robot's coordinate
    zero          [m] where the drive's coordinate reads 0; direction (1 or -1) of the drive's coordinate in the robot's
    """

    name: str
    link: RegisterLink
    profile: AxisProfile
    lower: float
    upper: float
    zero: float = 0.0
    direction: int = 1

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"axis {self.name}: lower {self.lower} must be below upper {self.upper}")
        if self.direction not in (1, -1):
            raise ValueError(f"axis {self.name}: direction {self.direction} must be 1 or -1")


@dataclass(frozen=True)
class Move:
    """Motion of one axis: to ``position`` [m] at up to ``speed`` [m/s]; ``velocity`` is the set-point u."""

    position: float
    speed: float
    velocity: float


def follow(axis: Axis, position: float, velocity: float, error: float, config: AxesConfig) -> Move:
    """The move of an axis that is to be at ``position`` [m] with ``velocity`` [m/s] now and lags by ``error`` [m]."""
    correction = min(max(config.gain * error, -config.max_correction), config.max_correction)
    u = min(max(velocity + correction, -config.speed), config.speed)
    speed, lead = abs(u), 0.0
    if velocity == 0.0:
        speed = max(speed, config.hold_speed)  # the drive goes to the very position
    else:
        lead = math.copysign(0.5 * u * u / config.acceleration + speed * config.lead, u)
    return Move(min(max(position + lead, axis.lower), axis.upper), speed, u)


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

    @property
    def fault_text(self) -> str:
        return "no answer" if self.status is None else self.axis.profile.fault_text(self.status.fault_code)

    def exchange(self, command: AxisCommand) -> AxisStatus:
        """The drive's answer to a command. Raises AxisLost; ValueError for what does not fit the registers."""
        profile, link = self.axis.profile, self.axis.link
        image = profile.encode(command)
        return profile.decode(link.exchange(profile.write_address, image, profile.read_address, profile.read_count))

    def answered(self, status: AxisStatus, now: float, speed: float) -> None:
        """Take an answer of an axis whose highest speed is ``speed`` [m/s]."""
        position, homed = self.axis.zero + self.axis.direction * status.position, self.status and self.status.homed
        reach = FASTEST * speed * (now - self.received + JITTER)
        self.jumped |= bool(homed and status.homed) and abs(position - self.position) > reach
        self.status, self.received, self.position = status, now, position
        self._past.append((now, position))
        while len(self._past) > 1 and self._past[1][0] <= now - STANDING_AGAIN:
            self._past.popleft()

    def release(self) -> None:
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
