"""The emulated drive behind an axis's registers: power, faults, homing, positioning. SI units, no registers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from ballmodel.io.ranges import Within
from robot_io.emulator.axis_motion import Past, advance, brake

FOLLOWING_ERROR = 126  # CMMT's number


class Power(Enum):
    INHIBITED = "inhibited"  # an ON command that is already there does not count
    READY = "ready"
    SWITCHING_ON = "switching on"
    OPERATING = "operating"
    SWITCHING_OFF = "switching off"  # still powered, braking


@dataclass(frozen=True)
class DriveParams:
    """Properties of a drive and its axis.

    speed, acceleration   highest [m/s], [m/s^2]
    smoothing             window of the jerk-limiting mean over the generated velocity [s]; 0 for none
    position_gain         of the position controller [1/s]
    holds_measured        a dropped task's set-point begins anew where the axis is measured; else it brakes as planned,
                          however far it is ahead of an axis that is blocked
    following_error       deviation from the generated position that is a fault [m]
    switch_on_time        from ON to operating [s]
    homing_time           [s]; the search itself is not modelled, the axis stands
    """

    speed: Annotated[float, Within(0.01, 10.0, "m/s")] = 2.0
    acceleration: Annotated[float, Within(0.1, 100.0, "m/s^2")] = 15.0
    smoothing: Annotated[float, Within(0.0, 1.0, "s")] = 0.008
    position_gain: Annotated[float, Within(0.1, 1000.0, "1/s")] = 20.0
    holds_measured: bool = False
    following_error: Annotated[float, Within(0.001, 10.0, "m")] = 0.1
    switch_on_time: Annotated[float, Within(0.0, 60.0, "s")] = 0.05
    homing_time: Annotated[float, Within(0.0, 60.0, "s")] = 1.0


class Drive:
    """Commands take effect at once; ``step`` moves on in time and gives the velocity set-point."""

    def __init__(self, params: DriveParams) -> None:
        self.params = params
        self.power, self.fault_code = Power.INHIBITED, 0
        self.homed = self.homing = False
        self.task = False  # a positioning task is active
        self.paused = False  # brakes and keeps the task
        self.target = 0.0
        self.origin: float | None = None  # the plant's position that is reported as 0
        self.x = self.v = 0.0  # generated
        self.acceleration = params.acceleration
        self._speed = params.speed
        self._allowed = False
        self._until = 0.0  # end of switching on or homing
        self._now = 0.0
        self._started = False  # by the first step, which begins the drive's time
        self._area = 0.0  # time integral of x
        self._past = Past(2.0 * params.smoothing + 0.01)
        self._position = self._velocity = 0.0  # measured

    @property
    def operating(self) -> bool:
        return self.power is Power.OPERATING

    @property
    def powered(self) -> bool:
        """It has power, be it that it brakes to switch off."""
        return self.power in (Power.OPERATING, Power.SWITCHING_OFF)

    @property
    def reached(self) -> bool:
        """At rest with nothing left to do."""
        return self.v == 0.0 and (not self.task or self.x == self.target)

    def request_power(self, on: bool, allowed: bool) -> None:
        """``allowed``: no coast stop and no quick stop asked for."""
        self._allowed = allowed
        if not allowed:
            self._switch_off()
        elif self.power is Power.INHIBITED and not on and not self.fault_code:
            self.power = Power.READY
        elif self.power is Power.READY and on:
            self.power, self._until = Power.SWITCHING_ON, self._now + self.params.switch_on_time
        elif not on:
            self._switch_off()

    def acknowledge(self) -> None:
        if self.power is Power.INHIBITED:
            self.fault_code = 0

    def fault(self, code: int) -> None:
        """The first fault counts until it is acknowledged."""
        self.fault_code = self.fault_code or code
        self._switch_off()
        if self.power is not Power.SWITCHING_OFF:
            self.power = Power.INHIBITED

    def home(self) -> None:
        """Starts homing; nothing where the drive cannot now."""
        if self.operating and self.v == 0.0:
            self.homing, self.homed, self.task = True, False, False
            self._until = self._now + self.params.homing_time

    def position(self, target: float, speed: float, acceleration: float, relative: bool = False) -> None:
        """A positioning task (reported coordinate); refused where not operating, homing, absolute and not homed."""
        if self.operating and not self.homing and (self.homed or relative) and acceleration > 0.0:
            self.target = self.x + target if relative else target + (self.origin or 0.0)
            self._speed = min(max(speed, 0.0), self.params.speed)
            self.acceleration = min(acceleration, self.params.acceleration)
            self.task, self.paused = True, False

    def halt(self) -> None:
        """Brakes and drops the task."""
        if self.task and self.params.holds_measured:
            self._restart(self._position, self._velocity)
        self.task = False

    def measure(self, position: float, velocity: float) -> None:
        """Position and velocity of the plant, at which the generator starts when the drive gets power."""
        self._position, self._velocity = position, velocity
        if self.origin is None:
            self.origin = position
        if not self.powered:
            self.x, self.v = position, 0.0

    def step(self, now: float) -> None:
        """Moves the generator on to ``now``."""
        dt = now - self._now if self._started else 0.0
        self._started, self._now = True, now
        before = self.x
        if self.power is Power.SWITCHING_ON and now >= self._until:
            self.power = Power.OPERATING
        if self.power is Power.OPERATING and self.task and not self.paused:
            self.x, self.v = advance(self.x, self.v, self.target, self._speed, self.acceleration, dt)
        elif self.powered:
            self.x, self.v = brake(self.x, self.v, self.params.acceleration, dt)
        if self.power is Power.SWITCHING_OFF and self.v == 0.0:
            self.power = Power.READY if self._allowed and not self.fault_code else Power.INHIBITED
        if self.homing and now >= self._until:
            self.homing, self.homed, self.origin = False, True, 0.0
        self._area += 0.5 * (before + self.x) * dt
        self._past.add(now, self.x, self._area)

    def restart(self, reading: float) -> None:
        """Its supply was gone for a moment: no power, no reference, and ``reading`` [m] where it stands."""
        self.power, self.fault_code = Power.INHIBITED, 0
        self.homed = self.homing = self.task = self.paused = False
        self.x, self.v, self.origin = self._position, 0.0, self._position - reading

    def set_point(self) -> float:
        """Velocity [m/s] for the plant: the smoothed generated one and the position controller's."""
        window, x, v = self.params.smoothing, self.x, self.v
        if window > 0.0:
            earlier, area = self._past.at(self._now - window)
            x, v = (self._area - area) / window, (self.x - earlier) / window
        if not self.powered:
            return 0.0
        error = x - self._position
        if abs(error) > self.params.following_error:
            self.fault(FOLLOWING_ERROR)
        highest = 1.1 * self.params.speed
        return min(max(v + self.params.position_gain * error, -highest), highest)

    def _restart(self, x: float, v: float) -> None:
        """The generator goes on from here, as if it had come at this velocity."""
        window = self.params.smoothing
        self.x, self.v, self._past = x, v, Past(2.0 * window + 0.01)
        self._past.add(self._now - window, x - v * window, self._area - (x - 0.5 * v * window) * window)
        self._past.add(self._now, x, self._area)

    def _switch_off(self) -> None:
        self.task = self.homing = False
        if self.powered and self.v != 0.0:
            self.power = Power.SWITCHING_OFF
        elif self.power is not Power.INHIBITED:
            self.power = Power.READY if self._allowed and not self.fault_code else Power.INHIBITED
