"""Two linear axes that follow a stream of positions and velocities. No socket, no clock, no thread.

The drives position: each cycle they get a target and a highest speed. To follow a velocity v, the target is put beyond the
place where braking from v would have to start, so that the drive runs at the given speed; the speed is v plus a correction

    u = v + k (r(t - L) - x(t)),   |k (...)| <= max_correction

of the measured position x against the commanded one r as it was the whole latency L ago, which is when it should be
there. The correction is a proportional controller around a pure delay, without overshoot while k L <= 1/e. When the
computer dies in mid-motion the drive still stops by itself: at the last target, at most ``lead`` seconds and a braking
distance away, or when its node guard fires.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_io.festo.link import AxisLost, RegisterLink
from robot_io.festo.profile import AxisCommand, AxisProfile, AxisStatus

N_AXES = 2


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
class AxesConfig:
    """Settings of the motion and of the supervision; SI units.

    speed, acceleration  highest that are commanded
    latency              L: from a commanded velocity to its effect in the position that is read back [s]
    gain, max_correction k [1/s] and the bound of the correction [m/s]
    lead                 how far ahead of the braking distance the target lies, in time at the speed [s]; longer than the
                         longest gap between two cycles plus the timing error of the position
    hold_speed           for reaching a target whose velocity is 0
    max_error            deviation from the commanded position that is a fault [m]
    node_guard           silence after which a drive stops by itself [s]; set at start-up where the profile can
    command_timeout      age of a command at which the axes stop and hold [s]
    state_timeout        age of the state at which it counts as unknown [s]
    acknowledge_timeout, enable_timeout, homing_timeout [s]
    """

    speed: float = 2.0
    acceleration: float = 15.0
    latency: float = 0.0645 + 0.033
    gain: float = 3.0
    max_correction: float = 0.3
    lead: float = 0.05
    hold_speed: float = 0.1
    max_error: float = 0.1
    node_guard: float = 0.1
    command_timeout: float = 0.05
    state_timeout: float = 0.05
    acknowledge_timeout: float = 1.0
    enable_timeout: float = 5.0
    homing_timeout: float = 30.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"AxesConfig.{name} is {value}, it must be positive and finite")
        if self.gain * self.latency > 1 / math.e:
            raise ValueError(f"gain {self.gain} / s overshoots with a latency of {self.latency} s: at most {1 / math.e / self.latency:.2f}")


@dataclass(frozen=True, eq=False)
class AxesState:
    """What the drives said.

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
    """Why the axes were stopped: a short name and a sentence. Names: axis_lost, drive_fault, switched_off,
    acknowledge_timeout, enable_timeout, homing_timeout, node_guard, bad_answer, following_error."""

    cause: str
    sentence: str


@dataclass(frozen=True)
class _Target:
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    time: float


class _Channel:
    """What is known of one axis and wanted of it."""

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.configured = False
        self.status: AxisStatus | None = None
        self.received = -math.inf
        self.on = False  # shall be enabled
        self.was_enabled = False
        self.homing = False  # shall be homed

    @property
    def position(self) -> float:
        return self.axis.zero + self.axis.direction * self.status.position


class FestoAxes:
    """The axes' two exchanges a cycle and everything decided around them. Call ``cycle`` at 125 Hz.

    ``command`` and the requests (``enable``, ``home``, ``acknowledge``, ``stop``, ``disable``) only note what is wanted;
    they and the properties may be used from another thread than ``cycle``.

    fault      ``AxesFault`` that stopped the axes, latched until ``acknowledge``; None
    commanded  (2,) velocity set-points [m/s] of the last cycle, zero while holding
    stale_commands  how often a stream of commands broke off
    """

    def __init__(self, axes: Sequence[Axis], config: AxesConfig = AxesConfig()):
        if len(axes) != N_AXES:
            raise ValueError(f"{len(axes)} axes given, the robot has {N_AXES}")
        self.config = config
        self.fault: AxesFault | None = None
        self.commanded = np.zeros(N_AXES)
        self.stale_commands = 0
        self._channels = [_Channel(axis) for axis in axes]
        self._state: AxesState | None = None
        self._target: _Target | None = None
        self._ignore_before = -math.inf  # commands up to here are void
        self._requests: deque[str] = deque()
        self._moving = False
        self._reference: deque[tuple[float, tuple[float, ...]]] = deque()
        self._deadlines = dict.fromkeys(("acknowledge", "enable", "home"), math.inf)
        self._acknowledging = False
        self._sequence = 0

    @property
    def state(self) -> AxesState | None:
        """The newest state, None before both axes have answered."""
        return self._state

    def command(self, position, velocity, now: float) -> None:
        """The newest target: position (2,) [m] at ``now`` and velocity (2,) [m/s] to go on with. ValueError when not finite."""
        numbers = []
        for name, values in (("position", position), ("velocity", velocity)):
            array = np.asarray(values, np.float64)
            if array.shape != (N_AXES,) or not np.isfinite(array).all():
                raise ValueError(f"{name} {values!r} must be {N_AXES} finite numbers")
            numbers.append(tuple(array.tolist()))
        self._target = _Target(numbers[0], numbers[1], now)

    def acknowledge(self) -> None:
        """Clears the latched fault and those of the drives. They stay off until ``enable``."""
        self._requests.append("acknowledge")

    def enable(self) -> None:
        """Switches both drives on; ignored while a fault is latched."""
        self._requests.append("enable")

    def home(self) -> None:
        """Homes the axes that are not homed yet; ignored while a fault is latched."""
        self._requests.append("home")

    def stop(self) -> None:
        """Brakes and holds; commands given before count no more."""
        self._requests.append("stop")

    def disable(self) -> None:
        """Brakes and switches both drives off."""
        self._requests.append("disable")

    def cycle(self, now: float) -> None:
        """One exchange with each axis. Raises nothing of the links: a lost axis is a latched fault."""
        self._sequence += 1
        self._take_requests(now)
        self._supervise(now)
        self._moving = self._may_move(now)
        commands = self._commands(now)
        healthy = self.fault is None
        for i, channel in enumerate(self._channels):
            self._exchange(channel, commands[i], now)
            if healthy and self.fault is not None and self._moving:
                # The other axes must not wait for the next cycle to stop.
                healthy, self._moving, self._sequence = False, False, self._sequence + 1
                commands = self._commands(now)
                for earlier in self._channels[:i]:
                    self._exchange(earlier, commands[self._channels.index(earlier)], now)
        self._publish()

    def standing(self) -> bool:
        """Nothing moves, as far as is known."""
        return all(c.status is None or not c.status.enabled or abs(c.status.velocity) < 0.005 for c in self._channels)

    def problem(self, now: float) -> str | None:
        """Why the axes cannot follow commands, as a sentence that says what to do; None when they can."""
        fault, state = self.fault, self._state
        if fault is not None:
            return fault.sentence
        if state is None:
            return "The linear axes have not answered yet: start the exchange with them, then enable and home them."
        age = now - state.received
        if age > self.config.state_timeout:
            return f"The linear axes' state is {age:.3f} s old, allowed are {self.config.state_timeout:.3f} s: is the exchange running?"
        if any(channel.homing for channel in self._channels):
            return "The linear axes are being homed: wait."
        if not state.enabled:
            return f"{self._names(lambda s: not s.enabled)} switched off: enable the axes."
        if not state.homed:
            return f"{self._names(lambda s: not s.homed)} not homed: home the axes."
        return None

    def switch_off(self) -> None:
        """Last words: tells each drive to brake and switch off, whatever fails with another."""
        for channel in self._channels:
            profile = channel.axis.profile
            try:
                channel.axis.link.exchange(
                    profile.write_address, profile.encode(AxisCommand()), profile.read_address, profile.read_count
                )
            except Exception:  # nothing is left to do but the same for the others; the drive has its node guard
                continue

    def close(self) -> None:
        for channel in self._channels:
            channel.axis.link.close()

    # What is wanted and what is allowed

    def _take_requests(self, now: float) -> None:
        while self._requests:
            request = self._requests.popleft()
            if request == "acknowledge":
                self.fault = None
                self._acknowledging = True
                self._deadlines["acknowledge"] = now + self.config.acknowledge_timeout
            elif request in ("stop", "disable"):
                self._ignore_before = now
            elif self.fault is not None:
                continue
            for channel in self._channels:
                if request in ("acknowledge", "disable"):
                    channel.on = channel.was_enabled = channel.homing = False
                elif request == "stop":
                    channel.homing = False
                elif request == "enable":
                    channel.on = True
                elif request == "home":
                    channel.homing = channel.status is None or not channel.status.homed
            if request in ("enable", "home"):
                self._deadlines[request] = now + getattr(self.config, "enable_timeout" if request == "enable" else "homing_timeout")

    def _supervise(self, now: float) -> None:
        """Latches a fault when the drives took too long for a request or are not where they should be."""
        if self._acknowledging and all(c.status is not None and not c.status.fault for c in self._channels):
            self._acknowledging = False
        elif self._acknowledging and now > self._deadlines["acknowledge"]:
            self._acknowledging = False
            faulty = [c for c in self._channels if c.status is None or c.status.fault]
            words = "; ".join(f"{c.axis.name}: {self._fault_words(c)}" for c in faulty)
            self._latch("acknowledge_timeout", f"A fault does not go away ({words}): remove its cause, then acknowledge again.")
        for channel in self._channels:
            name, status = channel.axis.name, channel.status
            if status is None:
                continue
            if channel.on and not status.enabled and now > self._deadlines["enable"]:
                self._latch("enable_timeout", f"{name} does not switch on: is its load voltage on, and does nothing else control it?")
                channel.on = False
            if channel.homing and status.homed and not status.homing:
                channel.homing = False
            if channel.homing and now > self._deadlines["home"]:
                channel.homing = False
                self._latch("homing_timeout", f"{name} is not homed after {self.config.homing_timeout} s: look at its reference switch.")

    def _may_move(self, now: float) -> bool:
        target = self._target
        if target is None or target.time <= self._ignore_before or self.fault is not None:
            return False
        if not all(c.on and c.status and c.status.enabled and c.status.homed and not c.homing for c in self._channels):
            return False
        if now - target.time > self.config.command_timeout:
            self.stale_commands += self._moving
            return False
        if not self._moving:
            self._reference.clear()
        return True

    def _commands(self, now: float) -> list[AxisCommand]:
        if self._moving:
            moves = self._moves(now)
        if not self._moving:  # or no more: a deviation is a fault
            moves = [(c.position if c.status else 0.0, 0.0) for c in self._channels]
            self.commanded = np.zeros(N_AXES)
        commands = []
        for channel, (target, speed) in zip(self._channels, moves):
            status, axis = channel.status, channel.axis
            commands.append(
                AxisCommand(
                    enable=bool(channel.on and status and not status.fault and (status.enabled or status.ready)),
                    # Pulsed: a drive that is still braking takes no notice of the edge.
                    acknowledge=bool(self._acknowledging and status and status.fault and self._sequence // 8 % 2),
                    home=bool(channel.homing and status and status.enabled),
                    move=self._moving,
                    position=(target - axis.zero) * axis.direction,
                    speed=speed,
                    acceleration=self.config.acceleration,
                    sequence=self._sequence,
                )
            )
        return commands

    def _moves(self, now: float) -> list[tuple[float, float]]:
        """Target [m] and speed [m/s] of each axis; stops instead when one is too far off its reference."""
        cfg, target = self.config, self._target
        since = now - target.time
        reference = tuple(r + v * since for r, v in zip(target.position, target.velocity))
        self._reference.append((now, reference))
        moves, velocities = [], []
        for i, channel in enumerate(self._channels):
            error = self._reference_at(channel.received - cfg.latency)[i] - channel.position
            if abs(error) > cfg.max_error:
                self._moving = False
                self._latch(
                    "following_error",
                    f"{channel.axis.name} is {abs(error):.3f} m from where it was commanded, allowed are {cfg.max_error} m: "
                    "is it blocked, or did the commands not start from its position?",
                )
                return []
            velocity = target.velocity[i]
            u = velocity + min(max(cfg.gain * error, -cfg.max_correction), cfg.max_correction)
            u = min(max(u, -cfg.speed), cfg.speed)
            speed, lead = abs(u), 0.0
            if velocity == 0.0:
                speed = max(speed, cfg.hold_speed)  # the drive goes to the very position
            else:
                lead = math.copysign(0.5 * u * u / cfg.acceleration + speed * cfg.lead, u)
            moves.append((min(max(reference[i] + lead, channel.axis.lower), channel.axis.upper), speed))
            velocities.append(u)
        self.commanded = np.array(velocities)
        return moves

    def _reference_at(self, time: float) -> tuple[float, ...]:
        """The commanded position at ``time``; the first one before the stream began."""
        past = self._reference
        while len(past) > 2 and past[1][0] <= time - 0.1:
            past.popleft()
        later = past[-1]
        for earlier in reversed(past):
            if earlier[0] <= time:
                share = (time - earlier[0]) / (later[0] - earlier[0]) if later is not earlier else 0.0
                return tuple(a + share * (b - a) for a, b in zip(earlier[1], later[1]))
            later = earlier
        return later[1]

    # The exchange

    def _exchange(self, channel: _Channel, command: AxisCommand, now: float) -> None:
        axis, profile = channel.axis, channel.axis.profile
        try:
            if not channel.configured:
                self._configure(channel)
            registers = axis.link.exchange(
                profile.write_address, profile.encode(command), profile.read_address, profile.read_count
            )
            status = profile.decode(registers)
        except AxisLost as error:
            channel.configured = channel.on = channel.was_enabled = channel.homing = False
            channel.status = None
            self._latch("axis_lost", f"{axis.name} is lost ({error.reason}): both axes stop; then acknowledge and enable them.")
            return
        except ValueError as error:
            self._latch("bad_answer", f"{axis.name}: {error}.")
            return
        channel.status, channel.received = status, now
        if status.fault and not self._acknowledging:
            self._latch("drive_fault", f"{axis.name} has a fault, {self._fault_words(channel)}. Remove the cause, then acknowledge it.")
            channel.on = False
        elif channel.on and channel.was_enabled and not status.enabled:
            channel.on = False
            self._latch("switched_off", f"{axis.name} has switched off by itself: acknowledge, then enable the axes.")
        channel.was_enabled = status.enabled and channel.on

    def _configure(self, channel: _Channel) -> None:
        guard = channel.axis.profile.node_guard(self.config.node_guard)
        if guard is not None:
            address, values = guard
            answer = channel.axis.link.exchange(address, values, address, len(values))
            if answer != values:
                self._latch(
                    "node_guard",
                    f"{channel.axis.name} took the time-out {values} as {answer}: without it, it would not stop when the computer dies.",
                )
                return
        channel.configured = True

    def _latch(self, cause: str, sentence: str) -> None:
        """The first fault counts: the others mostly follow from it."""
        if self.fault is None:
            self.fault = AxesFault(cause, sentence)

    def _publish(self) -> None:
        channels = self._channels
        if any(c.status is None for c in channels):
            return
        position = np.array([c.position for c in channels])
        velocity = np.array([c.axis.direction * c.status.velocity for c in channels])
        for array in (position, velocity):
            array.flags.writeable = False
        self._state = AxesState(
            position=position,
            velocity=velocity,
            received=min(c.received for c in channels),
            enabled=all(c.status.enabled for c in channels),
            homed=all(c.status.homed for c in channels),
        )

    def _fault_words(self, channel: _Channel) -> str:
        return "no answer" if channel.status is None else channel.axis.profile.fault_text(channel.status.fault_code)

    def _names(self, wrong) -> str:
        names = [c.axis.name for c in self._channels if c.status is None or wrong(c.status)]
        return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'}"
