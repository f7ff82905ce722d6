"""A log back as NumPy arrays."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Attachment, Metadata

from robot_io.contract import Contract
from robot_io.log.messages import Action, Ball, Command, Event, Joints, Level, LogError, Observation, Tick
from robot_io.log.scan import Fault, Scan
from robot_io.log.topics import EVENT, NANO, Messages, NumbersTopic, Topic, topics
from robot_io.log.writer import FORMAT, FORMAT_VERSION, parts, robot_of

PIECE = 200_000  # messages of one piece of ``stream``: some five minutes


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
    ball, joints, commands, observations, actions, ticks
                 every field of the records as an array, whose last axis is the record: times (n,), vectors (joints, n)
    faults       what is wrong with the file; always empty unless it was read with ``salvage``
    """

    path: Path
    robot: Contract
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    ball: Ball
    joints: Joints
    commands: Command
    observations: Observation
    actions: Action
    ticks: Tick
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
            elif event.name == "discard" and (number := json.loads(event.text)["episode"]) in found:
                found[number].details["discarded"] = True
        return tuple(found.values())


def read(path: str | os.PathLike, salvage: bool = False) -> SessionLog:
    """Reads one file of a log into memory; every checksum is checked.

    With ``salvage`` a damaged or unfinished file gives what is sound of it, and ``faults`` says what is not. Without,
    it is an error that says where the file is damaged and how much can be had.

    Raises LogError for such files, files that are no session log, and messages that break the format
    (docs/reference/log-format.md); OSError when the file cannot be read.
    """
    (session,) = _pieces(path, salvage, None)
    return session


def stream(path: str | os.PathLike, salvage: bool = False, most: int = PIECE) -> Iterator[SessionLog]:
    """Reads a log piece by piece, for sessions that do not fit into memory: each has about ``most`` messages.

    Files that follow ``path`` in a long session (``writer.parts``) are read as well.

    Pieces follow each other without gaps or overlap, and there is at least one. An episode may begin in one piece and
    end in another. The last piece has all metadata, attachments and faults. Raises as ``read``: damage is found where
    it is, after the pieces before it, or, where only the whole file's checksum shows it, before the last piece.
    """
    for part in parts(path):
        yield from _pieces(part, salvage, most)


def _pieces(path: str | os.PathLike, salvage: bool, most: int | None) -> Iterator[SessionLog]:
    scan = Scan(path)
    metadata: dict[str, dict[str, str]] = {}
    attachments: dict[str, bytes] = {}
    columns: _Columns | None = None
    last = count = 0
    for part in scan:
        if isinstance(part, Metadata):
            metadata[part.name] = part.metadata
        elif isinstance(part, Attachment):
            attachments[part.name] = part.data
        else:
            last = max(last, int(part.log_time.max()))
            columns = columns or _Columns(scan, metadata.get("session", {}))
            columns.add(part)
            if scan.faults and not salvage and most is not None:
                break
            if most is not None and scan.messages - count >= most:
                _check_format(path, metadata)
                count = scan.messages
                yield columns.take(metadata, attachments)
    session = metadata.get("session", {})
    if scan.faults and not salvage:
        raise LogError(_explain(scan, last, session))
    _check_format(path, metadata)
    yield (columns or _Columns(scan, session)).take(metadata, attachments)


class _Columns:
    """Messages of a log as they come, as arrays by topic."""

    def __init__(self, scan: Scan, session: dict[str, str]) -> None:
        self._scan = scan
        self._robot = robot_of(session, str(scan.path))
        self._offset = int(session.get("clock_offset_ns", 0))
        self._topics = topics(self._robot)
        self._channels: dict[int, Topic | None] = {}
        self._events: list[Event] = []
        # By topic: log times, publish times, sequence numbers, numbers (width, n).
        self._columns: dict[str, list[tuple[np.ndarray, ...]]] = {name: [] for name in self._topics}

    def add(self, batch: Messages) -> None:
        """Raises LogError for a message that is not as its topic's are."""
        for channel in np.unique(batch.channel).tolist():
            topic = self._topic(channel)
            if topic is None:  # a topic of a later version, or its declaration was lost
                continue
            mine = np.flatnonzero(batch.channel == channel)
            try:
                if topic is EVENT:
                    self._events += [self._event(batch, i) for i in mine.tolist()]
                elif isinstance(topic, NumbersTopic):
                    numbers = topic.decode(batch, mine)
                    heads = (batch.log_time[mine], batch.publish_time[mine], batch.sequence[mine].astype(np.int64))
                    self._columns[topic.name].append((*heads, numbers))
            except (DecodeError, ValueError) as error:
                last = self._scan.messages
                where = f"messages {last - len(batch) + 1} to {last} of the file"
                raise LogError(f"{self._scan.path}: {where}, on {topic.name}: {error}") from None

    def take(self, metadata: dict[str, dict[str, str]], attachments: dict[str, bytes]) -> SessionLog:
        """What came so far, and forgets it."""
        events, self._events = tuple(self._events), []
        return SessionLog(
            self._scan.path,
            self._robot,
            dict(metadata),
            dict(attachments),
            ball=self._series(Ball),
            joints=self._series(Joints),
            commands=self._series(Command),
            observations=self._series(Observation),
            actions=self._series(Action),
            ticks=self._series(Tick),
            events=events,
            faults=tuple(self._scan.faults),
        )

    def _series(self, record: Any) -> Any:
        """Every field of a kind of record."""
        mine = [t for t in self._topics.values() if isinstance(t, NumbersTopic) and t.record is record]
        parts = [self._arrays(topic) for topic in mine]
        if len(parts) > 1:
            # A record's two messages: one of them may be lost with a damaged chunk, or be still to come.
            _, *shared = np.intersect1d(parts[0][2], parts[1][2], return_indices=True)
            for topic, part, kept in zip(mine, parts, shared, strict=True):
                left = slice(kept.max(initial=-1) + 1, None)
                self._columns[topic.name] = [tuple(column[..., left] for column in part)]
            parts = [tuple(column[..., kept] for column in part) for part, kept in zip(parts, shared, strict=True)]
        values: dict[str, np.ndarray] = {}
        for topic, (logged, published, sequence, numbers) in zip(mine, parts, strict=True):
            for i, name in enumerate(topic.fields):
                values[name] = numbers[i * topic.width : (i + 1) * topic.width]
                if topic.width == 1:
                    values[name] = values[name][0]
            values |= {record.LOGGED: self._seconds(logged), topic.stamp: self._seconds(published)}
            if topic.sequence:
                values[topic.sequence] = sequence
        return record(**values)

    def _arrays(self, topic: NumbersTopic) -> tuple[np.ndarray, ...]:
        columns, self._columns[topic.name] = self._columns[topic.name], []
        if not columns:
            nothing = np.empty(0, np.int64)
            return nothing, nothing, nothing, np.empty((len(topic.fields) * topic.width, 0))
        return tuple(np.concatenate(parts, axis=-1) for parts in zip(*columns, strict=True))

    def _seconds(self, times: np.ndarray) -> np.ndarray:
        return (times - self._offset) / NANO

    def _event(self, batch: Messages, i: int) -> Event:
        message = EVENT.message.FromString(batch.content(i))
        time = (int(batch.publish_time[i]) - self._offset) / NANO
        return Event(time, Level(message.level), message.name, message.message)

    def _topic(self, channel: int) -> Topic | None:
        if channel not in self._channels and channel in self._scan.channels:
            declared = self._scan.channels[channel]
            topic = self._channels[channel] = self._topics.get(declared.topic)
            schema = self._scan.schemas.get(declared.schema_id)
            found = schema.name if schema else None
            if topic is not None and (declared.message_encoding, found) != (
                "protobuf",
                topic.message.DESCRIPTOR.full_name,
            ):
                raise LogError(
                    f"{self._scan.path}: {topic.name} holds {found!r} in {declared.message_encoding!r}, expected "
                    f"{topic.message.DESCRIPTOR.full_name!r} in 'protobuf'; see docs/reference/log-format.md"
                )
        return self._channels.get(channel)


def _check_format(path: str | os.PathLike, metadata: dict[str, dict[str, str]]) -> None:
    session = metadata.get("session", {})
    if session.get("format") != FORMAT or session.get("format_version") != str(FORMAT_VERSION):
        found = f"{session.get('format')!r} version {session.get('format_version')!r}"
        raise LogError(f"{path}: format is {found}, expected {FORMAT!r} version '{FORMAT_VERSION}'")


def _explain(scan: Scan, last: int, session: dict[str, str]) -> str:
    places = "; ".join(map(str, scan.faults[:3])) + ("; ..." if len(scan.faults) > 3 else "")
    state = "damaged" if scan.complete else "not finished"
    if not scan.messages or "clock_offset_ns" not in session:
        return f"{scan.path}: {state} ({places}); {scan.messages} messages of it are sound"
    span = (last - int(session["clock_offset_ns"])) / NANO - float(session["start_time"])
    return (
        f"{scan.path}: {state} ({places}); {scan.messages} messages of the first {span:.2f} s can be had: "
        f"mjx-tt log salvage {scan.path}"
    )
