"""The log's topics: which record becomes which message, and back into numbers, for the joints of one robot.

Positions, joint states and events use Foxglove's protobuf schemas, so that viewers draw them as they are; the policy's
vectors and the ticks have two small schemas of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

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


def _define_messages() -> tuple[Any, Any]:
    """robot_log.Values and robot_log.Tick, in a pool of their own so that nothing else's names can clash."""
    kind = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name="robot_log.proto", package="robot_log", syntax="proto3", dependency=["google/protobuf/timestamp.proto"]
    )
    stamp = ("timestamp", kind.LABEL_OPTIONAL, kind.TYPE_MESSAGE)
    head = (stamp, ("tick", kind.LABEL_OPTIONAL, kind.TYPE_UINT64))
    messages = {
        "Values": (*head, ("values", kind.LABEL_REPEATED, kind.TYPE_DOUBLE)),
        "Tick": (*head, *((name, kind.LABEL_OPTIONAL, kind.TYPE_DOUBLE) for name in TIMINGS)),
    }
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, (key, label, type_) in enumerate(fields, start=1):
            message.field.add(name=key, number=number, label=label, type=type_)
        message.field[0].type_name = ".google.protobuf.Timestamp"
    pool = descriptor_pool.DescriptorPool()
    for known in (timestamp_pb2.DESCRIPTOR.serialized_pb, file.SerializeToString()):
        pool.AddSerializedFile(known)
    return tuple(message_factory.GetMessageClass(pool.FindMessageTypeByName(f"robot_log.{n}")) for n in messages)


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
    metadata: dict[str, str] = field(default_factory=dict)

    def schema(self) -> bytes:
        """The message's FileDescriptorSet, dependencies first, as MCAP wants protobuf schemas."""
        files = descriptor_pb2.FileDescriptorSet()
        seen: set[str] = set()

        def add(file: Any) -> None:
            if file.name not in seen:
                seen.add(file.name)
                for dependency in file.dependencies:
                    add(dependency)
                file.CopyToProto(files.file.add())

        add(self.message.DESCRIPTOR.file)
        return files.SerializeToString(deterministic=True)


@dataclass(frozen=True)
class Messages:
    """n messages in the order of the file.

    data          bytes in which they stand, after ``MARGIN`` others
    start, end    (n,) of each message's content in ``data``
    channel, sequence, log_time, publish_time  (n,); times in ns
    """

    data: np.ndarray
    start: np.ndarray
    end: np.ndarray
    channel: np.ndarray
    sequence: np.ndarray
    log_time: np.ndarray
    publish_time: np.ndarray

    def __len__(self) -> int:
        return self.start.size

    def content(self, i: int) -> bytes:
        return self.data[self.start[i] : self.end[i]].tobytes()


@dataclass(frozen=True, kw_only=True)
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
    write: Callable[[list[Any]], Any]
    read: Callable[[Any], list[float]]
    stamp: str = "time"
    sequence: str = "tick"

    def encode(self, record: Any) -> Any:
        """The message of a record, without its timestamp. Raises LogError for another number of joints."""
        parts = [getattr(record, name) for name in self.fields]
        if self.width > 1:
            for name, part in zip(self.fields, parts, strict=True):
                if len(part) != self.width:
                    kind = type(record).__name__
                    raise LogError(f"{kind}.{name} has {len(part)} numbers, expected {self.width} for this robot")
            parts = [part.tolist() for part in parts]
        message = self.write(parts)
        if self._has_tick:
            message.tick = record.tick
        return message

    def decode(self, batch: Messages, mine: np.ndarray) -> np.ndarray:
        """Numbers (fields * width, n) of the messages with indices ``mine`` (n,). Raises ValueError for others.

        Most messages end in the same bytes but for their numbers, and are read together. One in which a zero was left
        out, as proto3 does, or that somebody else wrote, is read by the protobuf library.
        """
        template, places = self._template
        start, end, data = batch.start[mine], batch.end[mine], batch.data
        rows = sliding_window_view(data, template.size)[end - template.size]
        # Before it stand the timestamp, whose second byte is its length, and the tick.
        size = 2 + data[np.minimum(start + 1, data.size - 1)].astype(np.int64) + template.size
        if self._has_tick:
            tick = batch.sequence[mine].astype(np.int64)
            size += np.where(tick > 0, 2, 0) + sum((tick >= 1 << bits).astype(int) for bits in range(7, 32, 7))
        constant = np.setdiff1d(np.arange(template.size), places)
        alike = (end - start == size) & (rows[:, constant] == template[constant]).all(axis=1)
        numbers = np.ascontiguousarray(rows[:, places.ravel()]).view("<f8")
        for i in np.flatnonzero(~alike):
            numbers[i] = self.read(self.message.FromString(batch.content(mine[i])))
        return np.ascontiguousarray(numbers.T)

    @cached_property
    def _has_tick(self) -> bool:
        return "tick" in self.message.DESCRIPTOR.fields_by_name

    @cached_property
    def _template(self) -> tuple[np.ndarray, np.ndarray]:
        """Bytes at the end of every message, and where among them its numbers stand (numbers, 8)."""
        numbers = np.arange(len(self.fields) * self.width) + math.pi
        parts = numbers.reshape(len(self.fields), -1).tolist()
        content = self.write(parts if self.width > 1 else [part[0] for part in parts]).SerializeToString()
        starts = np.array([content.index(number.tobytes()) for number in numbers])
        return np.frombuffer(content, np.uint8), starts[:, None] + np.arange(8)


def _write_point(parts: list[Any]) -> Any:
    return Point3InFrame(frame_id=FRAME, point=Point3(**dict(zip("xyz", parts[0], strict=True))))


def _write_joints(joints: tuple[str, ...], keys: tuple[str, ...], parts: list[Any]) -> Any:
    message = JointStates()
    for name, *numbers in zip(joints, *parts, strict=True):
        message.joints.add(name=name, **dict(zip(keys, numbers, strict=True)))
    return message


def _read_joints(joints: tuple[str, ...], keys: tuple[str, ...], message: Any) -> list[float]:
    found = tuple(joint.name for joint in message.joints)
    if found != joints:
        raise ValueError(f"joints are {found}, expected {joints}")
    return [getattr(joint, key) for key in keys for joint in message.joints]


def _read_values(count: int, message: Any) -> list[float]:
    if len(message.values) != count:
        raise ValueError(f"{len(message.values)} values, expected {count}")
    return list(message.values)


EVENT = Topic("/event", Log)


def topics(robot: Contract = PAPER) -> dict[str, Topic]:
    """The topics of a robot's log, by name."""
    joints, units, n = robot.joints, robot.units, robot.n_joints
    moved = {"position": " ".join(units), "velocity": " ".join(f"{unit}/s" for unit in units)}
    observed = {"names": " ".join(robot.observation_names), "units": " ".join(robot.observation_units)}
    acted = {"names": " ".join(joints), "units": "1"}

    def of_joints(name: str, record: type[Numbers], sequence: str = "tick", **fields: str) -> Topic:
        keys = tuple(fields)
        write, read = partial(_write_joints, joints, keys), partial(_read_joints, joints, keys)
        return NumbersTopic(
            name,
            JointStates,
            moved,
            record=record,
            fields=tuple(fields.values()),
            width=n,
            write=write,
            read=read,
            sequence=sequence,
        )

    def of_values(name: str, record: type[Numbers], width: int, metadata: dict[str, str]) -> Topic:
        write, read = lambda parts: Values(values=parts[0]), partial(_read_values, width)
        return NumbersTopic(
            name, Values, metadata, record=record, fields=("values",), width=width, write=write, read=read
        )

    found = (
        NumbersTopic(
            "/ball",
            Point3InFrame,
            {"frame": FRAME, "unit": "m"},
            record=Ball,
            fields=("position",),
            width=3,
            write=_write_point,
            read=lambda message: [message.point.x, message.point.y, message.point.z],
            stamp="capture_time",
            sequence="id",
        ),
        of_joints("/joint_states", Joints, "", position="position", velocity="velocity"),
        of_joints("/commands/requested", Command, velocity="requested"),
        of_joints("/commands/sent", Command, position="reference", velocity="sent"),
        of_values("/observation", Observation, robot.n_observation, observed),
        of_values("/action", Action, n, acted),
        NumbersTopic(
            "/tick",
            TickMessage,
            {"unit": "s"},
            record=Tick,
            fields=TIMINGS,
            width=1,
            write=lambda parts: TickMessage(**dict(zip(TIMINGS, parts, strict=True))),
            read=lambda message: [getattr(message, name) for name in TIMINGS],
        ),
        EVENT,
    )
    return {topic.name: topic for topic in found}


@dataclass(frozen=True, slots=True)
class Encoded:
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
            logged, stamp = getattr(record, topic.record.LOGGED), getattr(record, topic.stamp)
            sequence = getattr(record, topic.sequence) if topic.sequence else 0
            found.append(Encoded(topic, logged, stamp, sequence, topic.encode(record)))
    return found


def stamps(message: Any) -> list[Any]:
    """The timestamps that a message holds: its own, or one for each of its frames or entities."""
    fields = message.DESCRIPTOR.fields_by_name
    if "timestamp" in fields:
        return [message.timestamp]
    return [part.timestamp for name in ("transforms", "entities") if name in fields for part in getattr(message, name)]
