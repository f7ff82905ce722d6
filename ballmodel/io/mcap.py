"""Trajectories in MCAP: one JSON message per sample on the topic /ball, stamped with the sample's time.

The message is Foxglove's PointInFrame with two names added, so viewers draw it as it is:
    {"timestamp": {"sec", "nsec"}, "frame_id", "point": {"x", "y", "z"}, "session", "trajectory"}
"""

from __future__ import annotations

import json
import os

from mcap.exceptions import McapError
from mcap.records import Channel, Footer, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from ballmodel.io.atomic_files import replacing
from ballmodel.trajectory import Dataset

TOPIC = "/ball"
FRAME = "table"
NANO = 1_000_000_000

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
                raise ValueError(
                    f"{trajectory.label}: starts at t={trajectory.time[0]}; MCAP holds no time before zero"
                )
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


def read_mcap(path: str | os.PathLike, salvage: bool = False) -> Dataset:
    """Reads the samples on /ball.

    A file cut short (no footer) is an error that says how many samples can be had; with ``salvage`` those of its
    complete chunks are returned. Raises ValueError naming file and message (from 0) of what is wrong.
    """
    samples: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    topics: dict[int, str] = {}
    complete, count, cause = False, 0, "it ends without a footer"
    with open(path, "rb") as stream:
        records = iter(StreamReader(stream, validate_crcs=True).records)
        while True:
            try:
                record = next(records, None)
            except (McapError, ZstdError, ValueError, OSError) as error:
                cause = f"{type(error).__name__}: {error}"
                break
            if record is None:
                break
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Footer):
                complete = True
            elif isinstance(record, Message) and topics[record.channel_id] == TOPIC:
                session, name, sample = _sample(path, count, record.data)
                samples.setdefault((session, name), []).append(sample)
                count += 1
    if not complete and not salvage:
        raise ValueError(
            f"{path}: damaged or cut short ({cause}); its complete chunks hold {count} samples, read them with salvage"
        )
    if not samples:
        listed = ", ".join(sorted(set(topics.values()))) or "none"
        raise ValueError(f"{path}: no sample on the topic {TOPIC}; topics in the file: {listed}")
    return Dataset.from_samples(samples, str(path))


def _sample(path: str | os.PathLike, index: int, data: bytes) -> tuple[str, str, tuple[float, float, float, float]]:
    try:
        message = json.loads(data)
        stamp, point = message["timestamp"], message["point"]
        if message["frame_id"] != FRAME:
            raise ValueError(f"frame_id is {message['frame_id']!r}, {FRAME!r} is wanted")
        sample = (stamp["sec"] + stamp["nsec"] / NANO, float(point["x"]), float(point["y"]), float(point["z"]))
        return str(message.get("session", "")), str(message["trajectory"]), sample
    except (ValueError, TypeError, KeyError) as error:
        missing = f"field {error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f"{path}: message {index} on {TOPIC}: {missing}") from None
