"""The log's topics: which record becomes which message, and back into numbers, for the joints of one robot.

Positions, joint states and events use Foxglove's protobuf schemas, so that viewers draw them as they are; the policy's
vectors and the ticks have two small schemas of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from numpy.lib.stride_tricks import sliding_window_view

from robot_io.contract import PAPER, Contract
from robot_io.log.messages import Action, Ball, Command, Event, Joints, LogError, Numbers, Observation, Record, Tick

NANO = 1_000_000_000
FRAME = "table"
SEQUENCE = 1 << 32
MARGIN = 1 << 13  # bytes, more than a message of numbers has
TIMINGS = ("lateness", "policy_seconds", "ball_age", "gantry_age", "arm_age")
HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<i8"), ("publish_time", "<i8")])
TICK_BYTES = [1, 1, *(1 << bits for bits in range(7, 32, 7))]  # ticks from which the field ``tick`` has a byte more


def _define_messages() -> tuple[Any, Any]:
    """robot_log.Values and robot_log.Tick, in a pool of their own so that nothing else's names can clash."""
    kind = descriptor_pb2.FieldDescriptorProto
    name, stamp = "robot_log.proto", timestamp_pb2.DESCRIPTOR
    file = descriptor_pb2.FileDescriptorProto(name=name, package="robot_log", syntax="proto3", dependency=[stamp.name])
    for message, fields in (("Values", ("values",)), ("Tick", TIMINGS)):
        added = file.message_type.add(name=message)
        for number, key in enumerate(("timestamp", "tick", *fields), start=1):
            label = kind.LABEL_REPEATED if key == "values" else kind.LABEL_OPTIONAL
            added.field.add(name=key, number=number, label=label, type=kind.TYPE_DOUBLE)
        added.field[0].type, added.field[0].type_name = kind.TYPE_MESSAGE, ".google.protobuf.Timestamp"
        added.field[1].type = kind.TYPE_UINT64
    pool = descriptor_pool.DescriptorPool()
    for serialized in (stamp.serialized_pb, file.SerializeToString()):
        pool.AddSerializedFile(serialized)
    classes = message_factory.GetMessageClassesForFiles([name], pool)
    return classes["robot_log.Values"], classes["robot_log.Tick"]


Values, TickMessage = _define_messages()


@dataclass(frozen=True)
class Topic:
    """One channel of the file.

    name      MCAP topic
    message   protobuf class
    metadata  of the MCAP channel
    """

    name: str
    message: Any
    metadata: dict[str, str]

    def schema(self) -> bytes:
        """The message's FileDescriptorSet, dependencies first, as MCAP wants protobuf schemas."""
        files: dict[str, Any] = {}

        def add(file: Any) -> None:
            for dependency in file.dependencies:
                add(dependency)
            files.setdefault(file.name, descriptor_pb2.FileDescriptorProto.FromString(file.serialized_pb))

        add(self.message.DESCRIPTOR.file)
        return descriptor_pb2.FileDescriptorSet(file=files.values()).SerializeToString(deterministic=True)


class Messages(NamedTuple):
    """n messages in the order of the file.

    data        bytes in which they stand, after ``MARGIN`` others
    start, end  (n,) of each message's content in ``data``
    head        (n,) of HEAD, what stands before each; times in ns
    """

    data: np.ndarray
    start: np.ndarray
    end: np.ndarray
    head: np.ndarray

    def content(self, i: int) -> bytes:
        return self.data[self.start[i] : self.end[i]].tobytes()


@dataclass(frozen=True)
class NumbersTopic(Topic):
    """A topic with numbers of one kind of record.

    record        its class
    fields        what the message holds of it
    width         numbers of a field that is an array, 1 for scalars
    write, read   the message, without timestamp and tick, of the fields' numbers, and back
    stamp         field that is the publish time; the log time is ``record.LOGGED``
    sequence      field that is the sequence number, "" for none
    """

    record: type[Numbers]
    fields: tuple[str, ...]
    width: int
    write: Callable[..., Any]
    read: Callable[[Any], list[float]]
    stamp: str = "time"
    sequence: str = "tick"

    def encode(self, record: Any) -> Any:
        """The message of a record, without its timestamp. Raises LogError for another number of joints."""
        parts = [np.asarray(getattr(record, name)) for name in self.fields]
        for name, part in zip(self.fields, parts, strict=True):
            if part.size != self.width:
                kind = type(record).__name__
                raise LogError(f"{kind}.{name} has {part.size} numbers, expected {self.width} for this robot")
        message = self.write(*(part.tolist() for part in parts))
        if self._has_tick:
            message.tick = record.tick
        return message

    def decode(self, batch: Messages, mine: np.ndarray) -> np.ndarray:
        """Numbers (*shape, n) of the messages with indices ``mine`` (n,). Raises ValueError for others.

        Most messages end in the same bytes but for their numbers, and are read together. One in which a zero was left
        out, as proto3 does, or that somebody else wrote, is read by the protobuf library.
        """
        template, places = self._template
        start, end, data = batch.start[mine], batch.end[mine], batch.data
        rows = sliding_window_view(data, template.size)[end - template.size]
        # Before it stand the timestamp, whose second byte is its length, and the tick.
        size = 2 + data[np.minimum(start + 1, data.size - 1)].astype(np.int64) + template.size
        if self._has_tick:
            size += np.searchsorted(TICK_BYTES, batch.head["sequence"][mine], "right")
        constant = np.setdiff1d(np.arange(template.size), places)
        alike = (end - start == size) & (rows[:, constant] == template[constant]).all(axis=1)
        numbers = np.ascontiguousarray(rows[:, places.ravel()]).view("<f8")
        for i in np.flatnonzero(~alike):
            numbers[i] = self.read(self.message.FromString(batch.content(mine[i])))
        return np.ascontiguousarray(numbers.T).reshape(*self.shape, -1)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one message's numbers."""
        return (len(self.fields), self.width) if self.width > 1 else (len(self.fields),)

    @cached_property
    def _has_tick(self) -> bool:
        return "tick" in self.message.DESCRIPTOR.fields_by_name

    @cached_property
    def _template(self) -> tuple[np.ndarray, np.ndarray]:
        """Bytes at the end of every message, and where among them its numbers stand (numbers, 8)."""
        numbers = np.arange(len(self.fields) * self.width) + math.pi
        content = self.write(*numbers.reshape(self.shape).tolist()).SerializeToString()
        starts = np.array([content.index(number.tobytes()) for number in numbers])
        return np.frombuffer(content, np.uint8), starts[:, None] + np.arange(8)


EVENT = Topic("/event", Log, {})


def topics(robot: Contract = PAPER) -> dict[str, Topic]:
    """The topics of a robot's log, by name."""
    joints, units = robot.joints, robot.units
    moved = {"position": " ".join(units), "velocity": " ".join(f"{unit}/s" for unit in units)}

    def of_joints(name: str, record: type[Numbers], sequence: str = "tick", **fields: str) -> Topic:
        def write(*parts: list[float]) -> Any:
            message = JointStates()
            for name, *numbers in zip(joints, *parts, strict=True):
                message.joints.add(name=name, **dict(zip(fields, numbers, strict=True)))
            return message

        def read(message: Any) -> list[float]:
            found = tuple(joint.name for joint in message.joints)
            if found != joints:
                raise ValueError(f"joints are {found}, expected {joints}")
            return [getattr(joint, key) for key in fields for joint in message.joints]

        kept, width = tuple(fields.values()), len(joints)
        return NumbersTopic(name, JointStates, moved, record, kept, width, write, read, sequence=sequence)

    def of_values(name: str, record: type[Numbers], names: tuple[str, ...], units: tuple[str, ...]) -> Topic:
        def read(message: Any) -> list[float]:
            if len(message.values) != len(names):
                raise ValueError(f"{len(message.values)} values, expected {len(names)}")
            return list(message.values)

        described = {"names": " ".join(names), "units": " ".join(units)}
        return NumbersTopic(
            name, Values, described, record, ("values",), len(names), lambda numbers: Values(values=numbers), read
        )

    def write_ball(xyz: list[float]) -> Any:
        return Point3InFrame(frame_id=FRAME, point=Point3(**dict(zip("xyz", xyz, strict=True))))

    def read_ball(message: Any) -> list[float]:
        return [message.point.x, message.point.y, message.point.z]

    def write_tick(*timings: float) -> Any:
        return TickMessage(**dict(zip(TIMINGS, timings, strict=True)))

    def read_tick(message: Any) -> list[float]:
        return [getattr(message, name) for name in TIMINGS]

    where = {"frame": FRAME, "unit": "m"}
    found = (
        NumbersTopic(
            "/ball", Point3InFrame, where, Ball, ("position",), 3, write_ball, read_ball, "capture_time", "id"
        ),
        of_joints("/joint_states", Joints, "", position="position", velocity="velocity"),
        of_joints("/commands/requested", Command, velocity="requested"),
        of_joints("/commands/sent", Command, position="reference", velocity="sent"),
        of_values("/observation", Observation, robot.observation_names, robot.observation_units),
        of_values("/action", Action, joints, ("1",)),
        NumbersTopic("/tick", TickMessage, {"unit": "s"}, Tick, TIMINGS, 1, write_tick, read_tick),
        EVENT,
    )
    return {topic.name: topic for topic in found}


class Encoded(NamedTuple):
    """A message ready for MCAP; times in seconds of the control process's clock."""

    topic: Topic
    log_time: float
    publish_time: float
    sequence: int
    message: Any  # without its timestamp


def encode(record: Record, topics: dict[str, Topic]) -> list[Encoded]:
    """The messages of a record; the writer stamps them with ``publish_time``.

    Raises LogError for a record of another number of joints than the topics' robot has.
    """
    if isinstance(record, Event):
        message = Log(level=Log.Level.ValueType(record.level), name=record.name, message=record.text)
        return [Encoded(EVENT, record.time, record.time, 0, message)]
    found = []
    for topic in topics.values():
        if isinstance(topic, NumbersTopic) and type(record) is topic.record:
            sequence = getattr(record, topic.sequence) if topic.sequence else 0
            found.append(Encoded(topic, record.log_time, getattr(record, topic.stamp), sequence, topic.encode(record)))
    return found


def stamps(message: Any) -> list[Any]:
    """The timestamps that a message holds: its own, or one for each of its frames or entities."""
    fields = message.DESCRIPTOR.fields_by_name
    if "timestamp" in fields:
        return [message.timestamp]
    return [part.timestamp for name in ("transforms", "entities") if name in fields for part in getattr(message, name)]
