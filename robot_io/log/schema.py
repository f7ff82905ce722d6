"""The log's topics: which record becomes which message, and back into numbers, for the joints of one robot.

Positions, joint states and events use Foxglove's protobuf schemas, so that viewers draw them as they are; the policy's
vectors and the ticks have two small schemas of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point3InFrame_pb2 import Point3InFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

from robot_io.contract import PAPER, Contract
from robot_io.log.messages import Action, Ball, Command, Event, Joints, LogError, Observation, Tick

NANO = 1_000_000_000
FRAME = "table"
SEQUENCE = 1 << 32
TICK_FIELDS = ("lateness", "policy_seconds", "ball_age", "gantry_age", "arm_age")


def _own_messages() -> tuple[type, type]:
    """robot_log.Values and robot_log.Tick, in a pool of their own so that nothing else's names can clash."""
    field_type = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name="robot_log.proto", package="robot_log", syntax="proto3", dependency=["google/protobuf/timestamp.proto"]
    )
    fields = {
        "Values": [("values", field_type.LABEL_REPEATED)],
        "Tick": [(name, field_type.LABEL_OPTIONAL) for name in TICK_FIELDS],
    }
    for name, doubles in fields.items():
        message = file.message_type.add(name=name)
        message.field.add(
            name="timestamp",
            number=1,
            label=field_type.LABEL_OPTIONAL,
            type=field_type.TYPE_MESSAGE,
            type_name=".google.protobuf.Timestamp",
        )
        message.field.add(name="tick", number=2, label=field_type.LABEL_OPTIONAL, type=field_type.TYPE_UINT64)
        for number, (double, label) in enumerate(doubles, start=3):
            message.field.add(name=double, number=number, label=label, type=field_type.TYPE_DOUBLE)
    pool = descriptor_pool.DescriptorPool()
    timestamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    pool.Add(timestamp)
    pool.Add(file)
    return tuple(message_factory.GetMessageClass(pool.FindMessageTypeByName(f"robot_log.{n}")) for n in fields)


Values, TickMessage = _own_messages()


def _no_numbers(_: Any) -> list[float]:
    return []


@dataclass(frozen=True)
class Topic:
    """One channel of the file.

    name      MCAP topic
    message   protobuf class
    width     numbers that ``numbers`` gives per message; 0 for events, which hold none
    numbers   the message's numbers, or raises ValueError
    metadata  of the MCAP channel
    """

    name: str
    message: Any
    width: int = 0
    numbers: Callable[[Any], list[float]] = _no_numbers
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


def _point(message: Any) -> list[float]:
    return [message.point.x, message.point.y, message.point.z]


def _joints(joints: tuple[str, ...], *names: str) -> Callable[[Any], list[float]]:
    def numbers(message: Any) -> list[float]:
        found = tuple(joint.name for joint in message.joints)
        if found != joints:
            raise ValueError(f"joints are {found}, expected {joints}")
        return [getattr(joint, name) for name in names for joint in message.joints]

    return numbers


def _values(count: int) -> Callable[[Any], list[float]]:
    def numbers(message: Any) -> list[float]:
        if len(message.values) != count:
            raise ValueError(f"{len(message.values)} values, expected {count}")
        return list(message.values)

    return numbers


def _tick(message: Any) -> list[float]:
    return [getattr(message, name) for name in TICK_FIELDS]


BALL = Topic("/ball", Point3InFrame, 3, _point, {"frame": FRAME, "unit": "m"})
TICK = Topic("/tick", TickMessage, len(TICK_FIELDS), _tick, {"unit": "s"})
EVENT = Topic("/event", Log)
JOINT_STATES, REQUESTED, SENT = "/joint_states", "/commands/requested", "/commands/sent"
OBSERVATION, ACTION = "/observation", "/action"


def topics(robot: Contract = PAPER) -> dict[str, Topic]:
    """The topics of a robot's log, by name."""
    joints, units, n, seen = robot.joints, robot.units, robot.n_joints, robot.n_observation
    moved = {"position": " ".join(units), "velocity": " ".join(f"{unit}/s" for unit in units)}
    observed = {"names": " ".join(robot.observation_names), "units": " ".join(robot.observation_units)}
    found = (
        BALL,
        Topic(JOINT_STATES, JointStates, 2 * n, _joints(joints, "position", "velocity"), moved),
        Topic(REQUESTED, JointStates, n, _joints(joints, "velocity"), moved),
        Topic(SENT, JointStates, 2 * n, _joints(joints, "position", "velocity"), moved),
        Topic(OBSERVATION, Values, seen, _values(seen), observed),
        Topic(ACTION, Values, n, _values(n), {"names": " ".join(joints), "units": "1"}),
        TICK,
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


def stamps(message: Any) -> list[Any]:
    """The timestamps that a message holds: its own, or one for each of its frames or entities."""
    fields = message.DESCRIPTOR.fields_by_name
    if "timestamp" in fields:
        return [message.timestamp]
    return [part.timestamp for name in ("transforms", "entities") if name in fields for part in getattr(message, name)]


class Encoder:
    """Records of one robot into messages."""

    def __init__(self, robot: Contract = PAPER) -> None:
        self.topics = topics(robot)
        self._joints, self._seen = robot.joints, robot.n_observation

    def encode(self, record: Ball | Joints | Command | Observation | Action | Tick | Event) -> list[Encoded]:
        """The messages of a record; the caller stamps them with ``publish_time``.

        Raises LogError for a record of another number of joints than the robot has.
        """
        match record:
            case Ball():
                x, y, z = record.position.tolist()
                message = Point3InFrame(frame_id=FRAME)
                message.point.x, message.point.y, message.point.z = x, y, z
                return [Encoded(BALL, record.received, record.capture_time, record.id, message)]
            case Joints():
                message = self._joint_states(record.velocity, record.position)
                return [Encoded(self.topics[JOINT_STATES], record.log_time, record.time, 0, message)]
            case Command():
                requested, sent = (
                    self._joint_states(record.requested),
                    self._joint_states(record.sent, record.reference),
                )
                return [
                    Encoded(self.topics[topic], record.time, record.time, record.tick, message)
                    for topic, message in ((REQUESTED, requested), (SENT, sent))
                ]
            case Observation():
                message = Values(tick=record.tick, values=self._numbers(record.observation, self._seen))
                return [Encoded(self.topics[OBSERVATION], record.time, record.time, record.tick, message)]
            case Action():
                message = Values(tick=record.tick, values=self._numbers(record.action, len(self._joints)))
                return [Encoded(self.topics[ACTION], record.time, record.time, record.tick, message)]
            case Tick():
                message = TickMessage(tick=record.tick, **{name: getattr(record, name) for name in TICK_FIELDS})
                return [Encoded(TICK, record.time, record.time, record.tick, message)]
            case Event():
                message = Log(level=Log.Level.ValueType(record.level), name=record.name, message=record.text)
                return [Encoded(EVENT, record.time, record.time, 0, message)]
        raise TypeError(f"{type(record).__name__} is no record with messages")

    def _joint_states(self, velocity: Any, position: Any = None) -> Any:
        message, count = JointStates(), len(self._joints)
        positions = [None] * count if position is None else self._numbers(position, count)
        for name, p, v in zip(self._joints, positions, self._numbers(velocity, count), strict=True):
            message.joints.add(name=name, position=p, velocity=v)
        return message

    @staticmethod
    def _numbers(values: Any, count: int) -> list[float]:
        if len(values) != count:
            raise LogError(f"a record of {len(values)} numbers, the robot's have {count}")
        return values.tolist()
