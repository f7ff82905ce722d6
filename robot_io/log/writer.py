"""Packed records into an MCAP file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from mcap.records import Metadata as McapMetadata
from mcap.writer import CompressionType, Writer

from ballmodel.io.atomic_files import sync_folder
from robot_io import contract
from robot_io.calibrated import Frame
from robot_io.contract import PAPER, Contract
from robot_io.errors import ContractError
from robot_io.log import view
from robot_io.log.messages import End, LogError, Metadata, as_strings, unpack
from robot_io.log.topics import NANO, SEQUENCE, Encoded, encode, stamps, topics

FORMAT = "mjx-tt session log"
FORMAT_VERSION = 1
SUFFIX = ".mcap"
UNFINISHED = ".mcap.part"
LARGEST_FILE = 128 * 1024 * 1024  # bytes after which a session goes on in another file: some half an hour
CHUNK_SIZE = 64 * 1024  # bytes; a recorder's flushes usually end a chunk earlier
CONTRACT = "contract"  # key of the session's metadata: another robot's contract as JSON; the paper's has none
FORBIDDEN = frozenset('/\\:*?"<>|\0')  # in a file's name, somewhere


@dataclass(frozen=True)
class Session:
    """Start data of a recorder, all of it ready to be written.

    first        the session's first file, with its name when it is finished
    metadata     entries of the MCAP metadata record "session"
    attachments  files kept whole, by name
    part         of the session, from 1
    """

    first: Path
    metadata: dict[str, str]
    attachments: dict[str, bytes]
    part: int = 1

    @property
    def path(self) -> Path:
        return part_of(self.first, self.part)

    @property
    def unfinished(self) -> Path:
        return self.path.with_suffix(UNFINISHED)


def part_of(path: Path, part: int) -> Path:
    """File of a session's part, whose first is ``path``."""
    return path if part == 1 else path.with_suffix(f".{part:03d}{SUFFIX}")


def parts(path: str | os.PathLike) -> list[Path]:
    """The finished files of a session whose first is ``path``, in order; of a single file itself."""
    first = Path(path)
    found = [first]
    while (following := part_of(first, len(found) + 1)).exists():
        found.append(following)
    return found


def session(
    folder: str | Path,
    name: str,
    metadata: Mapping[str, Any],
    attachments: Mapping[str, str | bytes],
    clock_offset_ns: int,
    start_time: float,
    host: bool,
    robot: Contract = PAPER,
) -> Session:
    """Adds what every log says of itself to ``metadata``.

    ``start_time`` [s] is the session's start on the control process's clock; ``host`` adds the machine and the date.
    ``robot`` has the joints; another one's than the paper's contract is kept whole.
    Raises LogError for names that cannot be, an entry that would hide one of the log's own, and a file that exists.
    """
    if not name or name.startswith(".") or FORBIDDEN & set(name):
        raise LogError(f"{name!r}: no name of a log; letters, digits, dots, dashes and underscores are safe")
    own = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "name": name,
        "contract_version": contract.CONTRACT_VERSION,
        "control_rate_hz": contract.CONTROL_RATE,
        "joint_names": list(robot.joints),
        "joint_units": list(robot.units),
        "observation_names": list(robot.observation_names),
        "clock_offset_ns": clock_offset_ns,
        "start_time": start_time,
    }
    if robot != PAPER:
        own[CONTRACT] = contract.describe(robot)
    if host:
        started = datetime.fromtimestamp(start_time + clock_offset_ns / NANO, UTC)
        own |= {
            "started_utc": started.isoformat(timespec="milliseconds"),
            "host": platform.node(),
            "system": platform.platform(),
            "python": platform.python_version(),
        }
    hidden = sorted({*own, CONTRACT, "checksum"} & set(metadata))
    if hidden:
        raise LogError(f"metadata {', '.join(hidden)}: written by the log itself, choose another key")
    contents = {key: value.encode() if isinstance(value, str) else bytes(value) for key, value in attachments.items()}
    made = Session(Path(folder).absolute() / f"{name}{SUFFIX}", as_strings({**own, **metadata}), contents)
    for path in (made.path, made.unfinished):
        if path.exists():
            raise LogError(f"{path}: exists; choose another name, or salvage and remove it")
    return made


def sample_clock_offset() -> int:
    """Nanoseconds since 1970 minus nanoseconds of the monotonic clock, from the quickest of five looks at both."""
    looks = []
    for _ in range(5):
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after - before, wall - (before + after) // 2))
    return min(looks)[1]


def robot_of(metadata: Mapping[str, str], where: str) -> Contract:
    """The contract of a session's robot, from its metadata. Raises LogError where that is none."""
    text = metadata.get(CONTRACT)
    try:
        return PAPER if text is None else contract.from_description(json.loads(text))
    except (ContractError, ValueError) as error:
        raise LogError(f"{where}: metadata {CONTRACT!r}: {error}") from None


def checksum(record: McapMetadata) -> str:
    """SHA-256 of a metadata record, which MCAP protects with no CRC until the file is complete."""
    kept = {key: value for key, value in record.metadata.items() if key != "checksum"}
    return hashlib.sha256(json.dumps([record.name, kept], sort_keys=True).encode()).hexdigest()


def start_file(stream: IO[bytes], library: str) -> Writer:
    """MCAP's writer with a log's sizes and checksums, its header written."""
    writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile="", library=library)
    return writer


def add_metadata(writer: Writer, name: str, entries: Mapping[str, Any]) -> None:
    """Writes a metadata record with its checksum. Raises LogError for a value that is no JSON data."""
    record = McapMetadata(name, as_strings(entries))
    writer.add_metadata(name, {**record.metadata, "checksum": checksum(record)})


class SessionWriter:
    """Writes one session. Not for the control thread: it encodes, compresses and waits for the disk.

    A file that has grown to ``largest`` bytes is finished, and the session goes on in the next one. Each is a sound log
    by itself. Raises OSError when a file cannot be made or the disk is full.
    """

    def __init__(self, session: Session, largest: int = LARGEST_FILE) -> None:
        self._largest, described = largest, session.metadata
        robot = robot_of(described, described["name"])
        self._offset = int(described["clock_offset_ns"])
        self._topics = topics(robot)
        self._view = view.View(Frame(*map(tuple, json.loads(described.get("robot_base", "[]")))), robot)
        self._open(session)

    def _open(self, session: Session) -> None:
        self._session = session
        self._end: End | None = None
        self._unflushed = False
        self.messages = 0
        session.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(session.unfinished, "xb")
        self._writer = start_file(self._file, f"robot_io.log {FORMAT_VERSION}")
        add_metadata(self._writer, "session", session.metadata)
        start_time = float(session.metadata["start_time"])
        start = self._nanoseconds(start_time)
        for name, content in session.attachments.items():
            media_type = "application/octet-stream" if b"\0" in content else "text/plain"
            self._writer.add_attachment(start, start, name, media_type, content)
        schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        for topic in (*self._topics.values(), *view.TOPICS):
            name = topic.message.DESCRIPTOR.full_name
            if name not in schemas:
                schemas[name] = self._writer.register_schema(name, "protobuf", topic.schema())
            channel = self._writer.register_channel(topic.name, "protobuf", schemas[name], topic.metadata)
            self._channels[topic.name] = channel
        self._add_message(self._view.scene(start_time))
        self._file.flush()

    def write(self, packed: bytes) -> None:
        """Takes a packed record. Raises LogError for one that is malformed; nothing of it is written then."""
        record = unpack(packed)
        if isinstance(record, Metadata):
            add_metadata(self._writer, record.name, record.entries)
        elif isinstance(record, End):
            self._end = record
        else:
            for encoded in (*encode(record, self._topics), *self._view.encode(record)):
                self._add_message(encoded)
        self._unflushed = True
        if self._file.tell() >= self._largest and not self._end:
            self._end = End(0, 0)
            self.finish()
            following = self._session.part + 1  # its metadata say so
            metadata = self._session.metadata | {"part": str(following)}
            self._open(replace(self._session, part=following, metadata=metadata))

    def flush(self) -> None:
        """Ends the chunk and brings everything so far to the disk. Raises OSError, also for a file that is gone."""
        path = self._session.unfinished
        if not path.exists() or not os.path.samestat(path.stat(), os.fstat(self._file.fileno())):
            raise FileNotFoundError(f"{path}: removed or moved while it was written")
        if self._unflushed:
            self._writer.flush()
            os.fdatasync(self._file.fileno())
            self._unflushed = False

    def finish(self, malformed: int = 0) -> Path:
        """Completes the file and gives it its name; ``malformed`` records were refused by ``write``.

        Returns the session's first file.
        """
        end = self._end or End("unknown", 0)
        entries = {
            "closed": self._end is not None,
            "dropped": end.dropped,
            "malformed": end.malformed + malformed,
            "messages": self.messages,
        }
        add_metadata(self._writer, "end", entries)
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        path = self._session.path
        if path.exists():
            raise FileExistsError(f"{path} appeared meanwhile; the log is complete as {self._session.unfinished}")
        os.rename(self._session.unfinished, path)
        sync_folder(path.parent)
        return self._session.first

    def _add_message(self, encoded: Encoded) -> None:
        published, logged = self._nanoseconds(encoded.publish_time), self._nanoseconds(encoded.log_time)
        for stamp in stamps(encoded.message):
            stamp.seconds, stamp.nanos = divmod(published, NANO)
        self._writer.add_message(
            self._channels[encoded.topic.name],
            log_time=logged,
            data=encoded.message.SerializeToString(),
            publish_time=published,
            sequence=encoded.sequence % SEQUENCE,
        )
        self.messages += 1

    def _nanoseconds(self, seconds: float) -> int:
        if not math.isfinite(seconds):
            raise LogError(f"time {seconds}: a finite number of seconds is needed")
        nanoseconds = round(seconds * NANO) + self._offset
        if not 0 <= nanoseconds < 1 << 63:
            raise LogError(f"time {seconds}: is {nanoseconds} ns since 1970, MCAP holds no time before that")
        return nanoseconds
