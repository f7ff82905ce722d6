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
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, DataEnd, Header, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError, frame_content_size

from ballmodel.io.atomic_files import replacing
from robot_io.log.messages import LogError
from robot_io.log.topics import MARGIN, NANO, Messages
from robot_io.log.writer import CHUNK_SIZE, SUFFIX, UNFINISHED, checksum

LARGEST_CHUNK = 1 << 28  # bytes, unpacked
BATCH = 1 << 22  # bytes of messages that are handed out together
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_FOOTER = struct.Struct("<BQQQI")  # with its head: starts of summary and its offsets, CRC
_MESSAGE = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<i8"), ("publish_time", "<i8")])
_MALFORMED = (McapError, ZstdError, ValueError, OverflowError, struct.error)
_READERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.DATA_END: DataEnd.read,
}


@dataclass(frozen=True)
class Fault:
    """Something wrong between two places of a file, in bytes from its start."""

    start: int
    end: int
    what: str

    def __str__(self) -> str:
        return f"bytes {self.start} to {self.end}: {self.what}"


@dataclass(frozen=True)
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
    metadata: dict[str, dict[str, str]]
    counts: dict[str, int]
    first: int | None
    last: int | None
    complete: bool
    faults: tuple[Fault, ...]

    @property
    def messages(self) -> int:
        return sum(self.counts.values())

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


class Scan:
    """One walk through a file: iterate to get what is sound of it, then see ``faults``.

    Records come in the order of the file. Chunks whose checksum fails are left out; where the walk loses its footing,
    it goes on at the next chunk that the file's index names, if it has one. ``schemas`` and ``channels`` are by id,
    those of the messages so far.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        self.faults: list[Fault] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.messages = 0
        self._size = self.path.stat().st_size
        self._chunks = 0
        self._chunk_starts: list[int] | None = None
        self._contents: list[bytes] = []
        self._starts, self._ends = array("q"), array("q")  # of messages in the contents, one behind the other
        with open(self.path, "rb") as file:
            file.seek(-min(len(MCAP0_MAGIC), self._size), os.SEEK_END)
            self.complete = file.read() == MCAP0_MAGIC and self._size > len(MCAP0_MAGIC)

    def __iter__(self) -> Iterator[Messages | Attachment | Metadata]:
        with open(self.path, "rb") as file:
            for record in self._walk(file):
                if not isinstance(record, Chunk):
                    yield from self._batch()  # all in the order of the file
                    yield record
                elif sum(map(len, self._contents)) >= BATCH:
                    yield from self._batch()
        yield from self._batch()

    def _walk(self, file: IO[bytes]) -> Iterator[Chunk | Attachment | Metadata]:
        """Sound records; messages of sound chunks are kept for ``_batch``."""
        offset = 0
        crc = zlib.crc32(magic := file.read(len(MCAP0_MAGIC)))
        if magic != MCAP0_MAGIC:
            self._fault(0, len(magic), "no MCAP file, it begins otherwise")
            if not self._find_chunks(file):
                return
        offset = len(magic)
        while True:
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                self._fault(offset, self._size, "the file ends here, unfinished")
                return
            opcode, length = _HEAD.unpack(head)
            end = offset + _HEAD.size + length
            if opcode not in _READERS and opcode != Opcode.MESSAGE_INDEX:
                wrong = f"no record starts here (kind {opcode:#x})"
            elif end > self._size:
                wrong = "the file ends within a record, unfinished or damaged"
            else:
                content = file.read(length)
                record, wrong = _parse(opcode, content)
            if wrong:
                following = min((start for start in self._find_chunks(file) if start > offset), default=None)
                self._fault(offset, following or self._size, wrong)
                if following is None:
                    return
                file.seek(offset := following)
                continue
            if isinstance(record, DataEnd):
                # Where something was found already, this checksum cannot fit and says nothing more.
                if not self.faults and record.data_section_crc not in (0, crc):
                    what = (
                        "the CRC of the whole does not fit: a chunk's head, an index of messages or this CRC is damaged"
                    )
                    self._fault(0, end, what)
                self._check_summary(end, file.read())
                return
            crc = zlib.crc32(content, zlib.crc32(head, crc))
            if isinstance(record, Chunk):
                self._chunks += 1
                wrong = self._unpack(record)
                wrong = wrong and f"chunk {self._chunks} cannot be used ({wrong})"
            elif isinstance(record, Attachment) and zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
                wrong = f"attachment {record.name!r}: the CRC does not fit"
            elif isinstance(record, Metadata):
                digest = checksum(record.name, record.metadata)
                if record.metadata.get("checksum", digest) != digest:
                    wrong = f"metadata {record.name!r}: the SHA-256 does not fit"
            elif isinstance(record, Schema | Channel):
                self._declare(record)
            if wrong:
                self._fault(offset, end, wrong)
                self._find_chunks(file)  # the first chunk declares schemas and channels, which the summary repeats
                file.seek(end)
            elif isinstance(record, Chunk | Attachment | Metadata):
                yield record
            offset = end

    def _unpack(self, chunk: Chunk) -> str:
        """Keeps a chunk's messages; what is wrong with it, "" for a sound one."""
        try:
            # Sizes that a flipped bit has made huge must not reach the decompressor.
            known = frame_content_size(chunk.data) if chunk.compression == "zstd" else -1
            if known not in (-1, chunk.uncompressed_size) or chunk.uncompressed_size > LARGEST_CHUNK:
                raise ValueError(f"sizes do not agree: {known} and {chunk.uncompressed_size} bytes")
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            content = stream.read(size)
            starts, ends, at = array("q"), array("q"), 0
            before = sum(map(len, self._contents))
            while at < size:
                opcode, length = _HEAD.unpack_from(content, at)
                at += _HEAD.size
                if opcode == Opcode.MESSAGE:
                    starts.append(before + at)
                    ends.append(before + at + length)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._declare(_READERS[opcode](ReadDataStream(BytesIO(content[at : at + length]))))
                at += length
            if at != size:
                raise ValueError("its last record ends beyond it")
        except _MALFORMED as error:
            return str(error)
        self._contents.append(content)
        self._starts += starts
        self._ends += ends
        return ""

    def _batch(self) -> Iterator[Messages]:
        """The messages that were kept, and forgets them."""
        if self._starts:
            data = np.frombuffer(b"".join([bytes(MARGIN), *self._contents]), np.uint8)
            start, end = (np.array(places, np.int64) + MARGIN for places in (self._starts, self._ends))
            heads = np.lib.stride_tricks.sliding_window_view(data, _MESSAGE.itemsize)[start].view(_MESSAGE)[:, 0]
            self.messages += start.size
            fields = (np.ascontiguousarray(heads[name]) for name in _MESSAGE.names or ())
            batch = Messages(data, start + _MESSAGE.itemsize, end, *fields)
            self._contents, self._starts, self._ends = [], array("q"), array("q")
            yield batch

    def _declare(self, record: Schema | Channel) -> None:
        known: dict = self.schemas if isinstance(record, Schema) else self.channels
        known.setdefault(record.id, record)

    def _check_summary(self, start: int, rest: bytes) -> None:
        """``rest``: of the file from the end of its data at ``start``."""
        if not rest.endswith(MCAP0_MAGIC):
            self._fault(self._size - len(MCAP0_MAGIC), self._size, "the file does not end with its footer")
        if not _is_summary(rest, start):
            self._fault(start, self._size, "the CRC of the summary does not fit; messages are not affected")

    def _find_chunks(self, file: IO[bytes]) -> list[int]:
        """Where chunks start and the data ends, by a sound summary, whose schemas and channels are declared as well."""
        if self._chunk_starts is None:
            self._chunk_starts = []
            file.seek(max(0, self._size - len(MCAP0_MAGIC) - _FOOTER.size))
            tail = file.read(_FOOTER.size)
            start = _FOOTER.unpack(tail)[2] if len(tail) == _FOOTER.size else self._size
            file.seek(min(start, self._size))
            if self.complete and _is_summary(summary := file.read(), start):
                for record in StreamReader(BytesIO(summary), skip_magic=True).records:
                    if isinstance(record, Schema | Channel):
                        self._declare(record)
                    elif isinstance(record, ChunkIndex):
                        self._chunk_starts.append(record.chunk_start_offset)
                self._chunk_starts.append(start - _HEAD.size - 4)
        return self._chunk_starts

    def _fault(self, start: int, end: int, what: str) -> None:
        self.faults.append(Fault(start, end, what))


def check(path: str | os.PathLike) -> Overview:
    """Reads a whole file and checks everything that can be checked. Raises OSError when it cannot be read."""
    scan, counts, metadata, times = Scan(path), Counter[int](), {}, np.empty(0, np.int64)
    for part in scan:
        if isinstance(part, Metadata):
            metadata[part.name] = part.metadata
        elif isinstance(part, Messages):
            counts.update(part.channel.tolist())
            times = np.append(times, [part.log_time.min(), part.log_time.max()])
    by_topic: Counter[str] = Counter()
    for channel, count in counts.items():
        by_topic[scan.channels[channel].topic if channel in scan.channels else f"channel {channel}"] += count
    first, last = (int(times.min()), int(times.max())) if times.size else (None, None)
    return Overview(scan.path, metadata, dict(by_topic), first, last, scan.complete, tuple(scan.faults))


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
    statistics = summary.statistics
    counts = {summary.channels[id].topic: count for id, count in statistics.channel_message_counts.items()}
    some = statistics.message_count > 0
    first, last = (statistics.message_start_time, statistics.message_end_time) if some else (None, None)
    return Overview(path, metadata, counts, first, last, True, ())


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
        writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="robot_io.log salvage")
        unknown = _copy(scan, writer)
        if scan.messages == unknown:
            raise LogError(f"{path}: no complete chunk with messages, nothing can be salvaged")
        entries = {
            "source": path.name,
            "faults": "\n".join(map(str, scan.faults)),
            "messages": str(scan.messages - unknown),
            "messages_of_unknown_topic": str(unknown),
        }
        writer.add_metadata("salvage", {**entries, "checksum": checksum("salvage", entries)})
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
            if id not in channels and channel.schema_id in schemas:
                channels[id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
                )
        if isinstance(part, Attachment):
            writer.add_attachment(part.create_time, part.log_time, part.name, part.media_type, part.data)
        elif isinstance(part, Metadata):
            writer.add_metadata(part.name, part.metadata)
        else:
            columns = (part.channel, part.log_time, part.publish_time, part.sequence)
            for i, (id, logged, published, sequence) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
                if id in channels:
                    writer.add_message(channels[id], logged, part.content(i), published, sequence)
                else:
                    unknown += 1
    return unknown


class _Stream(ReadDataStream):
    """The library's stream gives less than asked for at its end; this one says so."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile()
        return data


def _parse(opcode: int, content: bytes) -> tuple[McapRecord | None, str]:
    """The record, None for an index of messages, and what is wrong with it, "" for nothing."""
    if opcode == Opcode.MESSAGE_INDEX:
        sound = len(content) >= 6 and len(content) == 6 + int.from_bytes(content[2:6], "little")
        return None, "" if sound else "a malformed index of messages"
    stream = _Stream(BytesIO(content))
    try:
        record = _READERS[opcode](stream)
    except _MALFORMED as error:
        return None, f"a malformed record of kind {opcode:#x} ({type(error).__name__}: {error})"
    if stream.count != len(content):
        return None, f"a record of kind {opcode:#x} with {len(content)} bytes, {stream.count} of which make sense"
    return record, ""


def _is_summary(content: bytes, start: int) -> bool:
    """Whether a file's last bytes, from ``start`` on, are a sound summary and its footer."""
    footer = content[-len(MCAP0_MAGIC) - _FOOTER.size : -len(MCAP0_MAGIC)]
    if len(footer) < _FOOTER.size:
        return False
    opcode, _, begins, _, crc = _FOOTER.unpack(footer)
    return opcode == Opcode.FOOTER and begins == start and zlib.crc32(content[: -len(MCAP0_MAGIC) - 4]) == crc
