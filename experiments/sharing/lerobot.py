"""A LeRobotDataset v3.0 of recorded episodes, written with PyArrow alone; LeRobot itself needs PyTorch.

The format is that of lerobot 0.4 (https://huggingface.co/docs/lerobot/lerobot-dataset-v3): frames and episodes as
Parquet, information and statistics as JSON. The tests read it with lerobot's own reader.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ballmodel.io.atomic_files import placing
from experiments.sharing.card import filled
from experiments.sharing.recordings import Feature, Recording
from robot_io.contract import CONTROL_RATE

VERSION = "v3.0"
FILE = "chunk-000/file-000.parquet"
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
COUNTED = {"timestamp": Feature("float32")} | {
    name: Feature("int64") for name in ("frame_index", "episode_index", "index", "task_index")
}


def write(recording: Recording, folder: Path) -> None:
    """Writes a data set into a new folder, which is whole or absent.

    Raises FileExistsError for a folder that is not empty, OSError when the disk refuses.
    """
    features = recording.features | COUNTED
    columns = list(_columns(recording))
    joined = {name: np.concatenate([c[name] for c in columns]) for name in features}
    with placing(folder) as staging:
        for part in ("data", "meta/episodes"):
            (staging / part / "chunk-000").mkdir(parents=True)
        arrays = [_arrow(joined[name], feature) for name, feature in features.items()]
        pq.write_table(pa.table(arrays, names=list(features)), staging / "data" / FILE)
        pq.write_table(_tasks(recording.task), staging / "meta" / "tasks.parquet")
        pq.write_table(pa.Table.from_pylist(_episodes(recording, columns)), staging / "meta" / "episodes" / FILE)
        meta = {
            "info": _info(recording, features, len(joined["index"])),
            "stats": {name: statistics(values) for name, values in joined.items()},
        }
        for name, data in meta.items():
            (staging / "meta" / f"{name}.json").write_text(json.dumps(data, indent=4) + "\n", encoding="utf-8")
        card = filled("dataset.md", recording=recording, frames=len(joined["index"]))
        (staging / "README.md").write_text(card, encoding="utf-8")


def statistics(values: np.ndarray) -> dict[str, list]:
    """Minimum, maximum, mean, standard deviation, count and quantiles over the frames, a list of the components."""
    values = values.reshape(len(values), -1).astype(np.float64)
    found = {name: getattr(np, name)(values, axis=0) for name in ("min", "max", "mean", "std")}
    quantiles = np.quantile(values, QUANTILES, axis=0)
    found |= {f"q{round(100 * q):02d}": row for q, row in zip(QUANTILES, quantiles, strict=True)}
    return {name: row.tolist() for name, row in found.items()} | {"count": [len(values)]}


def _columns(recording: Recording) -> Iterator[dict[str, np.ndarray]]:
    """Columns of each episode, those among them that count."""
    index = 0
    for number, episode in enumerate(recording.episodes):
        frame = np.arange(len(episode.columns["next.done"]))
        counted = {
            "timestamp": frame / CONTROL_RATE,
            "frame_index": frame,
            "episode_index": np.full_like(frame, number),
            "index": frame + index,
            "task_index": np.zeros_like(frame),
        }
        index += frame.size
        yield {
            name: (episode.columns | counted)[name].astype(feature.dtype)
            for name, feature in (recording.features | COUNTED).items()
        }


def _arrow(values: np.ndarray, feature: Feature) -> pa.Array:
    flat = pa.array(values.ravel())
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if feature.names else flat


def _tasks(task: str) -> pa.Table:
    """The tasks, in which lerobot expects their texts as the index of a pandas table."""
    table = pa.table({"task_index": pa.array([0]), "task": [task]})
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": described}
    return table.replace_schema_metadata({"pandas": json.dumps(index)})


def _episodes(recording: Recording, columns: list[dict[str, np.ndarray]]) -> list[dict[str, Any]]:
    rows = []
    for number, (episode, mine) in enumerate(zip(recording.episodes, columns, strict=True)):
        place = {f"{part}/{name}_index": 0 for part in ("data", "meta/episodes") for name in ("chunk", "file")}
        stats = {
            f"stats/{name}/{key}": value for name, values in mine.items() for key, value in statistics(values).items()
        }
        begin, length = int(mine["index"][0]), len(mine["index"])
        span = {"length": length, "dataset_from_index": begin, "dataset_to_index": begin + length}
        said = {"source": episode.source, "outcome": episode.outcome}
        rows.append({"episode_index": number, "tasks": [recording.task], **span, **said, **place, **stats})
    return rows


def _info(recording: Recording, features: dict[str, Feature], frames: int) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": recording.robot,
        "total_episodes": len(recording.episodes),
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(CONTROL_RATE),
        "splits": {"train": f"0:{len(recording.episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            name: {
                "dtype": feature.dtype,
                "shape": [len(feature.names) or 1],
                "names": list(feature.names) or None,
                **({"units": list(feature.units)} if feature.units else {}),
            }
            for name, feature in features.items()
        },
    }
