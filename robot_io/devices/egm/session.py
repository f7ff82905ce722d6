"""The computer's end of ABB EGM: the protocol, without socket or clock.

The controller sends its state every 4 ms and afterwards takes ONE queued message; with none queued it goes on with the
last one, speed included, until its own communication timeout. Hence: read everything that is queued, answer only the
newest packet, and answer it once. Nothing here can stop an arm whose computer has died; only the controller's
``\\CommTimeout`` does (RAPID, EGMSetupUC): commissioning sets it to 0.05..0.1 s in place of the default of about 1 s.
"""

from __future__ import annotations

import ipaddress
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from robot_io.contract import ABB_JOINTS
from robot_io.devices.egm.messages import UINT32, ArmFeedback, EgmError, decode_robot, encode_sensor

DEFAULT_PORT = 6510
RECENT = 1.0  # [s] of controller time: a packet that much older or newer than the last is no neighbour of it


@dataclass(frozen=True)
class EgmConfig:
    """Settings of an EGM session.

    controller_address  IPv4 address that packets are taken from; None takes that of the first valid packet. The port is
                        learned from the first valid packet, and again after a silence of ``timeout``
    controller_port     port that packets are taken from; None learns it. Two senders at once are then a problem
    period              the controller's cycle [s]
    timeout             age [s] at which feedback is stale: ``problem`` says so, and the next packet opens a new session
    ramp_in             [s] of a new session in which the arm is not armed: the controller's RampInTime, in which it
                        does not follow fully yet, and half a second more
    zeros               (6,) [rad] added to every position that comes, and taken from every one that goes; as many as
                        the arm has joints
    """

    controller_address: str | None = None
    controller_port: int | None = None
    period: float = 0.004
    timeout: float = 0.05
    ramp_in: float = 1.5
    zeros: tuple[float, ...] = (0.0,) * len(ABB_JOINTS)

    def __post_init__(self) -> None:
        if self.controller_address is not None:
            try:
                ipaddress.IPv4Address(self.controller_address)
            except ValueError:
                raise ValueError(
                    f"controller_address {self.controller_address!r} is no IPv4 address such as 192.168.125.1; "
                    "give the controller's address as a number"
                ) from None
        if not 0 < self.period < self.timeout < RECENT:
            raise ValueError(
                f"period {self.period} s and timeout {self.timeout} s must satisfy 0 < period < timeout < {RECENT} s"
            )


@dataclass
class EgmStatistics:
    """Counters since the session object was made.

    received  datagrams given to ``receive``: accepted plus rejected
    rejected  by reason: stranger, duplicate, out_of_order or an ``EgmError.reason``
    lost      packets that had not arrived when a later one of the same session did
    replies   EgmSensor messages built
    """

    received: int = 0
    accepted: int = 0
    rejected: Counter = field(default_factory=Counter)
    lost: int = 0
    replies: int = 0


class EgmSession:
    """One controller's EGM stream: what to believe of it and what to answer.

    feedback    ``ArmFeedback`` or None before the first packet
    session_id  0 before the first packet; grows when the controller starts anew, changes state or was silent for
                ``timeout``: the owner then takes the measured position as its new reference
    endpoint    (address, port) that replies go to, None before the first packet
    """

    def __init__(self, config: EgmConfig = EgmConfig()):
        self.config = config
        self.feedback: ArmFeedback | None = None
        self.session_id = 0
        self.endpoint: tuple[str, int] | None = None
        self.statistics = EgmStatistics()
        self._zeros = np.array(config.zeros)
        self._began = -np.inf  # [s] of the newest session
        self._pending = False
        self._reply_sequence = 0
        self._last_refusal = ""
        self._rival: tuple[int, float] | None = None  # another port that sends valid packets, and when it did last

    def receive(self, datagram: bytes, source: tuple[str, int], now: float) -> bool:
        """Takes one datagram; True when it is the trusted controller's newest packet. No content makes it raise."""
        self.statistics.received += 1
        if not self._trusts(source, now):
            self._note_rival(datagram, source, now)
            address, port = self._trusted
            trusted = address if port is None or source[0] != address else f"{address} port {port}"
            return self._refuse("stranger", f"from {source[0]} port {source[1]}, only {trusted} is trusted")
        try:
            message = decode_robot(datagram, len(self._zeros))
        except EgmError as error:
            return self._refuse(error.reason, str(error))
        last, new_session = self.feedback, True
        if last is not None:
            steps, elapsed_ms = message.sequence - last.sequence, round(1000.0 * (message.time - last.time))
            order = _order(steps, elapsed_ms, now - last.received, self.config)
            if order in ("duplicate", "out_of_order"):
                return self._refuse(order, f"sequence {message.sequence} after {last.sequence}")
            states = ("motors_on", "egm_running", "rapid_running")
            new_session = order == "new" or any(getattr(message, s) != getattr(last, s) for s in states)
            if order == "next":
                self.statistics.lost += steps % UINT32 - 1
        self.session_id += new_session
        self._began = now if new_session else self._began
        self.endpoint = (source[0], source[1])
        position = message.position + self._zeros
        position.flags.writeable = False
        self.feedback = replace(message, position=position, received=now)
        self._pending = True
        self.statistics.accepted += 1
        return True

    def reply(self, position: ArrayLike, velocity: ArrayLike, now: float) -> bytes | None:
        """The answer to the newest packet: position (6,) [rad] and velocity (6,) [rad/s] to move at.

        To hold, pass the held position and zeros. Returns None when no packet waits for an answer, or when one has
        waited for ``timeout``. Raises ValueError on another shape or a non-finite number; the packet then still waits.
        """
        if not self._pending:
            return None
        wire = np.asarray(position, float)
        if wire.shape == self._zeros.shape:
            wire = wire - self._zeros
        datagram = encode_sensor(self._reply_sequence, int(now * 1000.0), wire, velocity)
        self._pending = False
        if self._is_stale(now):
            return None
        self._reply_sequence = (self._reply_sequence + 1) % UINT32
        self.statistics.replies += 1
        return datagram

    def problem(self, now: float) -> str | None:
        """Reason why the arm cannot be moved, as a sentence that says what to do; None when it can."""
        feedback = self.feedback
        if feedback is None:
            return (
                "No EGM packet has arrived from the arm's controller: start its RAPID program, and check that its "
                f"UCdevice has this computer's address and port{self._refusals()}."
            )
        if self._is_stale(now):
            return (
                f"No EGM packet from the arm's controller for {now - feedback.received:.3f} s (limit "
                f"{self.config.timeout:.3f} s): check its emergency stop, the cable, and whether the EGM session has "
                f"ended there{self._refusals()}."
            )
        if self._rival is not None and now - self._rival[1] < RECENT:
            return (
                f"EGM packets come from ports {self.endpoint[1] if self.endpoint else 0} and {self._rival[0]} of the "
                "controller's address: end the wrong sender, or name the right port as arm.controller_port."
            )
        if not feedback.motors_on:
            return "The arm's motors are off: release the emergency stop and switch the motors on at the controller."
        if not feedback.rapid_running:
            return "The arm's RAPID program is stopped: start it at the controller."
        if not feedback.egm_running:
            return "EGM is not running on the arm's controller: let its RAPID program reach EGMRunJoint."
        return None

    def ramping(self, now: float) -> str | None:
        """Reason why the arm does not follow commands fully yet, as a sentence; None: it does."""
        left = self._began + self.config.ramp_in - now
        return f"EGM has just begun, and ramps commands in: wait {left:.1f} s." if left > 0.0 else None

    def _note_rival(self, datagram: bytes, source: tuple[str, int], now: float) -> None:
        """Remember a second sender at the controller's address: which of the two is the arm cannot be known."""
        if self.config.controller_port is not None or self.endpoint is None or source[0] != self.endpoint[0]:
            return
        try:
            decode_robot(datagram)
        except EgmError:
            return
        self._rival = (source[1], now)

    @property
    def _trusted(self) -> tuple[str | None, int | None]:
        """Address and port of the controller as configured, else as learned; None: any."""
        address, port = self.endpoint or (None, None)
        return self.config.controller_address or address, self.config.controller_port or port

    def _trusts(self, source: tuple[str, int], now: float) -> bool:
        address, port = self._trusted
        learns = self.config.controller_port is None and self._is_stale(now)
        return address in (None, source[0]) and (learns or port in (None, source[1]))

    def _is_stale(self, now: float) -> bool:
        return self.feedback is None or now - self.feedback.received > self.config.timeout

    def _refuse(self, reason: str, sentence: str) -> bool:
        self.statistics.rejected[reason] += 1
        self._last_refusal = f"{reason}: {sentence}"
        return False

    def _refusals(self) -> str:
        count = self.statistics.rejected.total()
        return f"; {count} datagrams were refused, the last as {self._last_refusal}" if count else ""


def _order(sequence_change: int, time_change: int, silence: float, config: EgmConfig) -> str:
    """Place of a packet after the last accepted one: "next", "new" (session), "duplicate" or "out_of_order".

    sequence_change  difference of the sequence numbers, taken modulo 2**32
    time_change      difference of the controller's clock [ms], taken modulo 2**32
    silence          seconds since the last accepted packet

    The controller's clock goes on when EGM starts again and the numbers begin at 0. So a packet with an earlier time
    was overtaken, whatever its number, and a lower number with a later time is a new session. Only a clock that stands
    still (some simulators) leaves the decision to the numbers alone.
    """
    steps, elapsed = _signed(sequence_change), _signed(time_change) / 1000.0
    if steps == 0 and elapsed == 0:
        return "duplicate"
    near = elapsed > -RECENT if elapsed else steps * config.period > -RECENT
    if (elapsed, steps) < (0, 0) and near and silence < RECENT:
        return "out_of_order"
    neighbour = 0 < steps < RECENT / config.period and 0 <= elapsed < RECENT
    return "next" if neighbour and silence <= config.timeout else "new"


def _signed(difference: int) -> int:
    return (difference + UINT32 // 2) % UINT32 - UINT32 // 2
