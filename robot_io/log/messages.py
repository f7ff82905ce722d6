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
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
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


class _Record:
    __slots__ = ()
    KIND: ClassVar[int]
    LOGGED: ClassVar[str] = "time"  # field that says when the control process had the record, where there is one

    @property
    def log_time(self) -> Any:
        return getattr(self, self.LOGGED, None)


class Numbers(_Record):
    """A record whose fields are all numbers."""

    __slots__ = ()

    def pack(self) -> bytes:
        """Raises LogError for arrays of other shapes than the fields have."""
        head, scalars, arrays = _layout(self.KIND)
        packed, alike = head.pack(self.KIND, *(getattr(self, name) for name in scalars)), None
        for name, length in arrays.items():
            values = np.asarray(getattr(self, name), "<f8")
            alike = alike or values.shape
            if len(alike) != 1 or values.shape != ((length,) if length else alike):
                wanted = f"({length},)" if length else alike if len(alike) == 1 else "one number for each joint"
                raise LogError(f"{type(self).__name__}.{name} has shape {values.shape}, expected {wanted}")
            packed += values.tobytes()
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        head, scalars, arrays = _layout(cls.KIND)
        values = dict(zip(scalars, head.unpack_from(data)[1:], strict=True))
        numbers = np.frombuffer(data, "<f8", offset=head.size)
        n = numbers.size // max(len(arrays), 1)
        if numbers.size != sum(length or n for length in arrays.values()):
            raise ValueError(f"{numbers.size} numbers in the arrays {', '.join(arrays)}")
        return cls(**values, **{name: numbers[i * n : (i + 1) * n] for i, name in enumerate(arrays)})


@cache
def _layout(kind: int) -> tuple[struct.Struct, list[str], dict[str, int]]:
    """The bytes before the arrays, the names of the scalars in them, and the arrays' lengths by name."""
    hints = get_type_hints(_KINDS[kind], include_extras=True)
    forms = {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}
    scalars = [name for name, form in forms.items() if isinstance(form, str)]
    head = struct.Struct("<B" + "".join(forms[name] for name in scalars))
    return head, scalars, {name: form for name, form in forms.items() if name not in scalars}


@dataclass(frozen=True, eq=False, slots=True)
class Ball(Numbers):
    """One sample of the ball's position.

    capture_time  [s] when the camera saw it
    received      [s] when it reached the control process
    position      (3,) [m] ball centre in the table frame
    id            number of the ball in play, as the tracker counts
    """

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

    tick: Count
    time: Float
    requested: Vector
    sent: Vector
    reference: Vector


@dataclass(frozen=True, eq=False, slots=True)
class Observation(Numbers):
    """The newest observation, ``values`` (3 + n,), that the policy was given in a control tick; SI, not normalised."""

    tick: Count
    time: Float
    values: Vector


@dataclass(frozen=True, eq=False, slots=True)
class Action(Numbers):
    """The policy's answer, ``values`` (n,), in one control tick, in [-1, 1]."""

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

    dropped: Count
    malformed: Count


@dataclass(frozen=True, slots=True)
class Event(_Record):
    """Something that happened: a change of state, a fault, what the operator did, an episode's ends.

    name  short and enumerated, such as "state", "fault", "operator", "episode_start"
    text  for people, or JSON where the name says so; cut at 3,900 bytes
    """

    time: float
    level: Level
    name: str
    text: str = ""

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
class Metadata(_Record):
    """Facts that hold from now on, such as a policy that was exchanged; values that are no strings are kept as JSON."""

    name: str
    entries: Mapping[str, Any] = field(default_factory=dict)

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
_KINDS = dict(enumerate(Record.__args__, start=1))
for _kind, _class in _KINDS.items():
    _class.KIND = _kind


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
