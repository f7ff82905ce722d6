"""LeRobot data sets: their values are those of the log, and lerobot's own reader gives them back.

lerobot needs PyTorch and is no dependency. Its reader runs where it is installed beside this program, or in another
environment: LEROBOT_PYTHON=/path/to/python.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest

from ballmodel.io.tables import COLUMNS
from experiments import cli
from experiments.sharing import lerobot, recordings
from robot_io import log

START, EPOCH = 100.0, 1_700_000_000_000_000_000  # of a made-up clock
PYTHON = os.environ.get("LEROBOT_PYTHON", sys.executable if importlib.util.find_spec("lerobot") else "")
READER = """
import sys
import numpy as np
import lerobot
from lerobot.datasets.lerobot_dataset import LeRobotDataset
try:  # lerobot 0.6
    from lerobot.utils.feature_utils import dataset_to_policy_features
except ImportError:  # 0.4
    from lerobot.datasets.utils import dataset_to_policy_features
from torch.utils.data import DataLoader

folder, out = sys.argv[1:]
data = LeRobotDataset("somebody/balls", root=folder)
frames = [data[i] for i in range(len(data))]
found = {name: np.stack([frame[name].numpy() for frame in frames]) for name in data.features}
found |= {f"stats/{name}/{key}": v for name, stats in data.meta.stats.items() for key, v in stats.items()}
found |= {f"episode/{key}": np.array(data.meta.episodes[key]) for key in ("length", "source", "outcome")}
kinds = {name: feature.type.value for name, feature in dataset_to_policy_features(data.features).items()}
batches = DataLoader(data, batch_size=16)
past = LeRobotDataset("somebody/balls", root=folder, delta_timestamps={"observation.state": [-2 / 75, -1 / 75, 0.0]})
last = LeRobotDataset("somebody/balls", root=folder, episodes=[data.num_episodes - 1])
np.savez(
    out, **found, version=lerobot.__version__, task=[frame["task"] for frame in frames], fps=data.fps,
    batched=np.concatenate([batch["observation.state"].numpy() for batch in batches]),
    past=np.stack([past[i]["observation.state"].numpy() for i in range(len(past))]),
    last=np.stack([last[i]["observation.state"].numpy() for i in range(len(last))]),
    kinds=str(kinds), names=str(data.meta.names["observation.state"]),
)
"""


def numbers(tick: int, count: int) -> np.ndarray:
    """Made-up values of a tick, different for every one."""
    return np.sin(tick + np.arange(count) / 10)


def record(folder, name="monday", reward=True):
    """A session whose episodes have 30 ticks, none, 20 (discarded), and 12 that the log does not see the end of."""
    with log.FileRecorder(folder, name, {"robot": "rig"}, {}, START, EPOCH) as recorder:
        tick, time = 0, START
        for number, ticks in ((1, 30), (2, 0), (3, 20), (4, 12)):
            time += 1.0
            recorder.put(log.episode_start(time, number))
            for k in range(ticks):
                now = time + k / 75 + (0.004 if k == 5 else 0.0)
                recorder.put(
                    log.Observation(tick, now, numbers(tick, 11)),
                    log.Action(tick, now, numbers(tick, 8)),
                    log.Command(tick, now, 2 * numbers(tick, 8), 3 * numbers(tick, 8), np.zeros(8)),
                )
                tick += 1
            recorder.put(log.Command(tick, time + 0.9, np.zeros(8), np.zeros(8), np.zeros(8)))  # no episode's
            tick += 1
            if number != 4:
                terms = {"hit": 1.0, "return": 0.5} if reward else {}
                recorder.put(log.episode_end(time + 0.8, number, "returned", terms, discarded=number == 3))
    return folder / f"{name}.mcap"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return record(tmp_path_factory.mktemp("log"))


@pytest.fixture(scope="module")
def written(session, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets") / "balls"
    recording = recordings.read([str(session)])
    lerobot.write(recording, folder)
    return recording, folder


TICKS = [*range(30), *range(53, 65)]  # those of episodes 1 and 4


def expected(name: str) -> np.ndarray:
    if name == "observation.state":
        return np.float32([numbers(t, 11) for t in TICKS])
    factor = {"action": 2, "sent": 3}[name]
    return np.float32([factor * numbers(t, 8) for t in TICKS])


def test_every_value_is_the_logs(written):
    table = pq.read_table(written[1] / "data" / "chunk-000" / "file-000.parquet")
    for name in ("observation.state", "action", "sent"):
        np.testing.assert_array_equal(np.array(table[name].to_pylist(), np.float32), expected(name))
    np.testing.assert_array_equal(table["frame_index"], [*range(30), *range(12)])
    np.testing.assert_array_equal(table["index"], np.arange(42))
    np.testing.assert_array_equal(table["episode_index"], [0] * 30 + [1] * 12)
    np.testing.assert_array_equal(table["timestamp"], np.float32([*np.arange(30) / 75, *np.arange(12) / 75]))
    true = np.array([*(1.0 + np.arange(30) / 75), *(4.0 + np.arange(12) / 75)]) + 0.004 * np.isin(
        np.arange(42), [5, 35]
    )
    np.testing.assert_allclose(table["session_time"], true, rtol=0, atol=3e-9)
    np.testing.assert_array_equal(np.flatnonzero(table["next.done"]), [29, 41])
    np.testing.assert_array_equal(np.flatnonzero(table["next.success"]), [29])  # of episode 4 nobody knows


def test_what_is_left_out_is_told(written):
    notes = "\n".join(written[0].notes)
    assert "left out: 1 episodes of fewer than 2 ticks" in notes and "1 episodes discarded by the operator" in notes
    assert "0 of 40 steps took longer than 1.5 periods, and frames are up to 4.0 ms off" in notes
    assert "no rewards: 1 of 2 episodes have none" in notes and "next.reward" not in written[0].features
    card = (written[1] / "README.md").read_text()
    assert all(note[1:] in card for note in written[0].notes) and "2 episodes" in card and "emulated" in card


def test_names_units_and_statistics(written):
    info = json.loads((written[1] / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (2, 42, 75)
    state, action = info["features"]["observation.state"], info["features"]["action"]
    assert state["names"][:4] == ["ball_x", "ball_y", "ball_z", "gantry_x"] and state["shape"] == [11]
    assert state["units"][-1] == "rad" and action["units"][0] == "m/s" and action["names"][-1] == "joint_6"
    stats = json.loads((written[1] / "meta" / "stats.json").read_text())["observation.state"]
    values = expected("observation.state").astype(float)
    np.testing.assert_allclose(stats["mean"], values.mean(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(stats["std"], values.std(axis=0), rtol=0, atol=1e-12)
    np.testing.assert_allclose(stats["q50"], np.median(values, axis=0), rtol=0, atol=1e-12)
    assert stats["count"] == [42] and stats["max"] == values.max(axis=0).tolist()


def flight(count: int, rate: float, start=0.0) -> list[tuple[float, ...]]:
    """Samples of a ball in vacuum towards the robot."""
    t = start + np.arange(count) / rate
    s = t - start
    return list(zip(t, 0.1 + 0.2 * s, 1.2 - 4.0 * s, 0.3 + 2.0 * s - 4.905 * s**2, strict=True))


@pytest.fixture
def balls(tmp_path):
    rows = [("a", "1", *row) for row in flight(60, 180.0)]
    rows += [("a", "2", *row) for row in flight(30, 180.0, 5.0) + flight(1, 180.0, 9.0)]
    path = tmp_path / "balls.csv"
    path.write_text("\n".join([",".join(COLUMNS), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_measured_balls_are_flights_at_the_control_rate(balls, tmp_path):
    recording = recordings.read([str(balls)])
    assert [len(e.columns["next.done"]) for e in recording.episodes] == [25, 13] and recording.robot is None
    assert recording.notes == ("left out: 1 flights of fewer than 2 frames",)
    t = np.arange(25) / 75
    true = np.stack([0.1 + 0.2 * t, 1.2 - 4.0 * t, 0.3 + 2.0 * t - 4.905 * t**2], axis=1)
    np.testing.assert_allclose(
        recording.episodes[0].columns["observation.state"], true, rtol=0, atol=9.81 / 8 / 180**2 + 1e-9
    )
    lerobot.write(recording, tmp_path / "set")
    assert "There is no action" in (tmp_path / "set" / "README.md").read_text()


def read_by_lerobot(folder, out):
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(out.parent / "hub")}
    command = [PYTHON, "-c", READER, str(folder), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=out.parent, timeout=300)
    assert done.returncode == 0, done.stderr
    return np.load(out)


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON, reason="needs lerobot: pip install lerobot, or LEROBOT_PYTHON=/path/to/its/python")
def test_lerobots_own_reader_gives_the_values_back(written, balls, tmp_path):
    found = read_by_lerobot(written[1], tmp_path / "found.npz")
    for name in ("observation.state", "action", "sent"):
        np.testing.assert_array_equal(found[name], expected(name))
    np.testing.assert_array_equal(found["timestamp"], np.float32([*np.arange(30) / 75, *np.arange(12) / 75]))
    np.testing.assert_array_equal(np.flatnonzero(found["next.done"]), [29, 41])
    assert set(found["task"].tolist()) == {recordings.RETURN} and found["fps"] == 75
    assert found["episode/length"].tolist() == [30, 12] and found["episode/outcome"].tolist() == ["returned", ""]
    assert found["episode/source"].tolist() == ["monday.mcap, episode 1", "monday.mcap, episode 4"]
    np.testing.assert_array_equal(found["batched"], expected("observation.state"))
    past = expected("observation.state")[[max(k - 2, 0 if k < 30 else 30) for k in range(42)]]
    np.testing.assert_array_equal(found["past"][:, 0], past)  # an episode's first frame stands for those before it
    np.testing.assert_array_equal(found["last"], expected("observation.state")[30:])
    np.testing.assert_allclose(found["stats/action/mean"], expected("action").astype(float).mean(axis=0), atol=1e-12)
    assert str(found["kinds"]) == "{'observation.state': 'STATE', 'action': 'ACTION'}"
    assert "'joint_6'" in str(found["names"])
    lerobot.write(recordings.read([str(balls)]), tmp_path / "flights")
    again = read_by_lerobot(tmp_path / "flights", tmp_path / "flights.npz")
    assert again["observation.state"].shape == (38, 3) and set(again["task"].tolist()) == {recordings.FLIGHT}


def test_command(session, balls, tmp_path, capsys):
    out = tmp_path / "set"
    assert cli.main(["log", "lerobot", str(session), "--out", str(out)]) == 0
    assert f"{out}: 2 episodes, 42 frames at 75 Hz\nleft out: 1 episodes" in capsys.readouterr().out
    for arguments, words in (
        ([str(session)], "--out"),
        ([str(tmp_path / "none.mcap"), "--out", "x"], "no such file"),
        ([str(session), str(balls), "--out", "x"], "balls.csv: no session"),
        ([str(session), "--out", str(out)], "not an empty folder"),
    ):
        assert cli.main(["log", "lerobot", *arguments]) == 1
        assert words in capsys.readouterr().err
