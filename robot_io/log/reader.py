"""A log back as NumPy arrays."""

from __future__ import annotations

import json
import os
from array import array
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from robot_io.contract import Contract
from robot_io.log import schema
from robot_io.log.messages import Event, Level, LogError
from robot_io.log.scan import Fault, Scan
from robot_io.log.schema import NANO, Topic
from robot_io.log.writer import FORMAT, FORMAT_VERSION, robot_of


@dataclass(frozen=True)
class BallSeries:
    """capture_time, received (n,) [s]; position (3, n) [m] in the table frame; id (n,) number of the ball in play."""

    capture_time: np.ndarray
    received: np.ndarray
    position: np.ndarray
    id: np.ndarray


@dataclass(frozen=True)
class JointSeries:
    """time, received (n,) [s]; position (joints, n) [m], [rad]; velocity (joints, n)."""

    time: np.ndarray
    received: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True)
class CommandSeries:
    """tick (n,); time (n,) [s]; requested, sent (joints, n) velocities; reference (joints, n) commanded position."""

    tick: np.ndarray
    time: np.ndarray
    requested: np.ndarray
    sent: np.ndarray
    reference: np.ndarray


@dataclass(frozen=True)
class PolicySeries:
    """tick (n,); time (n,) [s]; values (3 + joints, n) observations or (joints, n) actions."""

    tick: np.ndarray
    time: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class TickSeries:
    """tick (n,); time, lateness, policy_seconds and the devices' ages, each (n,) [s]."""

    tick: np.ndarray
    time: np.ndarray
    lateness: np.ndarray
    policy_seconds: np.ndarray
    ball_age: np.ndarray
    gantry_age: np.ndarray
    arm_age: np.ndarray


@dataclass(frozen=True)
class Episode:
    """One episode; ``end``, ``outcome`` and ``reward`` are None, "" and empty where the log ends before it does.

    details  everything that the two events say
    """

    number: int
    start: float
    end: float | None
    outcome: str
    reward: dict[str, float]
    details: dict[str, Any]


@dataclass(frozen=True)
class SessionLog:
    """A session as it was recorded; times are seconds of the control process's monotonic clock.

    robot        its contract
    metadata     MCAP metadata records by name; "session" is always there, "end" if the recorder finished the file
    attachments  files kept with the session
    faults       what is wrong with the file; always empty unless it was read with ``salvage``
    """

    path: Path
    robot: Contract
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    ball: BallSeries
    joints: JointSeries
    commands: CommandSeries
    observations: PolicySeries
    actions: PolicySeries
    ticks: TickSeries
    events: tuple[Event, ...]
    faults: tuple[Fault, ...]

    @property
    def name(self) -> str:
        return self.metadata["session"]["name"]

    @property
    def start_time(self) -> float:
        """[s] when the session began."""
        return float(self.metadata["session"]["start_time"])

    @property
    def dropped(self) -> int | None:
        """Records that the recorder lost; None where the control process died before it could say."""
        text = self.metadata.get("end", {}).get("dropped", "unknown")
        return int(text) if text.isdigit() else None

    def utc(self, time: float) -> datetime:
        """Date and time of a moment of the control process's clock."""
        return datetime.fromtimestamp(time + int(self.metadata["session"]["clock_offset_ns"]) / NANO, UTC)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Episodes in the order of their starts, put together from the events."""
        found: dict[int, Episode] = {}
        for event in self.events:
            if event.name == "episode_start":
                details = json.loads(event.text)
                found[details["episode"]] = Episode(details["episode"], event.time, None, "", {}, details)
            elif event.name == "episode_end":
                details = json.loads(event.text)
                number = details["episode"]
                start = found[number].start if number in found else self.start_time
                before = found[number].details if number in found else {}
                found[number] = Episode(
                    number, start, event.time, details["outcome"], details["reward"], before | details
                )
        return tuple(found.values())


class _Column:
    """Numbers of one topic as they come, compactly."""

    def __init__(self, topic: Topic) -> None:
        self._topic = topic
        self._logged, self._published, self._sequence = array("q"), array("q"), array("q")
        self._numbers = array("d")

    def add(self, record: Message, message: Any) -> None:
        self._numbers.extend(self._topic.numbers(message))
        self._logged.append(record.log_time)
        self._published.append(record.publish_time)
        self._sequence.append(record.sequence)

    def arrays(self, clock_offset_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Published and logged times (n,) [s], sequence numbers (n,), numbers (width, n)."""
        logged, published = (
            (np.array(times, np.int64) - clock_offset_ns) / NANO for times in (self._logged, self._published)
        )
        numbers = np.array(self._numbers, np.float64).reshape(-1, self._topic.width)
        return published, logged, np.array(self._sequence, np.int64), np.ascontiguousarray(numbers.T)


def read(path: str | os.PathLike, salvage: bool = False) -> SessionLog:
    """Reads a whole log; every checksum is checked.

    With ``salvage`` a damaged or unfinished file gives what is sound of it, and ``faults`` says what is not. Without,
    it is an error that says where the file is damaged and how much can be had.

    Raises LogError for such files, files that are no session log, and messages that break the format
    (docs/reference/log-format.md); OSError when the file cannot be read.
    """
    scan = Scan(path)
    topics: dict[str, Topic] = {}  # of the robot that the metadata of the session names, which stand before messages
    columns: dict[str, _Column] = {}
    events: list[tuple[int, Event]] = []
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    schemas: dict[int, str] = {}
    declared: dict[int, Channel] = {}
    channels: dict[int, Topic | None] = {}
    count, last = 0, 0
    for record in scan:
        if isinstance(record, Message):
            count, last = count + 1, max(last, record.log_time)
            if not topics:
                topics = schema.topics(robot_of(metadata.get("session", {}), str(path)))
                columns = {name: _Column(topic) for name, topic in topics.items() if topic.width}
            if record.channel_id not in channels and record.channel_id in declared:
                channels[record.channel_id] = _topic(path, declared[record.channel_id], schemas, topics)
            topic = channels.get(record.channel_id)
            if topic is None:  # a topic of a later version, or its declaration was lost
                continue
            try:
                message = topic.message.FromString(record.data)
                if topic is schema.EVENT:
                    events.append((record.publish_time, _event(message)))
                else:
                    columns[topic.name].add(record, message)
            except (DecodeError, ValueError) as error:
                raise LogError(f"{path}: message {count} of the file, on {topic.name}: {error}") from None
        elif isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            declared[record.id] = record
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            attachments[record.name] = record.data
    session = metadata.get("session", {})
    if scan.faults and not salvage:
        raise LogError(_explain(scan, count, last, session))
    if session.get("format") != FORMAT or session.get("format_version") != str(FORMAT_VERSION):
        found = f"{session.get('format')!r} version {session.get('format_version')!r}"
        raise LogError(f"{path}: format is {found}, expected {FORMAT!r} version '{FORMAT_VERSION}'")
    robot = robot_of(session, str(path))
    columns = columns or {name: _Column(topic) for name, topic in schema.topics(robot).items() if topic.width}
    return _assemble(scan, robot, metadata, attachments, columns, events)


def _assemble(
    scan: Scan,
    robot: Contract,
    metadata: dict[str, dict[str, str]],
    attachments: dict[str, bytes],
    columns: dict[str, _Column],
    events: list[tuple[int, Event]],
) -> SessionLog:
    offset, n = int(metadata["session"]["clock_offset_ns"]), robot.n_joints
    arrays = {name: column.arrays(offset) for name, column in columns.items()}
    captured, received, ids, positions = arrays[schema.BALL.name]
    time, joints_received, _, joints = arrays[schema.JOINT_STATES]
    _, _, requested_ticks, requested = arrays[schema.REQUESTED]
    sent_time, _, sent_ticks, sent = arrays[schema.SENT]
    # One of the two messages may be lost with a damaged chunk.
    ticks, i, j = np.intersect1d(requested_ticks, sent_ticks, return_indices=True)
    tick_time, _, tick, tick_numbers = arrays[schema.TICK.name]
    return SessionLog(
        path=scan.path,
        robot=robot,
        metadata=metadata,
        attachments=attachments,
        ball=BallSeries(captured, received, positions, ids),
        joints=JointSeries(time, joints_received, joints[:n], joints[n:]),
        commands=CommandSeries(ticks, sent_time[j], requested[:, i], sent[n:, j], sent[:n, j]),
        observations=_policy(arrays[schema.OBSERVATION]),
        actions=_policy(arrays[schema.ACTION]),
        ticks=TickSeries(tick, tick_time, *tick_numbers),
        events=tuple(Event((stamp - offset) / NANO, event.level, event.name, event.text) for stamp, event in events),
        faults=tuple(scan.faults),
    )


def _policy(arrays: tuple[np.ndarray, ...]) -> PolicySeries:
    time, _, tick, values = arrays
    return PolicySeries(tick, time, values)


def _event(message: Any) -> Event:
    return Event(0.0, Level(message.level), message.name, message.message)


def _topic(
    path: str | os.PathLike, channel: Channel, schemas: dict[int, str], topics: dict[str, Topic]
) -> Topic | None:
    topic = topics.get(channel.topic)
    if topic is not None:
        expected = topic.message.DESCRIPTOR.full_name
        found = schemas.get(channel.schema_id)
        if channel.message_encoding != "protobuf" or found != expected:
            raise LogError(
                f"{path}: {channel.topic} holds {found!r} in {channel.message_encoding!r}, expected {expected!r} in "
                "'protobuf'; see docs/reference/log-format.md"
            )
    return topic


def _explain(scan: Scan, count: int, last: int, session: dict[str, str]) -> str:
    places = "; ".join(map(str, scan.faults[:3])) + ("; ..." if len(scan.faults) > 3 else "")
    state = "damaged" if scan.complete else "not finished"
    if not count or "clock_offset_ns" not in session:
        return f"{scan.path}: {state} ({places}); {count} messages of it are sound"
    span = (last - int(session["clock_offset_ns"])) / NANO - float(session["start_time"])
    return (
        f"{scan.path}: {state} ({places}); {count} messages of the first {span:.2f} s can be had: "
        f"mjx-tt log salvage {scan.path}"
    )
