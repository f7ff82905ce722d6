"""A log back as NumPy arrays."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from robot_io.contract import Contract
from robot_io.log.messages import Action, Ball, Command, Event, Joints, Level, LogError, Observation, Tick
from robot_io.log.scan import Fault, Scan
from robot_io.log.topics import EVENT, HEAD, NANO, Messages, NumbersTopic, topics
from robot_io.log.writer import FORMAT, FORMAT_VERSION, parts, robot_of

SERIES = dict(ball=Ball, joints=Joints, commands=Command, observations=Observation, actions=Action, ticks=Tick)
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
            if event.name not in ("episode_start", "episode_end", "discard"):
                continue
            details = json.loads(event.text)
            number = details["episode"]
            if event.name == "episode_start":
                found[number] = Episode(number, event.time, None, "", {}, details)
            elif event.name == "episode_end":
                begun = found.get(number, Episode(number, self.start_time, None, "", {}, {}))
                outcome, reward, details = details["outcome"], details["reward"], begun.details | details
                found[number] = replace(begun, end=event.time, outcome=outcome, reward=reward, details=details)
            elif number in found:
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
    scan, taken = Scan(path), 0
    columns: _Columns | None = None
    for part in scan:
        if isinstance(part, Messages):
            columns = columns or _Columns(scan)
            columns.add(part)
            if most is None:
                continue
            if scan.faults and not salvage:
                break
            if scan.messages - taken >= most:
                _check_format(scan)
                taken = scan.messages
                yield columns.take()
    if scan.faults and not salvage:
        raise LogError(_explain(scan))
    _check_format(scan)
    yield (columns or _Columns(scan)).take()


class _Columns:
    """Messages of a log as they come, as arrays by topic."""

    def __init__(self, scan: Scan) -> None:
        session = scan.metadata.get("session", {})
        self._scan = scan
        self._robot = robot_of(session, str(scan.path))
        self._offset = int(session.get("clock_offset_ns", 0))
        self._topics = topics(self._robot)
        self._events: list[Event] = []
        self._columns: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in self._topics}

    def add(self, batch: Messages) -> None:
        """Raises LogError for a message that is not as its topic's are."""
        scan = self._scan
        for channel in np.unique(batch.head["channel"]).tolist():
            declared = scan.channels.get(channel)
            topic = self._topics.get(declared.topic) if declared else None
            if declared is None or topic is None:  # a topic of a later version, or its declaration was lost
                continue
            encoding, schema = declared.message_encoding, scan.schemas.get(declared.schema_id)
            found, wanted = schema and schema.name, topic.message.DESCRIPTOR.full_name
            if (encoding, found) != ("protobuf", wanted):
                raise LogError(
                    f"{scan.path}: {topic.name} holds {found!r} in {encoding!r}, expected {wanted!r} in 'protobuf'; "
                    "see docs/reference/log-format.md"
                )
            mine = np.flatnonzero(batch.head["channel"] == channel)
            try:
                if isinstance(topic, NumbersTopic):
                    self._columns[topic.name].append((batch.head[mine], topic.decode(batch, mine)))
                else:
                    self._events += [self._event(batch, i) for i in mine.tolist()]
            except (DecodeError, ValueError) as error:
                where = f"messages {scan.messages - len(batch.head) + 1} to {scan.messages} of the file"
                raise LogError(f"{scan.path}: {where}, on {topic.name}: {error}") from None

    def take(self) -> SessionLog:
        """What came so far, and forgets it."""
        events, self._events = tuple(self._events), []
        return SessionLog(
            self._scan.path,
            self._robot,
            dict(self._scan.metadata),
            dict(self._scan.attachments),
            **{name: self._series(record) for name, record in SERIES.items()},
            events=events,
            faults=tuple(self._scan.faults),
        )

    def _series(self, record: Any) -> Any:
        """Every field of a kind of record."""
        mine = [t for t in self._topics.values() if isinstance(t, NumbersTopic) and t.record is record]
        parts = []
        for topic in mine:
            nothing = np.empty(0, HEAD), np.empty((*topic.shape, 0))
            heads, numbers = zip(nothing, *self._columns[topic.name], strict=True)
            parts.append((np.concatenate(heads), np.concatenate(numbers, axis=-1)))
            self._columns[topic.name] = []
        if len(parts) > 1:
            # A record's two messages: one of them may be lost with a damaged chunk, or be still to come.
            _, *shared = np.intersect1d(parts[0][0]["sequence"], parts[1][0]["sequence"], return_indices=True)
            for i, (topic, (heads, numbers), kept) in enumerate(zip(mine, parts, shared, strict=True)):
                left = kept.max(initial=-1) + 1
                self._columns[topic.name] = [(heads[left:], numbers[..., left:])]
                parts[i] = heads[kept], numbers[..., kept]
        values: dict[str, np.ndarray] = {}
        for topic, (heads, numbers) in zip(mine, parts, strict=True):
            values |= dict(zip(topic.fields, numbers, strict=True))
            for name, key in ((record.LOGGED, "log_time"), (topic.stamp, "publish_time")):
                values[name] = (heads[key] - self._offset) / NANO
            if topic.sequence:
                values[topic.sequence] = heads["sequence"].astype(np.int64)
        return record(**values)

    def _event(self, batch: Messages, i: int) -> Event:
        message = EVENT.message.FromString(batch.content(i))
        time = (int(batch.head["publish_time"][i]) - self._offset) / NANO
        return Event(time, Level(message.level), message.name, message.message)


def _check_format(scan: Scan) -> None:
    session = scan.metadata.get("session", {})
    if session.get("format") != FORMAT or session.get("format_version") != str(FORMAT_VERSION):
        found = f"{session.get('format')!r} version {session.get('format_version')!r}"
        raise LogError(f"{scan.path}: format is {found}, expected {FORMAT!r} version '{FORMAT_VERSION}'")


def _explain(scan: Scan) -> str:
    places = "; ".join(map(str, scan.faults[:3])) + ("; ..." if len(scan.faults) > 3 else "")
    state, messages = "damaged" if scan.complete else "not finished", scan.messages
    session = scan.metadata.get("session", {})
    if scan.last is None or "clock_offset_ns" not in session:
        return f"{scan.path}: {state} ({places}); {messages} messages of it are sound"
    span = (scan.last - int(session["clock_offset_ns"])) / NANO - float(session["start_time"])
    return (
        f"{scan.path}: {state} ({places}); {messages} messages of the first {span:.2f} s can be had: "
        f"mjx-tt log salvage {scan.path}"
    )
