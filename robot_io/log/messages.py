"""Records of a session's log, and the form in which they travel from the control thread to the recorder process.

All times are seconds of the control process's monotonic clock. A record's ``log_time`` says when the control process
had it: measurements also carry the time at which they were true, and the two are never mixed.

Packed, a record is one kind byte and its fields, little endian without padding; arrays are float64. ``unpack`` is the
inverse; its length says how many joints there are. A packed record has at most LARGEST bytes, so that a pipe takes a
frame whole or not at all.
"""

from __future__ import annotations

import enum
import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

LARGEST = 4094  # bytes: PIPE_BUF of Linux, less the two of a frame's length
_CUT = " [cut]"
_LONGEST_TEXT = 3900  # bytes of UTF-8 of an event's text


class LogError(ValueError):
    """A log cannot be written or read: the message names file or record, what is wrong and what to do."""


class Level(enum.IntEnum):
    """Severity of an event; the numbers are those of foxglove.Log."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


@dataclass(frozen=True, eq=False, slots=True)
class Ball:
    """One sample of the ball's position.

    capture_time  [s] when the camera saw it
    received      [s] when it reached the control process
    position      (3,) [m] ball centre in the table frame
    id            number of the ball in play, as the tracker counts
    """

    KIND: ClassVar[int] = 1
    capture_time: float
    received: float
    position: np.ndarray
    id: int = 0

    @property
    def log_time(self) -> float:
        return self.received

    def pack(self) -> bytes:
        return _BALL.pack(self.KIND, self.capture_time, self.received, self.id) + _array(self, "position", 3)

    @classmethod
    def unpack(cls, data: bytes) -> Ball:
        _, capture_time, received, id = _BALL.unpack_from(data)
        return cls(capture_time, received, _arrays(data, _BALL.size, 3)[0], id)


@dataclass(frozen=True, eq=False, slots=True)
class Joints:
    """Measured joint state in the order of the robot's contract.

    time      [s] when it was true
    position  (n,) [m], [rad]
    velocity  (n,) [m/s], [rad/s]
    received  [s] when it reached the control process; ``time`` if left out
    """

    KIND: ClassVar[int] = 2
    time: float
    position: np.ndarray
    velocity: np.ndarray
    received: float | None = None

    @property
    def log_time(self) -> float:
        return self.time if self.received is None else self.received

    def pack(self) -> bytes:
        head = _TWO_TIMES.pack(self.KIND, self.time, self.log_time)
        return head + _alike(self, "position", "velocity")

    @classmethod
    def unpack(cls, data: bytes) -> Joints:
        _, time, received = _TWO_TIMES.unpack_from(data)
        position, velocity = _parts(data, _TWO_TIMES.size, 2)
        return cls(time, position, velocity, received)


@dataclass(frozen=True, eq=False, slots=True)
class Command:
    """Velocity that the policy asked for and that which went to the robot in one control tick.

    requested  (n,) joint velocity asked for [m/s], [rad/s]
    sent       (n,) joint velocity commanded, after the limiter
    reference  (n,) commanded joint position at ``time``, from which ``sent`` goes on [m], [rad]
    """

    KIND: ClassVar[int] = 3
    tick: int
    time: float
    requested: np.ndarray
    sent: np.ndarray
    reference: np.ndarray

    @property
    def log_time(self) -> float:
        return self.time

    def pack(self) -> bytes:
        return _TICKED.pack(self.KIND, self.tick, self.time) + _alike(self, "requested", "sent", "reference")

    @classmethod
    def unpack(cls, data: bytes) -> Command:
        _, tick, time = _TICKED.unpack_from(data)
        return cls(tick, time, *_parts(data, _TICKED.size, 3))


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """The newest observation (3 + n,) that the policy was given in one control tick, SI units, not normalised."""

    KIND: ClassVar[int] = 4
    tick: int
    time: float
    observation: np.ndarray

    @property
    def log_time(self) -> float:
        return self.time

    def pack(self) -> bytes:
        return _TICKED.pack(self.KIND, self.tick, self.time) + _alike(self, "observation")

    @classmethod
    def unpack(cls, data: bytes) -> Observation:
        _, tick, time = _TICKED.unpack_from(data)
        return cls(tick, time, *_parts(data, _TICKED.size, 1))


@dataclass(frozen=True, eq=False, slots=True)
class Action:
    """The policy's answer (n,) in one control tick, in [-1, 1]."""

    KIND: ClassVar[int] = 5
    tick: int
    time: float
    action: np.ndarray

    @property
    def log_time(self) -> float:
        return self.time

    def pack(self) -> bytes:
        return _TICKED.pack(self.KIND, self.tick, self.time) + _alike(self, "action")

    @classmethod
    def unpack(cls, data: bytes) -> Action:
        _, tick, time = _TICKED.unpack_from(data)
        return cls(tick, time, *_parts(data, _TICKED.size, 1))


@dataclass(frozen=True, eq=False, slots=True)
class Tick:
    """Timing of one control tick; all in seconds, an age is infinite while nothing has come.

    time            when the tick began
    lateness        by which it began after its deadline
    policy_seconds  spent in the policy
    ball_age        since the capture of the newest ball sample
    gantry_age      since the newest state of the linear axes
    arm_age         since the newest state of the arm
    """

    KIND: ClassVar[int] = 6
    tick: int
    time: float
    lateness: float
    policy_seconds: float
    ball_age: float = float("inf")
    gantry_age: float = float("inf")
    arm_age: float = float("inf")

    @property
    def log_time(self) -> float:
        return self.time

    def pack(self) -> bytes:
        return _TICK.pack(
            self.KIND,
            self.tick,
            self.time,
            self.lateness,
            self.policy_seconds,
            self.ball_age,
            self.gantry_age,
            self.arm_age,
        )

    @classmethod
    def unpack(cls, data: bytes) -> Tick:
        return cls(*_TICK.unpack(data)[1:])


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened: a change of state, a fault, what the operator did, an episode's ends.

    name  short and enumerated, such as "state", "fault", "operator", "episode_start"
    text  for people, or JSON where the name says so; cut at 3,900 bytes
    """

    KIND: ClassVar[int] = 7
    time: float
    level: Level
    name: str
    text: str = ""

    @property
    def log_time(self) -> float:
        return self.time

    def pack(self) -> bytes:
        name, text = self.name.encode(), self.text.encode()
        if not 0 < len(name) <= 100:
            raise LogError(f"event name {self.name!r}: 1 to 100 bytes are needed, put details into the text")
        if len(text) > _LONGEST_TEXT:
            text = text[:_LONGEST_TEXT].decode(errors="ignore").encode() + _CUT.encode()
        return _EVENT.pack(self.KIND, self.time, Level(self.level), len(name)) + name + text

    @classmethod
    def unpack(cls, data: bytes) -> Event:
        _, time, level, length = _EVENT.unpack_from(data)
        text = _EVENT.size + length
        return cls(time, Level(level), data[_EVENT.size : text].decode(), data[text:].decode())


@dataclass(frozen=True, slots=True)
class Metadata:
    """Facts that hold from now on, such as a policy that was exchanged; values that are no strings are kept as JSON."""

    KIND: ClassVar[int] = 8
    name: str
    entries: Mapping[str, Any] = field(default_factory=dict)

    @property
    def log_time(self) -> None:
        return None

    def pack(self) -> bytes:
        data = bytes([self.KIND]) + json.dumps([self.name, as_strings(self.entries)]).encode()
        if len(data) > LARGEST:
            raise LogError(f"metadata {self.name!r}: {len(data)} bytes, at most {LARGEST} fit; attach it at the start")
        return data

    @classmethod
    def unpack(cls, data: bytes) -> Metadata:
        return cls(*json.loads(data[1:]))


@dataclass(frozen=True, slots=True)
class End:
    """The last record of a session that was closed properly: how many records were lost on the way, and why."""

    KIND: ClassVar[int] = 9
    dropped: int
    malformed: int

    @property
    def log_time(self) -> None:
        return None

    def pack(self) -> bytes:
        return _END.pack(self.KIND, self.dropped, self.malformed)

    @classmethod
    def unpack(cls, data: bytes) -> End:
        return cls(*_END.unpack(data)[1:])


Record = Ball | Joints | Command | Observation | Action | Tick | Event | Metadata | End

_BALL = struct.Struct("<BddI")
_TWO_TIMES = struct.Struct("<Bdd")
_TICKED = struct.Struct("<BQd")
_TICK = struct.Struct("<BQd5d")
_EVENT = struct.Struct("<BdBB")
_END = struct.Struct("<BQQ")
_KINDS = {kind.KIND: kind for kind in (Ball, Joints, Command, Observation, Action, Tick, Event, Metadata, End)}


def unpack(data: bytes) -> Record:
    """The record that ``pack`` made. Raises LogError for bytes that are none."""
    kind = _KINDS.get(data[0]) if data else None
    if kind is None:
        raise LogError(f"record of unknown kind {data[:1]!r}, known are {sorted(_KINDS)}")
    try:
        return kind.unpack(data)
    except (struct.error, ValueError, TypeError) as error:
        raise LogError(f"{kind.__name__} of {len(data)} bytes cannot be unpacked: {error}") from error


def episode_start(time: float, episode: int, **details: Any) -> Event:
    """Event of an episode's start; ``details`` as for ``json_text``."""
    return Event(time, Level.INFO, "episode_start", json_text({"episode": episode, **details}))


def episode_end(time: float, episode: int, outcome: str, reward: Mapping[str, float], **details: Any) -> Event:
    """The event of an episode's end: ``outcome`` is a short enumerated name, ``reward`` its terms by name."""
    terms = {name: float(value) for name, value in reward.items()}
    return Event(
        time, Level.INFO, "episode_end", json_text({"episode": episode, "outcome": outcome, "reward": terms, **details})
    )


def as_strings(entries: Mapping[str, Any]) -> dict[str, str]:
    """Metadata entries as MCAP keeps them. Raises LogError for a value that is no JSON data."""
    strings = {}
    for key, value in entries.items():
        try:
            strings[str(key)] = value if isinstance(value, str) else json.dumps(value, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise LogError(f"metadata {key!r}: {value!r} is no string and no JSON data ({error})") from None
    return strings


def json_text(value: Any) -> str:
    """JSON of any value without raising: numbers that are not finite become null, unknown types their repr."""
    try:
        return json.dumps(_finite(value), allow_nan=False, default=repr)
    except (TypeError, ValueError, RecursionError):  # keys of other types, circles
        return json.dumps(repr(value))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value


def _array(record: Record, name: str, length: int) -> bytes:
    values = np.asarray(getattr(record, name), "<f8")
    if values.shape != (length,):
        raise LogError(f"{type(record).__name__}.{name} has shape {values.shape}, expected ({length},)")
    return values.tobytes()


def _alike(record: Record, first: str, *others: str) -> bytes:
    """Arrays as long as the first one, which is as long as the robot has joints."""
    shape = np.shape(getattr(record, first))
    if len(shape) != 1:
        raise LogError(f"{type(record).__name__}.{first} has shape {shape}, expected one number for each joint")
    return b"".join(_array(record, name, shape[0]) for name in (first, *others))


def _parts(data: bytes, offset: int, count: int) -> list[np.ndarray]:
    """Arrays of one length, ``count`` of them, that ``_alike`` packed."""
    length = (len(data) - offset) // (8 * count)
    return _arrays(data, offset, *[length] * count)


def _arrays(data: bytes, offset: int, *lengths: int) -> list[np.ndarray]:
    if len(data) != offset + 8 * sum(lengths):
        raise ValueError(f"{offset + 8 * sum(lengths)} bytes are needed")
    ends = np.cumsum(lengths)[:-1]
    return np.split(np.frombuffer(data, "<f8", offset=offset), ends)
