"""A damaged or unfinished log into a proper one."""

from __future__ import annotations

import os
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from ballmodel.io.atomic_files import replacing
from robot_io.log.messages import LogError
from robot_io.log.scan import Overview, Scan, check
from robot_io.log.writer import CHUNK_SIZE, SUFFIX, UNFINISHED, checksum


def salvage(path: str | os.PathLike, out: str | os.PathLike | None = None) -> Overview:
    """Writes a proper file with everything sound of a damaged or unfinished one, and returns what is in it.

    ``out``, if not given, is NAME.mcap for NAME.mcap.part and NAME.salvaged.mcap for NAME.mcap. The source stays.
    Raises LogError when ``out`` exists or nothing can be saved, OSError when a file cannot be read or written.
    """
    path = Path(path)
    out = salvaged_path(path) if out is None else Path(out)
    if out.exists():
        raise LogError(f"{out}: exists; give another name for what is salvaged")
    scan = Scan(path)
    with replacing(out) as temporary:
        with open(temporary, "wb") as stream:
            writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_data_crcs=True)
            writer.start(profile="", library="robot_io.log salvage")
            messages, unknown = _copy(scan, writer)
            if not messages:
                raise LogError(f"{path}: no complete chunk with messages, nothing can be salvaged")
            entries = {
                "source": path.name,
                "faults": "\n".join(map(str, scan.faults)),
                "messages": str(messages),
                "messages_of_unknown_topic": str(unknown),
            }
            writer.add_metadata("salvage", {**entries, "checksum": checksum("salvage", entries)})
            writer.finish()
            stream.flush()
            os.fsync(stream.fileno())
    return check(out)


def salvaged_path(path: Path) -> Path:
    """Path that ``salvage`` writes to."""
    if path.name.endswith(UNFINISHED):
        return path.with_name(path.name.removesuffix(UNFINISHED) + SUFFIX)
    return path.with_name(f"{path.name.removesuffix(SUFFIX)}.salvaged{SUFFIX}")


def _copy(scan: Scan, writer: Writer) -> tuple[int, int]:
    """Copies sound records; the number of messages and how many were left out because nothing says what they are."""
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    messages = unknown = 0
    for record in scan:
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels and record.schema_id in schemas:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Message):
            if record.channel_id not in channels:
                unknown += 1
                continue
            writer.add_message(
                channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
            messages += 1
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
    return messages, unknown
