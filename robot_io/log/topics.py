"""The log's topics: which record becomes which message, and back into numbers, for the joints of one robot.

Positions, joint states and events use Foxglove's protobuf schemas, so that viewers draw them as they are; the policy's
vectors and the ticks have two small schemas of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from robot_io.contract import PAPER, Contract
from robot_io.log.messages import Action, Ball, Command, Event, Joints, LogError, Numbers, Observation, Record, Tick
from robot_io.log.wire import Wire

NANO = 1_000_000_000
FRAME = "table"
SEQUENCE = 1 << 32
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


@dataclass(frozen=True, kw_only=True)
class NumbersTopic(Topic):
    """A topic with numbers of one kind of record.

    record    its class
    fields    what the message holds of it, in the order of the message's numbers
    width     numbers of a field that is an array, 1 for scalars
    stamp     field that is the publish time; the log time is ``record.LOGGED``
    sequence  field that is the sequence number, "" for none
    """

    record: type[Numbers]
    fields: tuple[str, ...]
    width: int
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
        return self._encode(record, parts)

    def decode(self, wire: Wire) -> np.ndarray:
        """Numbers (fields * width, n) of n messages. Raises WireError for one that is another robot's or damaged."""
        wire.skip_block(_number(self.message, "timestamp"))  # it is the publish time
        numbers = self._decode(wire)
        wire.finish()
        return numbers

    def _encode(self, record: Any, parts: list[Any]) -> Any:
        raise NotImplementedError

    def _decode(self, wire: Wire) -> np.ndarray:
        raise NotImplementedError


class PointTopic(NumbersTopic):
    """A field of three numbers as a point in the table's frame."""

    def _encode(self, record: Any, parts: list[Any]) -> Any:
        return Point3InFrame(frame_id=FRAME, point=Point3(**dict(zip("xyz", parts[0], strict=True))))

    def _decode(self, wire: Wire) -> np.ndarray:
        wire.expect_text(_number(Point3InFrame, "frame_id"), FRAME)
        wire.enter(_number(Point3InFrame, "point"))
        return np.stack([wire.double(_number(Point3, axis)) for axis in "xyz"])


@dataclass(frozen=True, kw_only=True)
class JointsTopic(NumbersTopic):
    """Fields with a number for each joint. ``keys``: their names in JointState."""

    joints: tuple[str, ...]
    keys: tuple[str, ...]

    def _encode(self, record: Any, parts: list[Any]) -> Any:
        message = JointStates()
        for name, *numbers in zip(self.joints, *parts, strict=True):
            message.joints.add(name=name, **dict(zip(self.keys, numbers, strict=True)))
        return message

    def _decode(self, wire: Wire) -> np.ndarray:
        joints = []
        for name in self.joints:
            wire.enter(_number(JointStates, "joints"))
            wire.expect_text(_number(JointState, "name"), name)
            joints.append([wire.double(_number(JointState, key)) for key in self.keys])
        return np.stack([columns[k] for k in range(len(self.keys)) for columns in joints])


class ValuesTopic(NumbersTopic):
    """A tick's vector."""

    def _encode(self, record: Any, parts: list[Any]) -> Any:
        return Values(tick=record.tick, values=parts[0])

    def _decode(self, wire: Wire) -> np.ndarray:
        wire.skip_varint(_number(Values, "tick"))
        return wire.doubles(_number(Values, "values"), self.width)


class TickTopic(NumbersTopic):
    """A tick's timings."""

    def _encode(self, record: Any, parts: list[Any]) -> Any:
        return TickMessage(tick=record.tick, **dict(zip(self.fields, parts, strict=True)))

    def _decode(self, wire: Wire) -> np.ndarray:
        wire.skip_varint(_number(TickMessage, "tick"))
        return np.stack([wire.double(_number(TickMessage, name)) for name in self.fields])


def _number(message: Any, name: str) -> int:
    return message.DESCRIPTOR.fields_by_name[name].number


EVENT = Topic("/event", Log)


def topics(robot: Contract = PAPER) -> dict[str, Topic]:
    """The topics of a robot's log, by name."""
    joints, units, n = robot.joints, robot.units, robot.n_joints
    moved = {"position": " ".join(units), "velocity": " ".join(f"{unit}/s" for unit in units)}
    observed = {"names": " ".join(robot.observation_names), "units": " ".join(robot.observation_units)}
    acted = {"names": " ".join(joints), "units": "1"}

    def by_joint(name: str, record: type[Numbers], sequence: str = "tick", **keys: str) -> JointsTopic:
        fields = tuple(keys.values())
        return JointsTopic(
            name,
            JointStates,
            moved,
            record=record,
            fields=fields,
            width=n,
            sequence=sequence,
            joints=joints,
            keys=tuple(keys),
        )

    def vector(name: str, record: type[Numbers], width: int, metadata: dict[str, str]) -> ValuesTopic:
        return ValuesTopic(name, Values, metadata, record=record, fields=("values",), width=width)

    found = (
        PointTopic(
            "/ball",
            Point3InFrame,
            {"frame": FRAME, "unit": "m"},
            record=Ball,
            fields=("position",),
            width=3,
            stamp="capture_time",
            sequence="id",
        ),
        by_joint("/joint_states", Joints, "", position="position", velocity="velocity"),
        by_joint("/commands/requested", Command, velocity="requested"),
        by_joint("/commands/sent", Command, position="reference", velocity="sent"),
        vector("/observation", Observation, robot.n_observation, observed),
        vector("/action", Action, n, acted),
        TickTopic("/tick", TickMessage, {"unit": "s"}, record=Tick, fields=TIMINGS, width=1),
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
            stamp, sequence = getattr(record, topic.stamp), getattr(record, topic.sequence) if topic.sequence else 0
            found.append(Encoded(topic, record.log_time, stamp, sequence, topic.encode(record)))
    return found


def stamps(message: Any) -> list[Any]:
    """The timestamps that a message holds: its own, or one for each of its frames or entities."""
    fields = message.DESCRIPTOR.fields_by_name
    if "timestamp" in fields:
        return [message.timestamp]
    return [part.timestamp for name in ("transforms", "entities") if name in fields for part in getattr(message, name)]
