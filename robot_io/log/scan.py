"""Walks through an MCAP file, checks every checksum, says where something is wrong, and saves what is sound.

The mcap library's readers give the same of a file that was cut off. They stop at damage without saying where it is,
leave some checksums unread, and make an object of every message.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, DataEnd, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, Writer
from zstandard import ZstdError, frame_content_size

from ballmodel.io.atomic_files import replacing
from robot_io.log.messages import LogError
from robot_io.log.topics import HEAD, MARGIN, NANO, Messages
from robot_io.log.writer import SUFFIX, UNFINISHED, add_metadata, checksum, start_file

LARGEST_CHUNK = 1 << 28  # bytes, unpacked
BATCH = 1 << 22  # bytes of messages that are handed out together
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_FOOTER = struct.Struct("<BQQQI8s")  # with its head: starts of summary and its offsets, CRC; then the file's magic
_MALFORMED = (McapError, ZstdError, ValueError, OverflowError, struct.error)
# What may stand before the summary; the messages are in chunks.
_KINDS = {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK, Opcode.MESSAGE_INDEX}
_KINDS |= {Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END}


@dataclass(frozen=True)
class Fault:
    """Something wrong between two places of a file, in bytes from its start."""

    start: int
    end: int
    what: str

    def __str__(self) -> str:
        return f"bytes {self.start} to {self.end}: {self.what}"


@dataclass
class Overview:
    """Contents of a file, without its numbers.

    path         the file
    metadata     MCAP metadata records by name; of one name, the last
    counts       messages by topic
    first, last  log times [ns since 1970] of the messages; None without any
    complete     whether the file was finished properly
    faults       what is wrong, in the order of the file; none for a sound one
    """

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    first: int | None = None
    last: int | None = None
    complete: bool = True
    faults: list[Fault] = field(default_factory=list)

    @property
    def messages(self) -> int:
        return self.counts.total()

    @property
    def duration(self) -> float:
        """[s] from the first message to the last."""
        return 0.0 if self.first is None or self.last is None else (self.last - self.first) / NANO

    @property
    def state(self) -> str:
        """Either "sound", "interrupted" (not finished, what there is is good) or "damaged"."""
        if self.complete:
            return "damaged" if self.faults else "sound"
        return "damaged" if len(self.faults) > 1 else "interrupted"


class Scan(Overview):
    """One walk through a file: iterate to get what is sound of it, in the file's order, then see the attributes.

    Chunks whose checksum fails are left out; where the walk loses its footing, it goes on at the next chunk that the
    file's index names, if it has one. ``schemas`` and ``channels`` are by id, ``attachments`` by name.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        super().__init__(Path(path))
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: dict[str, bytes] = {}
        self._contents: list[bytes] = []  # of chunks that were not yet handed out
        self._places = array("q")  # start and end of each message in the contents, one behind the other
        self._size = self.path.stat().st_size
        with open(self.path, "rb") as file:
            file.seek(-min(len(MCAP0_MAGIC), self._size), os.SEEK_END)
            self.complete = file.read() == MCAP0_MAGIC and self._size > len(MCAP0_MAGIC)
            self._summary_start, summary = _read_summary(file, self._size)
        # The first chunk declares schemas and channels, which the summary repeats.
        self._declare(*summary)
        self._starts = [record.chunk_start_offset for record in summary if isinstance(record, ChunkIndex)]
        if self._summary_start is not None:
            self._starts.append(self._summary_start - _HEAD.size - 4)  # the data's end

    def __iter__(self) -> Iterator[Messages | Attachment | Metadata]:
        with open(self.path, "rb") as file:
            for record in self._walk(file):
                if not isinstance(record, Chunk) or sum(map(len, self._contents)) >= BATCH:
                    yield from self._batch()
                if isinstance(record, Metadata):
                    self.metadata[record.name] = record.metadata
                    yield record
                elif isinstance(record, Attachment):
                    self.attachments[record.name] = record.data
                    yield record
        yield from self._batch()

    def _walk(self, file: IO[bytes]) -> Iterator[Chunk | Attachment | Metadata]:
        """Sound records; messages of sound chunks are kept for ``_batch``."""
        magic, chunks = file.read(len(MCAP0_MAGIC)), 0
        offset, crc = len(magic), zlib.crc32(magic)
        if magic != MCAP0_MAGIC:
            self._fault(0, offset, "no MCAP file, it begins otherwise")
            if not self._starts:
                return
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            end = None
            try:
                record, content = _read_record(file, head, self._size - offset)
                end = offset + len(head) + len(content)
                if isinstance(record, Chunk):
                    chunks += 1
                    self._unpack(record, chunks)
                _check_record(record, content)
            except ValueError as error:
                following = end or min((start for start in self._starts if start > offset), default=self._size)
                self._fault(offset, following, str(error))
                if end is None and following == self._size:
                    return
                file.seek(offset := following)
                continue
            if isinstance(record, DataEnd):
                # Where something was found already, this checksum cannot fit and says nothing more.
                if not self.faults and record.data_section_crc not in (0, crc):
                    damaged = "a chunk's head, an index of messages or this CRC is damaged"
                    self._fault(0, end, f"the CRC of the whole does not fit: {damaged}")
                if not self.complete:
                    self._fault(self._size - len(MCAP0_MAGIC), self._size, "the file does not end with its footer")
                if self._summary_start != end:
                    self._fault(end, self._size, "the CRC of the summary does not fit; messages are not affected")
                return
            offset, crc = end, zlib.crc32(content, zlib.crc32(head, crc))
            self._declare(record)
            if isinstance(record, Chunk | Attachment | Metadata):
                yield record
        self._fault(offset, self._size, "the file ends here, unfinished")

    def _unpack(self, chunk: Chunk, number: int) -> None:
        """Keeps a chunk's messages. Raises ValueError where it is damaged."""
        places, at, before = array("q"), 0, sum(map(len, self._contents))
        try:
            # Sizes that a flipped bit has made huge must not reach the decompressor.
            known = frame_content_size(chunk.data) if chunk.compression == "zstd" else -1
            if known not in (-1, chunk.uncompressed_size) or chunk.uncompressed_size > LARGEST_CHUNK:
                raise ValueError(f"sizes do not agree: {known} and {chunk.uncompressed_size} bytes")
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            content = stream.read(size)
            while at < size:
                opcode, length = _HEAD.unpack_from(content, at)
                at += _HEAD.size
                if opcode == Opcode.MESSAGE:
                    places.extend((before + at, before + at + length))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    kind = Schema if opcode == Opcode.SCHEMA else Channel
                    self._declare(kind.read(ReadDataStream(BytesIO(content[at : at + length]))))
                at += length
            if at != size:
                raise ValueError("its last record ends beyond it")
        except _MALFORMED as error:
            raise ValueError(f"chunk {number} cannot be used ({error})") from None
        self._contents.append(content)
        self._places += places

    def _batch(self) -> Iterator[Messages]:
        """The messages that were kept, and forgets them."""
        if self._places:
            data = np.frombuffer(b"".join([bytes(MARGIN), *self._contents]), np.uint8)
            start, end = np.array(self._places, np.int64).reshape(-1, 2).T + MARGIN
            heads = np.lib.stride_tricks.sliding_window_view(data, HEAD.itemsize)[start].view(HEAD)[:, 0]
            for channel, count in zip(*np.unique(heads["channel"], return_counts=True), strict=True):
                declared = self.channels.get(channel)
                self.counts[declared.topic if declared else f"channel {channel}"] += int(count)
            times = [int(heads["log_time"].min()), int(heads["log_time"].max()), self.first, self.last]
            self.first, self.last = (f(time for time in times if time is not None) for f in (min, max))
            self._contents, self._places = [], array("q")
            yield Messages(data, start + HEAD.itemsize, end, heads)

    def _declare(self, *records: McapRecord | None) -> None:
        for record in records:
            if isinstance(record, Schema):
                self.schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self.channels.setdefault(record.id, record)

    def _fault(self, start: int, end: int, what: str) -> None:
        self.faults.append(Fault(start, end, what))


def check(path: str | os.PathLike) -> Overview:
    """Reads a whole file and checks everything that can be checked. Raises OSError when it cannot be read."""
    scan = Scan(path)
    for _ in scan:
        pass
    return scan


def glance(path: str | os.PathLike) -> Overview:
    """Reads a finished file's summary, in no time and unchecked; any other file is read as ``check`` does."""
    path = Path(path)
    try:
        with open(path, "rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return check(path)
            metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    except _MALFORMED:
        return check(path)
    found = summary.statistics
    counts = Counter({summary.channels[id].topic: count for id, count in found.channel_message_counts.items()})
    times = (found.message_start_time, found.message_end_time) if found.message_count else (None, None)
    return Overview(path, metadata, counts, *times)


def salvage(path: str | os.PathLike, out: str | os.PathLike | None = None) -> Overview:
    """Writes a proper file with everything sound of a damaged or unfinished one, and returns what is in it.

    ``out``, if not given, is NAME.mcap for NAME.mcap.part and NAME.salvaged.mcap for NAME.mcap. The source stays.
    Raises LogError when ``out`` exists or nothing can be saved, OSError when a file cannot be read or written.
    """
    path = Path(path)
    unfinished = path.name.endswith(UNFINISHED)
    name = path.name.removesuffix(UNFINISHED) if unfinished else f"{path.name.removesuffix(SUFFIX)}.salvaged"
    out = path.with_name(name + SUFFIX) if out is None else Path(out)
    if out.exists():
        raise LogError(f"{out}: exists; give another name for what is salvaged")
    scan = Scan(path)
    with replacing(out) as temporary, open(temporary, "wb") as stream:
        writer = start_file(stream, "robot_io.log salvage")
        unknown = _copy(scan, writer)
        messages = scan.messages - unknown
        if not messages:
            raise LogError(f"{path}: no complete chunk with messages, nothing can be salvaged")
        entries = {
            "source": path.name,
            "faults": "\n".join(map(str, scan.faults)),
            "messages": str(messages),
            "messages_of_unknown_topic": str(unknown),
        }
        add_metadata(writer, "salvage", entries)
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    return check(out)


def _copy(scan: Scan, writer: Writer) -> int:
    """Copies what is sound; the number of messages that were left out because nothing says what they are."""
    schemas, channels, unknown = {0: 0}, dict[int, int](), 0
    for part in scan:
        for id, schema in scan.schemas.items():
            if id not in schemas:
                schemas[id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        for id, channel in scan.channels.items():
            if id not in channels and (schema_id := schemas.get(channel.schema_id)) is not None:
                encoding = channel.message_encoding
                channels[id] = writer.register_channel(channel.topic, encoding, schema_id, channel.metadata)
        if isinstance(part, Attachment):
            writer.add_attachment(part.create_time, part.log_time, part.name, part.media_type, part.data)
        elif isinstance(part, Metadata):
            writer.add_metadata(part.name, part.metadata)
        else:
            for i, (id, sequence, logged, published) in enumerate(part.head.tolist()):
                if id in channels:
                    writer.add_message(channels[id], logged, part.content(i), published, sequence)
                else:
                    unknown += 1
    return unknown


def _read_summary(file: IO[bytes], size: int) -> tuple[int | None, list[McapRecord]]:
    """Where a file's summary starts, and its records; None and no records where it is not sound."""
    file.seek(max(0, size - _FOOTER.size))
    tail = file.read()
    if len(tail) == _FOOTER.size and tail[0] == Opcode.FOOTER:
        _, _, start, _, crc, magic = _FOOTER.unpack(tail)
        file.seek(min(start, size))
        content = file.read()[: -len(magic)]
        if len(content) > 4 and zlib.crc32(content[:-4]) == crc:
            return start, list(StreamReader(BytesIO(content + MCAP0_MAGIC), skip_magic=True).records)
    return None, []


def _check_record(record: McapRecord | None, content: bytes) -> None:
    """Raises ValueError for a checksum of the record's own that does not fit."""
    if isinstance(record, Attachment) and zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
        raise ValueError(f"attachment {record.name!r}: the CRC does not fit")
    if isinstance(record, Metadata) and record.metadata.get("checksum") not in (None, checksum(record)):
        raise ValueError(f"metadata {record.name!r}: the SHA-256 does not fit")


def _read_record(file: IO[bytes], head: bytes, left: int) -> tuple[McapRecord | None, bytes]:
    """A record, None for an index of messages, and its bytes. Raises ValueError where there is none.

    left  bytes from the record's start to the file's end
    """
    opcode, length = _HEAD.unpack(head)
    if opcode not in _KINDS:
        raise ValueError(f"no record starts here (kind {opcode:#x})")
    if len(head) + length > left:
        raise ValueError("the file ends within a record, unfinished or damaged")
    content = file.read(length)
    if opcode == Opcode.MESSAGE_INDEX:
        if length < 6 or length != 6 + int.from_bytes(content[2:6], "little"):
            raise ValueError("a malformed index of messages")
        return None, content
    try:
        record = next(StreamReader(BytesIO(head + content), skip_magic=True, emit_chunks=True).records)
        record.write(again := RecordBuilder())
    except _MALFORMED as error:
        raise ValueError(f"a malformed record of kind {opcode:#x} ({type(error).__name__}: {error})") from None
    # The library takes a record whose lengths do not agree. The last bytes may be a CRC that is made anew.
    if again.end()[:-4] != (head + content)[:-4]:
        raise ValueError(f"a record of kind {opcode:#x} whose lengths do not agree")
    return record, content
