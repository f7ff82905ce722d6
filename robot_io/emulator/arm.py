"""An emulator of ABB's side of EGM in joint mode, without socket or clock: give it to anything that moves six joints.

One call of ``step`` is one controller cycle: feedback goes out first, then ONE queued message is taken. With none
queued the last reference stays in force, its speed included, until ``comm_timeout``. The references pass a dead time
and the speed a first-order low-pass; the velocity for the drives is
    velocity = low-passed speed + pos_corr_gain * (position reference - measured position).
A stop for whatever reason is the controller's own decision: it acts at once, behind the dead time, and brings the
velocity to zero at ``stop_deceleration``.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within, check_fields
from robot_io.contract import ABB_JOINTS
from robot_io.devices.egm.messages import N_ARM_JOINTS, EgmError, decode_sensor, encode_robot
from robot_io.emulator.axis_motion import Past
from robot_io.limits import LIMITS


def _arm(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(values[i] for i in ABB_JOINTS)


Deceleration = Annotated[float, Within(0.1, 1000.0, "rad/s^2")]


@dataclass(frozen=True)
class ArmParams:
    """Parameters of the emulated controller; times in seconds, joint tuples in rad, rad/s, rad/s^2.

    cycle              nominal period of ``step``
    feedback_delay     age of the positions that feedback reports
    dead_time          from taking a message to its effect on the drives (reported: about 50 ms)
    low_pass           bandwidth of the speed reference's filter [Hz] (EGM's default 20 Hz: time constant 8 ms)
    pos_corr_gain      [1/s], RAPID's PosCorrGain
    comm_timeout       silence after which EGM stops, RAPID's CommTimeout. The default is ABB's, and until it has passed
                       the arm runs on at its last speed when the computer dies: commissioning sets 0.05..0.1 s
    stop_deceleration  of each joint in any stop; estimates, what the arm is taken to accelerate at (joint 5 as joint 6)
    lower, upper       position range; a position outside it by more than ``position_tolerance`` switches the motors off
    max_speed          joint speeds of the drives (120T); above ``overspeed`` times that the motors are switched off
    ramp_in            [s] from EGM's start on in which its commands grow to their full effect, RAPID's RampInTime
    max_speed_deviation  [rad/s] that no commanded speed exceeds, RAPID's MaxSpeedDeviation
    queue_length       messages that wait at most; later ones are dropped
    stream_always      feedback also while EGM is not running (RAPID's EGMStreamStart)
    """

    cycle: Annotated[float, Within(0.001, 0.02, "s")] = 0.004
    feedback_delay: Annotated[float, Within(0.0, 1.0, "s")] = 0.029
    dead_time: Annotated[float, Within(0.0, 1.0, "s")] = 0.055
    low_pass: Annotated[float, Within(0.1, 1000.0, "Hz")] = 20.0
    pos_corr_gain: Annotated[float, Within(0.0, 100.0, "1/s")] = 1.0
    comm_timeout: Annotated[float, Within(0.004, 10.0, "s")] = 1.0
    stop_deceleration: tuple[Deceleration, ...] = (60.0, 60.0, 60.0, 100.0, 120.0, 120.0)
    lower: tuple[Annotated[float, Within(-10.0, 10.0, "rad")], ...] = _arm(LIMITS.lower)
    upper: tuple[Annotated[float, Within(-10.0, 10.0, "rad")], ...] = _arm(LIMITS.upper)
    max_speed: tuple[Annotated[float, Within(0.01, 100.0, "rad/s")], ...] = _arm(LIMITS.velocity)
    position_tolerance: Annotated[float, Within(0.0, 1.0, "rad")] = math.radians(0.5)
    overspeed: Annotated[float, Within(1.0, 10.0)] = 1.1
    ramp_in: Annotated[float, Within(0.0, 10.0, "s")] = 1.0
    max_speed_deviation: Annotated[float, Within(0.001, 100.0, "rad/s")] = math.radians(600.0)
    queue_length: Annotated[int, Within(1, 10000)] = 64
    stream_always: bool = True

    def __post_init__(self) -> None:
        each = {name: getattr(self, name) for name in ("stop_deceleration", "lower", "upper", "max_speed")}
        lengths = {len(values) for values in each.values()}
        count = N_ARM_JOINTS if N_ARM_JOINTS in lengths else min(lengths)
        for name, values in each.items():
            if len(values) != count:
                raise ValueError(f"{name}: expected {count} finite numbers, got {values}")
        check_fields(self)
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"lower: expected less than upper, {self.upper}, in each joint, got {self.lower}")


class ArmStateError(RuntimeError):
    """An operator's action that the controller's state does not allow."""


class ArmController:
    """The controller of one arm. It sends to ``client`` = (address, port) and takes messages from there only.

    Starts with motors off. An operator calls ``motors_on``, ``start_rapid``, ``start_egm``; ``motors_off`` is the
    emergency stop. ``motors_on()`` and the like return nothing and raise ArmStateError where they are not allowed.

    cause     of the last stop, a sentence; None while EGM runs or before anything happened
    rejected  datagrams by reason: stranger, not_running, queue_full, out_of_range or an ``EgmError.reason``
    """

    def __init__(self, client: tuple[str, int], params: ArmParams = ArmParams()):
        self.client = (client[0], client[1])
        self.params = params
        self.cause: str | None = None
        self.rejected: Counter[str] = Counter()
        self.motors_are_on = self.rapid_is_running = self.egm_is_running = False
        self._queue: deque = deque()
        self._past = Past(params.feedback_delay)  # measured positions
        self._sequence = 0
        self._now: float | None = None
        self._velocity: np.ndarray = np.zeros(len(params.lower))
        self._reference: _Reference | None = None  # while EGM runs, from the first step on
        self._last_message = 0.0
        self._deceleration, self._max_speed = np.array(params.stop_deceleration), np.array(params.max_speed)
        self._egm_began = 0.0
        self._lower = np.array(params.lower) - params.position_tolerance
        self._upper = np.array(params.upper) + params.position_tolerance

    def switch_on(self) -> None:
        """Motors, RAPID and EGM, as a person does it; EGM not while the arm still brakes: ArmStateError."""
        self.motors_on()
        self.start_rapid()
        self.start_egm()

    def motors_on(self) -> None:
        self.motors_are_on = True

    def motors_off(self, cause: str = "motors switched off: emergency stop") -> None:
        """Stops the arm, RAPID and EGM; allowed in every state."""
        self.motors_are_on = False
        self.stop_rapid(cause)

    def start_rapid(self) -> None:
        if not self.motors_are_on:
            raise ArmStateError("RAPID cannot start with the motors off: call motors_on() first")
        self.rapid_is_running = True

    def stop_rapid(self, cause: str = "RAPID stopped by the operator") -> None:
        """Stops the arm, RAPID and EGM; the motors stay on."""
        self.rapid_is_running = False
        self.stop_egm(cause)

    def start_egm(self) -> None:
        """A new EGM session: sequence numbers begin at 0, the reference is where the arm stands."""
        if not self.rapid_is_running:
            raise ArmStateError("EGM cannot start while RAPID is stopped: call start_rapid() first")
        if self._velocity.any():
            raise ArmStateError("EGM cannot start while the arm still brakes: step until the velocity is zero")
        self.stop_egm(None)
        self.egm_is_running = True
        self._sequence = 0

    def stop_egm(self, cause: str | None = "EGM stopped by the operator") -> None:
        """Stops the arm and EGM; RAPID goes on."""
        self.cause, self.egm_is_running, self._reference = cause, False, None
        self._queue.clear()

    def receive(self, datagram: bytes, source: tuple[str, int], now: float) -> bool:
        """Queues one EgmSensor; True when it was taken. No content makes it raise.

        Position and speed are both required: half a message never moves the arm. A reference outside the joint range or
        beyond the overspeed limit ends EGM, as on the real controller.
        """
        if (source[0], source[1]) != self.client:
            return self._refuse("stranger")
        if not self.egm_is_running:
            return self._refuse("not_running")
        try:
            message = decode_sensor(datagram, len(self.params.lower))
        except EgmError as error:
            return self._refuse(error.reason)
        outside, too_fast = self._beyond(message.position, message.velocity)
        if (outside | too_fast).any():
            joint = int(np.argmax(outside | too_fast))
            self.stop_egm(
                f"EGM stopped: reference of arm joint {joint + 1} out of range, position {message.position[joint]:.4g} "
                f"rad, speed {message.velocity[joint]:.4g} rad/s"
            )
            return self._refuse("out_of_range")
        if len(self._queue) >= self.params.queue_length:
            return self._refuse("queue_full")
        self._queue.append(message)
        return True

    def step(self, now: float, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, bytes | None]:
        """One cycle at time ``now`` with the joints' true position (6,) [rad] and velocity (6,) [rad/s].

        Returns the velocity (6,) [rad/s] for the drives until the next cycle, and the EgmRobot datagram for ``client``.
        """
        position, velocity = (np.array(x, np.float64) for x in (position, velocity))
        if position.shape != self._lower.shape or velocity.shape != position.shape:
            needed = self._lower.shape
            raise ValueError(f"position and velocity must be {needed}, got {position.shape}, {velocity.shape}")
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise ValueError(f"the arm's state has a non-finite number: position {position}, velocity {velocity}")
        if self._now is not None and not now > self._now:
            raise ValueError(f"time must advance: step at {now} s after {self._now} s")
        elapsed = self.params.cycle if self._now is None else now - self._now
        self._now = now
        self._supervise(position, velocity)
        if self.egm_is_running and self._reference is None:
            self._reference = _Reference(now, position, self.params)
            self._last_message = self._egm_began = now
        datagram = self._feedback(now, position)
        if self._reference is not None:
            self._take_message(now, self._reference)
        if self._reference is not None:  # it still runs
            speed, target = self._reference.at(now)
            wanted = speed + self.params.pos_corr_gain * (target - position)
            if now < self._egm_began + self.params.ramp_in:
                wanted = wanted * ((now - self._egm_began) / self.params.ramp_in)
            allowed = np.minimum(self._max_speed, self.params.max_speed_deviation)
            self._velocity = np.minimum(np.maximum(wanted, -allowed), allowed)
        else:
            step = self._deceleration * elapsed
            self._velocity = self._velocity - np.minimum(np.maximum(self._velocity, -step), step)
        return self._velocity.copy(), datagram

    def _beyond(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints (6,) outside their ranges, and above the overspeed limit."""
        outside = (position < self._lower) | (position > self._upper)
        return outside, np.abs(velocity) > self.params.overspeed * self._max_speed

    def _supervise(self, position: np.ndarray, velocity: np.ndarray) -> None:
        if not self.motors_are_on:
            return
        outside, too_fast = self._beyond(position, velocity)
        if outside.any():
            joint = int(np.argmax(outside))
            self.motors_off(
                f"motors switched off: arm joint {joint + 1} is at {position[joint]:.4f} rad, outside "
                f"[{self.params.lower[joint]:.4f}, {self.params.upper[joint]:.4f}] rad"
            )
        elif too_fast.any():
            joint = int(np.argmax(too_fast))
            limit = self.params.overspeed * self._max_speed[joint]
            self.motors_off(
                f"motors switched off: arm joint {joint + 1} moves at {velocity[joint]:.3f} rad/s, "
                f"limit {limit:.3f} rad/s"
            )

    def _feedback(self, now: float, position: np.ndarray) -> bytes | None:
        self._past.add(now, *position.tolist())
        reported = self._past.at(now - self.params.feedback_delay)
        if not (self.egm_is_running or self.params.stream_always):
            return None
        planned = position if self._reference is None else self._reference.target
        states = self.motors_are_on, self.egm_is_running, self.rapid_is_running
        datagram = encode_robot(self._sequence, round(now * 1000.0), reported, planned, *states)
        self._sequence += 1
        return datagram

    def _take_message(self, now: float, reference: _Reference) -> None:
        if self._queue:
            message = self._queue.popleft()
            reference.coming.append((now + self.params.dead_time, message.velocity, message.position))
            self._last_message = now
            return
        silence = now - self._last_message
        if silence >= self.params.comm_timeout - 1e-9:  # sums of cycle times are not exact
            self.stop_egm(f"EGM stopped: no message for {silence:.3f} s")

    def _refuse(self, reason: str) -> bool:
        self.rejected[reason] += 1
        return False


class _Reference:
    """Speed and position references behind the dead time, and the speed's low-pass.

    The filter's input is constant between references, so each piece is integrated exactly, also where a reference takes
    effect between two cycles.
    """

    def __init__(self, now: float, position: np.ndarray, params: ArmParams):
        self.target = position  # (6,) [rad]
        # When speed (6,) [rad/s] and target take effect.
        self.coming: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._decay = 2.0 * math.pi * params.low_pass
        self._time = now
        self._input: np.ndarray = np.zeros_like(position)
        self._filtered: np.ndarray = np.zeros_like(position)

    def at(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Filtered speed (6,) [rad/s] and position reference (6,) [rad] in force at ``now``."""
        while self.coming and self.coming[0][0] <= now:
            due, speed, target = self.coming.popleft()
            self._advance(due)
            self._input, self.target = speed, target
        self._advance(now)
        return self._filtered, self.target

    def _advance(self, time: float) -> None:
        self._filtered = self._input + (self._filtered - self._input) * math.exp(-self._decay * (time - self._time))
        self._time = time
