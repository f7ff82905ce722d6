"""Tracks in message logs: MCAP (JSON, Protobuf and ROS messages) and ROS 1 and 2 bags.

A message holds a ball when it has a point: Foxglove's PointInFrame, ROS's PointStamped and PoseStamped, or the same as
JSON. Its own stamp counts, the log's time where it has none. Names of session and trajectory may be added:
    {"timestamp": {"sec", "nsec"}, "frame_id", "point": {"x", "y", "z"}, "session", "trajectory"}
"""

from __future__ import annotations

import json
import os
import struct
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from ballmodel.io.atomic_files import replacing
from ballmodel.io.samples import Samples, TrackOptions
from ballmodel.trajectory import Dataset

TOPIC = "/ball"
FRAME = "table"
NANO = 1_000_000_000
Decoder = Callable[[bytes], Any]
Log = Iterable[tuple[str, float, Any]]  # topic, logged time [s] and content of each message

_NUMBER, _TEXT, _COUNT = {"type": "number"}, {"type": "string"}, {"type": "integer", "minimum": 0}
SCHEMA = {
    "title": "BallSample",
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "title": "time", "properties": {"sec": _COUNT, "nsec": _COUNT}},
        "frame_id": _TEXT,
        "point": {"type": "object", "properties": {"x": _NUMBER, "y": _NUMBER, "z": _NUMBER}},
        "session": _TEXT,
        "trajectory": _TEXT,
    },
    "required": ["timestamp", "frame_id", "point", "trajectory"],
}


def write_mcap(path: str | os.PathLike, dataset: Dataset) -> None:
    """Writes all samples, trajectory after trajectory; times are rounded to nanoseconds.

    The file appears only when it is complete. Raises ValueError for times before zero, which MCAP cannot hold.
    """
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        writer = Writer(stream, chunk_size=256 * 1024, compression=CompressionType.ZSTD)
        writer.start(profile="", library="ballmodel")
        schema = writer.register_schema("BallSample", "jsonschema", json.dumps(SCHEMA).encode())
        channel = writer.register_channel(TOPIC, "json", schema)
        for trajectory in dataset:
            if trajectory.time[0] < 0.0:
                start = trajectory.time[0]
                raise ValueError(f"{trajectory.label}: starts at t={start}; MCAP holds no time before zero")
            for i, (t, (x, y, z)) in enumerate(zip(trajectory.time, trajectory.position.T, strict=True)):
                stamp = round(float(t) * NANO)
                message = {
                    "timestamp": {"sec": stamp // NANO, "nsec": stamp % NANO},
                    "frame_id": FRAME,
                    "point": {"x": x, "y": y, "z": z},
                    "session": trajectory.session,
                    "trajectory": trajectory.name,
                }
                writer.add_message(channel, stamp, json.dumps(message).encode(), publish_time=stamp, sequence=i)
        writer.finish()


def read_mcap(path: str | os.PathLike, options: TrackOptions) -> Samples:
    """The balls of an MCAP file.

    Raises:
        ValueError: the file is damaged, no topic holds points, or several do; the message says what to give.
    """
    notes: list[str] = []
    return _collect(path, _read_mcap(Path(path), options, notes), options, notes)


def _read_mcap(path: Path, options: TrackOptions, notes: list[str]) -> Log:
    decoders: dict[int, Decoder | None] = {}
    damage, decoded = None, 0
    with open(path, "rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        records = reader.iter_messages(options.topic and [options.topic], log_time_order=False)
        while True:
            try:
                schema, channel, record = next(records)
            except StopIteration:
                break
            except (McapError, ZstdError, ValueError, OSError, struct.error) as error:
                damage = f"damaged or cut short ({type(error).__name__}: {error})"
                break
            if channel.id not in decoders:
                decoders[channel.id] = _choose_decoder(channel, schema)
            decode = decoders[channel.id]
            if decode is None:
                continue
            try:
                message = decode(record.data)
            except Exception as error:  # of whatever library decodes it
                raise ValueError(f"{path}: message {decoded} on {channel.topic}: {error}") from None
            decoded += 1
            yield channel.topic, record.log_time / NANO, message
    if damage and not options.salvage:
        raise ValueError(f"{path}: {damage}; its complete chunks hold {decoded} messages, read them with --salvage")
    if damage:
        notes.append(f"the file is {damage}; its complete chunks were read")


def _choose_decoder(channel: Channel, schema: Schema | None) -> Decoder | None:
    if channel.message_encoding == "json":
        return json.loads
    if channel.message_encoding == "protobuf" and schema is not None:
        files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString
    if channel.message_encoding in ("cdr", "ros1") and schema is not None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        ros1 = channel.message_encoding == "ros1"
        types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/")
        if name not in types.fielddefs:
            types.register(get_types_from_msg(schema.data.decode(), name))
        return lambda data: (types.deserialize_ros1 if ros1 else types.deserialize_cdr)(data, name)
    return None


def read_bag(path: str | os.PathLike, options: TrackOptions) -> Samples:
    """The balls of a ROS 1 bag (a file) or ROS 2 bag (a folder). Raises ValueError as ``read_mcap`` does."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    def messages() -> Log:
        try:
            with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                wanted = [c for c in reader.connections if options.topic in (None, c.topic)]
                for connection, stamp, data in reader.messages(connections=wanted):
                    yield connection.topic, stamp / NANO, reader.deserialize(data, connection.msgtype)
        except AnyReaderError as error:
            raise ValueError(f"{path}: not readable as a ROS bag: {error}") from None

    return _collect(path, messages(), options, [])


def _get(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _find_point(message: Any) -> Any:
    """The part of a message that has x, y and z."""
    for way in (("point",), ("pose", "position"), ("pose", "pose", "position"), ("position",), ()):
        part = message
        for name in way:
            part = _get(part, name)
        if all(_get(part, axis) is not None for axis in "xyz"):
            return part
    return None


def _find_time(message: Any) -> float | None:
    """The message's own stamp [s]."""
    for stamp in (_get(message, "timestamp"), _get(_get(message, "header"), "stamp"), _get(message, "stamp")):
        seconds = [v for name in ("sec", "secs", "seconds") if (v := _get(stamp, name)) is not None]
        parts = [v for name in ("nsec", "nanosec", "nsecs", "nanos") if (v := _get(stamp, name)) is not None]
        if seconds and parts:
            return float(seconds[0]) + float(parts[0]) / NANO
    return None


def _collect(path: str | os.PathLike, messages: Log, options: TrackOptions, notes: list[str]) -> Samples:
    """The samples on the topic that the options name, or else the ball's, or the only one with points."""
    balls: dict[str, list[tuple[float, ...]]] = {}
    labels: dict[str, list[tuple[str, ...]]] = {}
    topics: Counter[str] = Counter()
    for topic, logged, message in messages:
        where = f"{path}: message {topics[topic]} on {topic}"
        topics[topic] += 1
        point, stamp = _find_point(message), _find_time(message)
        if point is None:
            if topic == (options.topic or TOPIC):
                raise ValueError(f"{where}: expected a point with x, y and z")
            continue
        try:
            position = [float(_get(point, axis)) for axis in "xyz"]
        except (TypeError, ValueError):
            raise ValueError(f"{where}: x, y, z are no numbers") from None
        balls.setdefault(topic, []).append((logged if stamp is None else stamp, *position))
        labels.setdefault(topic, []).append(tuple(str(_get(message, key) or "") for key in ("session", "trajectory")))
    chosen = options.topic or (TOPIC if TOPIC in balls else next(iter(balls), None))
    if chosen not in balls:
        listed = ", ".join(topics) or "none"
        raise ValueError(f"{path}: no point on the topic {chosen or TOPIC}; topics that can be read: {listed}")
    if options.topic is None and chosen != TOPIC and len(balls) > 1:
        raise ValueError(f"{path}: points are on {', '.join(balls)}; name the ball's: --topic {chosen}")
    time, *places = np.array(balls[chosen]).T
    sessions, tracks = map(list, zip(*labels[chosen], strict=True))
    return Samples(time, np.array(places), sessions, tracks, tuple(notes))
