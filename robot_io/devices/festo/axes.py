"""Two linear axes that follow a stream of positions and velocities. No socket, no clock, no thread.

The drives position: each cycle they get a target and a highest speed (``robot_io.devices.festo.axis``). When the
computer dies in mid-motion they stop by themselves: at the last target, at most ``lead`` seconds and a braking
distance away, or when their node guards fire.

Without commands to follow, each axis brakes until it is measured to stand, and is then held at that very place. A drive
whose task is only dropped may keep a set-point far ahead of an axis that is blocked: it goes on pushing, and the axis
jumps there as soon as it is free.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from robot_io.devices.festo.axis import BACK, AxesConfig, AxesFault, AxesState, Axis, Channel, Move, follow
from robot_io.devices.festo.modbus_link import AxisLost
from robot_io.devices.festo.profile import AxisCommand, AxisStatus, SetUpError
from robot_io.history import History

DEFAULTS = AxesConfig()
SETTLING, AT_REST = 0.3, 0.1  # [s] after which an axis that was told to rest must be within this share of max_error
MEMORY = 0.1  # [s] of a silence after which a stream is another one


class FestoAxes:
    """The axes' two exchanges a cycle and everything decided around them. Call ``cycle`` at 125 Hz.

    ``command`` and the requests (``enable``, ``home``, ``acknowledge``, ``stop``, ``disable``) note what is wanted.
    They and the properties may be used from another thread than ``cycle``.

    state      the newest ``AxesState``; None before both axes have answered
    fault      ``AxesFault`` that stopped the axes, latched until ``acknowledge``; None
    commanded  (2,) velocity set-points [m/s] of the last cycle, zero while holding
    stale_commands  how often a stream of commands broke off
    """

    def __init__(self, axes: Sequence[Axis], config: AxesConfig = DEFAULTS) -> None:
        if not axes:
            raise ValueError("no axes given; a robot on a fixed base has a FixedBase")
        self.config = config
        self.state: AxesState | None = None
        self.fault: AxesFault | None = None
        self.commanded = np.zeros(len(axes))
        self.stale_commands = 0
        self._channels = [Channel(axis) for axis in axes]
        self._target: tuple[np.ndarray, np.ndarray, float] | None = None  # position, velocity, time
        self._ignore_before = -math.inf  # commands up to here are void
        self._requests: deque[str] = deque()
        self._moving = False
        self._reference = History(512, math.inf)  # commanded positions
        self._resting_since = math.inf  # [s] of the commands
        self._deadlines = dict.fromkeys(("acknowledge", "enable", "homing"), math.inf)
        self._acknowledging = False
        self._sequence = 0

    @property
    def answering(self) -> bool:
        """Both axes answered in the last cycle: what they know of themselves is known here."""
        return all(c.status is not None for c in self._channels)

    @property
    def homed(self) -> bool:
        """Both axes answer and know where they are."""
        return all(c.status is not None and c.status.homed for c in self._channels)

    @property
    def homing(self) -> bool:
        """One of them is to search its reference, or does."""
        return any(channel.homing for channel in self._channels)

    @property
    def standing(self) -> bool:
        """Nothing moves, as far as is known."""
        return all(c.status is None or not c.status.enabled or abs(c.status.velocity) < 0.005 for c in self._channels)

    def command(self, position: ArrayLike, velocity: ArrayLike, now: float) -> None:
        """The newest target: position (2,) [m] at ``now``, velocity (2,) [m/s] to go on with. ValueError: no number."""
        place, speed = np.array(position, np.float64), np.array(velocity, np.float64)
        for name, values in (("position", place), ("velocity", speed)):
            if values.shape != self.commanded.shape or not np.isfinite(values).all():
                raise ValueError(f"{name} {values.tolist()} must be {self.commanded.size} finite numbers")
        self._target = place, speed, now

    def acknowledge(self) -> None:
        """Clears the latched fault and those of the drives. They stay off until ``enable``."""
        self._requests.append("acknowledge")

    def enable(self) -> None:
        """Switches both drives on; ignored while a fault is latched."""
        self._requests.append("enable")

    def home(self) -> None:
        """Homes the axes that are not homed yet; ignored while a fault is latched."""
        self._requests.append("homing")

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
        healthy, busy = self.fault is None, self._moving or self.homing
        for i, channel in enumerate(self._channels):
            self._exchange(channel, commands[i], now)
            if healthy and self.fault is not None and busy:
                # The other axes must not wait for the next cycle to stop.
                healthy, self._moving, self._sequence = False, False, self._sequence + 1
                commands = self._commands(now)
                for earlier, stop in zip(self._channels[:i], commands, strict=False):
                    self._exchange(earlier, stop, now)
        self._publish()

    def preparable(self, now: float) -> bool:
        """Nothing is wrong but, perhaps, that they are switched off or not homed."""
        return self._unfit(now) is None

    def problem(self, now: float) -> str | None:
        """Reason why the axes cannot follow commands, as a sentence that says what to do; None when they can."""
        state, unfit = self.state, self._unfit(now)
        if unfit is not None or state is None:
            return unfit
        if self.homing:
            return "The linear axes are being homed: wait."
        if not state.enabled:
            return f"{self._names(lambda s: not s.enabled)} switched off: enable the axes."
        if not state.homed:
            return f"{self._names(lambda s: not s.homed)} not homed: home the axes."
        return None

    def _unfit(self, now: float) -> str | None:
        """The problem that neither switching on nor homing mends; None without one."""
        fault, state, limit = self.fault, self.state, self.config.state_timeout
        if fault is not None:
            return fault.sentence
        if state is None:
            return "The linear axes have not answered yet: start the exchange with them, then enable and home them."
        age = now - state.received
        if age > limit:
            return f"The linear axes' state is {age:.3f} s old, allowed are {limit:.3f} s: is the exchange running?"
        return None

    def switch_off(self) -> None:
        """Last words: tells each drive to brake and switch off, whatever fails with another."""
        for channel in self._channels:
            with suppress(Exception):  # nothing is left to do but the same for the others; the drive has its node guard
                channel.exchange(AxisCommand())

    def close(self) -> None:
        for channel in self._channels:
            channel.axis.link.close()

    # What is wanted and what is allowed

    def _take_requests(self, now: float) -> None:
        while self._requests:
            request = self._requests.popleft()
            if request == "acknowledge":
                self.fault, self._acknowledging = None, True
            elif request in ("stop", "disable"):
                self._ignore_before = now
                self._reference.clear()
            elif self.fault is not None:
                continue
            for channel in self._channels:
                if request in ("acknowledge", "disable"):
                    channel.on = channel.was_enabled = channel.homing = False
                elif request == "stop":
                    channel.homing = False
                elif request == "enable":
                    channel.on, channel.jumped = True, False
                else:
                    channel.homing = channel.status is None or not channel.status.homed
            if request in self._deadlines:
                self._deadlines[request] = now + getattr(self.config, f"{request}_timeout")

    def _supervise(self, now: float) -> None:
        """Latches a fault when the drives took too long for a request or are not where they should be."""
        faulty = [c for c in self._channels if c.status is None or c.status.fault]
        if self._acknowledging and (not faulty or now > self._deadlines["acknowledge"]):
            self._acknowledging = False
            if faulty:
                words = "; ".join(f"{c.axis.name}: {c.fault_text}" for c in faulty)
                self._latch(
                    "acknowledge_timeout",
                    f"A fault does not go away ({words}): remove its cause, then acknowledge again.",
                )
        for channel in self._channels:
            name, status = channel.axis.name, channel.status
            if status is None:
                continue
            if channel.on and not status.enabled and now > self._deadlines["enable"]:
                self._latch(
                    "enable_timeout",
                    f"{name} does not switch on: is its load voltage on, and does nothing else control it?",
                )
                channel.on = False
            if channel.homing and status.homed and not status.homing:
                channel.homing = False
            if channel.homing and now > self._deadlines["homing"]:
                self._latch(
                    "homing_timeout",
                    f"{name} is not homed after {self.config.homing_timeout} s: look at its reference switch.",
                )

    def _may_move(self, now: float) -> bool:
        target = self._target
        if target is None or target[2] <= self._ignore_before or self.fault is not None:
            return False
        if not all(c.on and c.status and c.status.enabled and c.status.homed and not c.homing for c in self._channels):
            return False
        if now - target[2] > self.config.command_timeout:
            self.stale_commands += self._moving
            return False
        if not self._moving:
            self._resting_since, last = math.inf, self._reference.newest
            # A stream that broke off for a moment goes on, since what it asked for is still to come.
            if last is not None and now - last[0] > MEMORY:
                self._reference.clear()
        return True

    def _commands(self, now: float) -> list[AxisCommand]:
        moves = self._moves(now) if self._moving else []
        self.commanded = np.array([m.velocity for m in moves]) if moves else np.zeros(len(self._channels))
        commands = []
        for i, channel in enumerate(self._channels):
            status, axis, healthy = channel.status, channel.axis, self.fault is None
            if moves:
                channel.release()
                wanted = moves[i]
            else:
                channel.hold(now)
                wanted = Move(channel.position if channel.held is None else channel.held, BACK, 0.0)
            # Only what would stop by itself when the computer dies gets power, and none while a fault is latched.
            may_be_on = channel.on and channel.configured and status and not status.fault
            commands.append(
                AxisCommand(
                    enable=bool(may_be_on and status and (status.enabled or (status.ready and healthy))),
                    # Pulsed: a drive that is still braking takes no notice of the edge.
                    acknowledge=bool(self._acknowledging and status and status.fault and self._sequence // 8 % 2),
                    home=bool(channel.homing and may_be_on and status and status.enabled and healthy),
                    move=bool(moves or (channel.held is not None and may_be_on and status and status.enabled)),
                    position=(wanted.position - axis.zero) * axis.direction,
                    speed=wanted.speed,
                    acceleration=self.config.acceleration,
                    sequence=self._sequence,
                )
            )
        return commands

    def _moves(self, now: float) -> list[Move]:
        """Each axis's move; none, and a fault, when one is too far off its reference."""
        cfg, target = self.config, self._target
        if target is None:
            return []
        position, velocity, time = target
        reference = position + velocity * (now - time)
        self._reference.add(now, reference)
        self._resting_since = math.inf if velocity.any() else min(self._resting_since, now)
        allowed = cfg.max_error * (AT_REST if now - self._resting_since > cfg.latency + SETTLING else 1.0)
        moves = []
        for i, channel in enumerate(self._channels):
            due = self._reference.at(channel.received - cfg.latency)
            assert due is not None  # it holds what was just added
            error = float(due[i]) - channel.position
            if abs(error) > allowed:
                self._moving = False
                self._latch(
                    "following_error",
                    f"{channel.axis.name} is {abs(error):.3f} m from where it was commanded, allowed are {allowed:g} "
                    "m: is it blocked, or did the commands not start from its position?",
                )
                return []
            moves.append(follow(channel.axis, float(reference[i]), float(velocity[i]), error, cfg))
        return moves

    # The exchange

    def _exchange(self, channel: Channel, command: AxisCommand, now: float) -> None:
        axis = channel.axis
        try:
            if not channel.configured:
                channel.set_up = channel.set_up or axis.profile.set_up(axis.link, self.config.node_guard)
                channel.configured = next(channel.set_up, True) is True
            status = channel.exchange(command)
        except SetUpError as error:
            channel.set_up = None
            return self._latch(error.cause, f"{axis.name}: {error}.")
        except AxisLost as error:
            channel.set_up = channel.status = None
            channel.configured = channel.on = channel.was_enabled = channel.homing = False
            return self._latch(
                "axis_lost", f"{axis.name} is lost ({error}): both axes stop; then acknowledge and enable them."
            )
        except ValueError as error:
            return self._latch("bad_answer", f"{axis.name}: {error}.")
        channel.answered(status, now, self.config.speed)
        if status.fault and not self._acknowledging:
            channel.on = False
            self._latch(
                "drive_fault", f"{axis.name} has a fault, {channel.fault_text}. Remove the cause, then acknowledge it."
            )
        elif channel.on and channel.was_enabled and not status.enabled:
            channel.on = False
            self._latch("switched_off", f"{axis.name} has switched off by itself: acknowledge, then enable the axes.")
        channel.was_enabled = status.enabled and channel.on

    def _latch(self, cause: str, sentence: str) -> None:
        """The first fault counts: the others mostly follow from it. No axis goes on searching its reference."""
        for channel in self._channels:
            channel.homing = False
        if self.fault is None:
            self.fault = AxesFault(cause, sentence)

    def _publish(self) -> None:
        channels = self._channels
        statuses = [c.status for c in channels if c.status is not None]
        if len(statuses) < len(channels):
            return
        position = np.array([c.position for c in channels])
        velocity = np.array([c.axis.direction * s.velocity for c, s in zip(channels, statuses, strict=True)])
        for array in (position, velocity):
            array.flags.writeable = False
        received = min(c.received for c in channels)
        self.state = AxesState(
            position, velocity, received, all(s.enabled for s in statuses), all(s.homed for s in statuses)
        )

    def _names(self, wrong: Callable[[AxisStatus], bool]) -> str:
        names = [c.axis.name for c in self._channels if c.status is None or wrong(c.status)]
        return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'}"
