"""Walks through an MCAP file record by record, checks every checksum and says where something is wrong.

The mcap library's readers stop at the first fault without its place, and leave some checksums unread.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import mcap.records as mcap_records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError, frame_content_size

from robot_io.log.schema import NANO
from robot_io.log.writer import checksum

LARGEST_CHUNK = 1 << 28  # bytes, unpacked
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_FOOTER_SIZE = _HEAD.size + 8 + 8 + 4
_MALFORMED = (McapError, ZstdError, ValueError, OverflowError, struct.error)
_READERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: mcap_records.Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.MESSAGE_INDEX: mcap_records.MessageIndex.read,
    Opcode.CHUNK_INDEX: mcap_records.ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: mcap_records.AttachmentIndex.read,
    Opcode.STATISTICS: mcap_records.Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: mcap_records.MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: mcap_records.SummaryOffset.read,
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
    """One walk through a file: iterate to get its sound records, chunks unpacked; then see ``faults``.

    Records come in the order of the file. Chunks whose checksum fails are left out; where the walk loses its footing,
    it goes on at the next chunk that the file's index names, if it has one.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        self.data = self.path.read_bytes()
        self.faults: list[Fault] = []
        self.complete = self.data.endswith(MCAP0_MAGIC) and len(self.data) > len(MCAP0_MAGIC)
        self.chunks = 0
        self._known: list[McapRecord] = []  # schemas and channels that the summary repeats
        self._chunk_starts: list[int] = []
        self._data_end: int | None = None
        self._read_summary()

    def __iter__(self) -> Iterator[McapRecord]:
        data, offset = self.data, len(MCAP0_MAGIC)
        if not data.startswith(MCAP0_MAGIC):
            self._fault(0, min(8, len(data)), "no MCAP file, it begins otherwise")
            if not self._chunk_starts:
                return
        # The first chunk, which declares them, may be the damaged one.
        yield from self._known
        summary_start, ended = 0, False
        while not ended:
            if offset + _HEAD.size > len(data):
                self._fault(offset, len(data), "the file ends here, unfinished")
                return
            opcode, length = _HEAD.unpack_from(data, offset)
            end = offset + _HEAD.size + length
            record: McapRecord | str
            if opcode not in _READERS:
                record = f"no record starts here (kind {opcode:#x})"
            elif end > len(data):
                record = "the file ends within a record, unfinished or damaged"
            else:
                record = _parse(opcode, data[offset + _HEAD.size : end])
            if isinstance(record, str):
                following = self._next_sound(offset)
                self._fault(offset, following or len(data), record)
                if following is None:
                    return
                offset = following
                continue
            if isinstance(record, Chunk):
                yield from self._unpacked(record, offset, end)
            elif isinstance(record, DataEnd):
                self._check_data(record, offset)
                summary_start = end
            elif isinstance(record, Footer):
                self._check_end(summary_start, end)
                ended = True
            elif isinstance(record, Attachment):
                if zlib.crc32(data[offset + _HEAD.size : end - 4]) == struct.unpack("<I", data[end - 4 : end])[0]:
                    yield record
                else:
                    self._fault(offset, end, f"attachment {record.name!r}: the CRC does not fit")
            elif isinstance(record, Metadata):
                if record.metadata.get("checksum", digest := checksum(record.name, record.metadata)) == digest:
                    yield record
                else:
                    self._fault(offset, end, f"metadata {record.name!r}: the SHA-256 does not fit")
            elif isinstance(record, Schema | Channel) and not summary_start:
                yield record
            offset = end

    def _unpacked(self, chunk: Chunk, offset: int, end: int) -> Iterator[McapRecord]:
        self.chunks += 1
        try:
            # Sizes that a flipped bit has made huge must not reach the decompressor.
            known = frame_content_size(chunk.data) if chunk.compression == "zstd" else -1
            if known not in (-1, chunk.uncompressed_size) or chunk.uncompressed_size > LARGEST_CHUNK:
                raise ValueError(f"sizes do not agree: {known} and {chunk.uncompressed_size} bytes")
            records = breakup_chunk(chunk, validate_crc=True)
        except _MALFORMED as error:
            self._fault(offset, end, f"chunk {self.chunks} cannot be used ({error})")
            return
        yield from records

    def _check_data(self, record: DataEnd, offset: int) -> None:
        # Where something was found already, this checksum cannot fit and says nothing more.
        if not self.faults and record.data_section_crc not in (0, zlib.crc32(self.data[:offset])):
            what = "the CRC of the whole does not fit: a chunk's head, an index of messages or this CRC is damaged"
            self._fault(0, offset + _HEAD.size + 4, what)

    def _check_end(self, summary_start: int, end: int) -> None:
        if self.data[end:] != MCAP0_MAGIC:
            self._fault(end, len(self.data), "the file does not end with its footer")
        if self._data_end is None:
            self._fault(summary_start, end, "the CRC of the summary does not fit; messages are not affected")

    def _fault(self, start: int, end: int, what: str) -> None:
        self.faults.append(Fault(start, end, what))

    def _next_sound(self, offset: int) -> int | None:
        return next((start for start in [*self._chunk_starts, self._data_end or 0] if start > offset), None)

    def _read_summary(self) -> None:
        """Finds the summary from the end of the file, if it is there and sound."""
        data, footer = self.data, len(self.data) - len(MCAP0_MAGIC) - _FOOTER_SIZE
        if footer < 0 or not data.endswith(MCAP0_MAGIC) or data[footer] != Opcode.FOOTER:
            return
        start, _, crc = struct.unpack_from("<QQI", data, footer + _HEAD.size)
        if not 0 < start <= footer or zlib.crc32(data[start : footer + _FOOTER_SIZE - 4]) != crc:
            return
        self._data_end = start - _HEAD.size - 4
        while start < footer:
            opcode, length = _HEAD.unpack_from(data, start)
            record = _parse(opcode, data[start + _HEAD.size : start + _HEAD.size + length])
            if isinstance(record, Schema | Channel):
                self._known.append(record)
            elif isinstance(record, mcap_records.ChunkIndex):
                self._chunk_starts.append(record.chunk_start_offset)
            start += _HEAD.size + length


def check(path: str | os.PathLike) -> Overview:
    """Reads a whole file and checks everything that can be checked. Raises OSError when it cannot be read."""
    scan = Scan(path)
    topics: dict[int, str] = {}
    counts: Counter[str] = Counter()
    metadata: dict[str, dict[str, str]] = {}
    first = last = None
    for record in scan:
        if isinstance(record, Message):
            counts[topics.get(record.channel_id, f"channel {record.channel_id}")] += 1
            first = record.log_time if first is None else min(first, record.log_time)
            last = record.log_time if last is None else max(last, record.log_time)
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
    return Overview(scan.path, metadata, dict(counts), first, last, scan.complete, tuple(scan.faults))


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


class _Stream(ReadDataStream):
    """The library's stream gives less than asked for at its end; this one says so."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile()
        return data


def _parse(opcode: int, content: bytes) -> McapRecord | str:
    """The record, or a sentence about its fault."""
    stream = _Stream(BytesIO(content))
    try:
        record = _READERS[opcode](stream)
    except (*_MALFORMED, UnicodeDecodeError) as error:
        return f"a malformed record of kind {opcode:#x} ({type(error).__name__}: {error})"
    if stream.count != len(content):
        return f"a record of kind {opcode:#x} with {len(content)} bytes, {stream.count} of which make sense"
    return record
