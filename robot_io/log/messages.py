"""Records of a session's log, and the form in which they travel from the control thread to the recorder process.

All times are seconds of the control process's monotonic clock. Measurements carry two: the time at which they were true
and the time at which the control process had them; the two are never mixed.

A class here is the whole description of a record: packing, the log's topics (``robot_io.log.topics``) and the arrays
that a log is read back into follow from its fields. Read back, a record holds all moments at once: every field has one
more axis, the last.

Packed, a record is one kind byte, its scalars in their order, and its arrays, little endian without padding. The
length says how many joints there are. A packed record has at most LARGEST bytes, so that a pipe takes a frame whole or
not at all.
"""

from __future__ import annotations

import enum
import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Self, get_type_hints

import numpy as np

LARGEST = 4094  # bytes: PIPE_BUF of Linux, less the two of a frame's length
_CUT = " [cut]"
_LONGEST_TEXT = 3900  # bytes of UTF-8 of an event's text
_ALIKE = 0  # length of an array with one number for each of the robot's joints, or of its observation's components

# Types of fields: ``struct`` formats of scalars, lengths of arrays.
Float = Annotated[Any, "d"]
Count = Annotated[Any, "Q"]
Number = Annotated[Any, "I"]
Point = Annotated[Any, 3]
Vector = Annotated[Any, _ALIKE]


class LogError(ValueError):
    """A log cannot be written or read: the message names file or record, what is wrong and what to do."""


class Level(enum.IntEnum):
    """Severity of an event; the numbers are those of foxglove.Log."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class Numbers:
    """A record whose fields are all numbers.

    LOGGED  the field that says when the control process had the record
    """

    __slots__ = ()
    KIND: ClassVar[int]
    LOGGED: ClassVar[str] = "time"

    @property
    def log_time(self) -> Any:
        return getattr(self, self.LOGGED)

    def pack(self) -> bytes:
        """Raises LogError for arrays of other shapes than the fields have."""
        layout = _layout(self.KIND)
        packed, alike = layout.head.pack(self.KIND, *layout.scalars(self)), None
        for name, length in layout.arrays:
            values = np.asarray(getattr(self, name), "<f8")
            alike = alike or values.shape
            if len(alike) != 1 or values.shape != ((length,) if length else alike):
                wanted = f"({length},)" if length else alike if len(alike) == 1 else "one number for each joint"
                raise LogError(f"{type(self).__name__}.{name} has shape {values.shape}, expected {wanted}")
            packed += values.tobytes()
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        layout = _layout(cls.KIND)
        _, *scalars = layout.head.unpack_from(data)
        fields: dict[str, Any] = dict(zip(layout.names, scalars, strict=True))
        size, parts = len(data) - layout.head.size, len(layout.arrays)
        length = (layout.arrays[0][1] or size // (8 * parts)) if parts else 0
        if size != 8 * parts * length:
            raise ValueError(f"expected {layout.head.size + 8 * parts * max(length, 1)} bytes")
        numbers = np.frombuffer(data, "<f8", offset=layout.head.size) if parts else np.empty(0)
        for i, (name, _) in enumerate(layout.arrays):
            fields[name] = numbers[i * length : (i + 1) * length]
        return cls(**fields)


@dataclass(frozen=True, slots=True)
class _Layout:
    head: struct.Struct
    names: tuple[str, ...]
    scalars: Callable[[Any], tuple]
    arrays: tuple[tuple[str, int], ...]


@cache
def _layout(kind: int) -> _Layout:
    hints = get_type_hints(_KINDS[kind], include_extras=True)
    fields = {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}
    names = tuple(name for name, form in fields.items() if isinstance(form, str))
    arrays = tuple((name, form) for name, form in fields.items() if not isinstance(form, str))
    return _Layout(struct.Struct("<B" + "".join(fields[name] for name in names)), names, attrgetter(*names), arrays)


@dataclass(frozen=True, eq=False, slots=True)
class Ball(Numbers):
    """One sample of the ball's position.

    capture_time  [s] when the camera saw it
    received      [s] when it reached the control process
    position      (3,) [m] ball centre in the table frame
    id            number of the ball in play, as the tracker counts
    """

    KIND: ClassVar[int] = 1
    LOGGED: ClassVar[str] = "received"
    capture_time: Float
    received: Float
    position: Point
    id: Number = 0


@dataclass(frozen=True, eq=False, slots=True)
class Joints(Numbers):
    """Measured joint state in the order of the robot's contract.

    time      [s] when it was true
    position  (n,) [m], [rad]
    velocity  (n,) [m/s], [rad/s]
    received  [s] when it reached the control process; ``time`` if left out
    """

    KIND: ClassVar[int] = 2
    LOGGED: ClassVar[str] = "received"
    time: Float
    position: Vector
    velocity: Vector
    received: Float = None

    def __post_init__(self) -> None:
        if self.received is None:
            object.__setattr__(self, "received", self.time)


@dataclass(frozen=True, eq=False, slots=True)
class Command(Numbers):
    """Velocity that the policy asked for and that which went to the robot in one control tick.

    requested  (n,) joint velocity asked for [m/s], [rad/s]
    sent       (n,) joint velocity commanded, after the limiter
    reference  (n,) commanded joint position at ``time``, from which ``sent`` goes on [m], [rad]
    """

    KIND: ClassVar[int] = 3
    tick: Count
    time: Float
    requested: Vector
    sent: Vector
    reference: Vector


@dataclass(frozen=True, eq=False, slots=True)
class Observation(Numbers):
    """The newest observation, ``values`` (3 + n,), that the policy was given in a control tick; SI, not normalised."""

    KIND: ClassVar[int] = 4
    tick: Count
    time: Float
    values: Vector


@dataclass(frozen=True, eq=False, slots=True)
class Action(Numbers):
    """The policy's answer, ``values`` (n,), in one control tick, in [-1, 1]."""

    KIND: ClassVar[int] = 5
    tick: Count
    time: Float
    values: Vector


@dataclass(frozen=True, eq=False, slots=True)
class Tick(Numbers):
    """Timing of one control tick; all in seconds, an age is infinite while nothing has come.

    time            when the tick began
    lateness        by which it began after its deadline
    policy_seconds  spent in the policy
    ball_age        since the capture of the newest ball sample
    gantry_age      since the newest state of the linear axes
    arm_age         since the newest state of the arm
    """

    KIND: ClassVar[int] = 6
    tick: Count
    time: Float
    lateness: Float
    policy_seconds: Float
    ball_age: Float = math.inf
    gantry_age: Float = math.inf
    arm_age: Float = math.inf


@dataclass(frozen=True, eq=False, slots=True)
class End(Numbers):
    """The last record of a session that was closed properly: how many records were lost on the way, and why."""

    KIND: ClassVar[int] = 9
    dropped: Count
    malformed: Count

    @property
    def log_time(self) -> None:
        return None


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
            raise LogError(f"event name {self.name!r}: expected 1 to 100 bytes; put details into the text")
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


Record = Ball | Joints | Command | Observation | Action | Tick | Event | Metadata | End

_EVENT = struct.Struct("<BdBB")
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
