"""Runs that are killed, stopped or meet a full disk: what they continue from is bit for bit what they left."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.config.experiment import parse
from experiments.errors import CheckpointError, RunError
from experiments.runs import checkpoint
from experiments.runs.metrics import MetricsLog, read
from experiments.runs.run_dir import Run
from tests.support.paths import ROOT

UPDATES = 300
EXPERIMENT = """
name: tiny
balls: player5/M0
task: {max_steps: 60}
optimiser: {pairs: 2, repeats: 2}
training: {updates: %d, pool: 64, evaluate_every: null, checkpoint_seconds: 0.2, devices: 1}
"""
# The training itself without what follows it; a limit on the size of files stands for a full disk.
DRIVER = """
import resource, sys
from mjx_tt import platform
platform.configure(1)
from rich.console import Console
from experiments.config import build, experiment as config
from experiments.training import loop
from experiments.errors import explained
from experiments.runs.run_dir import Run
experiment = build.experiment(config.load(sys.argv[1]), sys.argv[1])
if len(sys.argv) > 3:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), resource.RLIM_INFINITY))
try:
    loop.train(experiment, Run(sys.argv[2]), Console())
except KeyboardInterrupt as stopped:
    sys.exit(f"stopped: {stopped}")
except Exception as error:
    if not explained(error):
        raise
    sys.exit(f"explained: {error}")
"""


def start(yaml: Path, folder: Path, *limit: int) -> subprocess.Popen:
    command = [sys.executable, "-c", DRIVER, str(yaml), str(folder), *map(str, limit)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen) -> str:
    output, _ = process.communicate(timeout=300)
    return output


def wait_for_checkpoint(process: subprocess.Popen, folder: Path) -> None:
    while not list(folder.glob("checkpoints/[0-9]*.npz")):
        if process.poll() is not None:
            pytest.fail(f"ended before its first checkpoint: {finish(process)}")
        time.sleep(0.01)


@pytest.fixture(scope="module")
def yaml(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("experiment") / "tiny.yaml"
    path.write_text(EXPERIMENT % UPDATES)
    return path


@pytest.fixture(scope="module")
def uninterrupted(yaml, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    process = start(yaml, folder)
    output = finish(process)
    assert process.returncode == 0, output
    return folder


def assert_same_run(folder: Path, reference: Path) -> None:
    """The last checkpoints agree in every bit of every array, and the measurements of every update agree."""
    (arrays, notes), (expected, expected_notes) = (
        checkpoint.read_latest(f / "checkpoints") for f in (folder, reference)
    )
    assert notes["update"] == expected_notes["update"] == UPDATES
    assert arrays.keys() == expected.keys()
    assert {"bgs.theta", "bgs.average", "statistics.mean", "statistics.count", "key"} <= arrays.keys()
    for name, array in arrays.items():
        assert array.dtype == expected[name].dtype and array.tobytes() == expected[name].tobytes(), name
    rows, expected_rows = ([row | {"seconds": 0} for row in read(f / "metrics.jsonl")] for f in (folder, reference))
    assert [row["update"] for row in rows] == list(range(1, UPDATES + 1))
    assert rows == expected_rows


def test_killed_at_random_and_resumed_equals_uninterrupted(yaml, uninterrupted, tmp_path):
    delay = random.uniform(0.0, 1.0)
    killed = start(yaml, tmp_path / "run")
    wait_for_checkpoint(killed, tmp_path / "run")
    time.sleep(delay)
    killed.send_signal(signal.SIGKILL)
    finish(killed)
    assert killed.returncode == -signal.SIGKILL, f"ended before it was killed, {delay} s after its first checkpoint"
    resumed = start(yaml, tmp_path / "run")
    output = finish(resumed)
    assert resumed.returncode == 0, output
    assert "continues after update" in output
    assert_same_run(tmp_path / "run", uninterrupted)


@pytest.mark.slow
def test_terminated_then_full_disk_then_resumed(yaml, uninterrupted, tmp_path):
    """SIGTERM saves a checkpoint; a disk that takes no more is said so and costs nothing; then the run goes on."""
    folder = tmp_path / "run"
    process = start(yaml, folder)
    wait_for_checkpoint(process, folder)
    process.send_signal(signal.SIGTERM)
    output = finish(process)
    assert "stopped after update" in output and process.returncode == 1, output
    before = {path.name: path.read_bytes() for path in folder.glob("checkpoints/*")}

    full = start(yaml, folder, 12_000)  # less than the four vectors of 976 numbers in a checkpoint
    output = finish(full)
    assert full.returncode == 1, output
    assert "explained: " in output and "cannot be written: File too large" in output, output
    assert "the last checkpoint is whole" in output, output
    assert {path.name: path.read_bytes() for path in folder.glob("checkpoints/*")} == before  # and no temporary files

    resumed = start(yaml, folder)
    output = finish(resumed)
    assert resumed.returncode == 0, output
    assert_same_run(folder, uninterrupted)


def state(value: float) -> dict:
    return {"theta": jnp.full(2000, value, jnp.float32), "count": jnp.int32(7), "key": jax.random.key(3)}


def test_checkpoint_round_trip_keeps_the_last_two(tmp_path):
    for update in (1, 2, 10):
        checkpoint.save(tmp_path, update, state(update), {"seconds": 0.5})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00000002.npz", "00000010.npz"]
    loaded, notes = checkpoint.load_latest(tmp_path, state(0.0))
    assert notes == {"seconds": 0.5, "update": 10}
    assert loaded["count"].dtype == jnp.int32
    np.testing.assert_array_equal(loaded["theta"], np.full(2000, 10, np.float32))
    assert jax.random.uniform(loaded["key"]) == jax.random.uniform(jax.random.key(3))


def test_damaged_newest_checkpoint_falls_back_and_nothing_readable_is_an_error(tmp_path):
    assert checkpoint.load_latest(tmp_path, state(0.0)) is None
    checkpoint.save(tmp_path, 1, state(1.0), {})
    newest = checkpoint.save(tmp_path, 2, state(2.0), {})
    content = bytearray(newest.read_bytes())
    content[3000] ^= 1  # within theta: the archive's own checksum notices
    newest.write_bytes(content)
    assert checkpoint.load_latest(tmp_path, state(0.0))[1]["update"] == 1
    for path in tmp_path.iterdir():
        path.write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="no checkpoint can be read"):
        checkpoint.load_latest(tmp_path, state(0.0))


def test_checkpoint_of_another_program_is_refused(tmp_path):
    checkpoint.save(tmp_path, 1, state(1.0), {})
    with pytest.raises(CheckpointError, match=r"'theta'. is float32 .2000,., wanted is float32 .3,."):
        checkpoint.load_latest(tmp_path, state(1.0) | {"theta": jnp.zeros(3)})
    with pytest.raises(CheckpointError, match="this program's state is"):
        checkpoint.load_latest(tmp_path, {"theta": jnp.zeros(2000)})


def test_full_disk_leaves_the_last_checkpoint_whole(tmp_path):
    checkpoint.save(tmp_path, 1, state(1.0), {})
    before = (tmp_path / "00000001.npz").read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(
            CheckpointError, match="00000002.npz: cannot be written: File too large; the last checkpoint is whole"
        ):
            checkpoint.save(tmp_path, 2, state(2.0), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert os.listdir(tmp_path) == ["00000001.npz"]
    assert (tmp_path / "00000001.npz").read_bytes() == before


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="Not a directory; there is no earlier checkpoint"):
        checkpoint.save(tmp_path / "file" / "checkpoints", 1, state(1.0), {})


def test_metrics_continue_after_the_checkpoint(tmp_path):
    path, board = tmp_path / "metrics.jsonl", tmp_path / "board"
    log = MetricsLog(path, board, 0)
    log.write([{"update": i, "loss": float(i)} for i in (1, 2, 3)])
    log.close()
    with open(path, "a") as file:
        file.write('{"update": 4, "lo')  # killed in the middle of a line
    log = MetricsLog(path, board, 2)
    log.write([{"update": 3, "loss": 30.0}])
    log.close()
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"update": 1, "loss": 1.0},
        {"update": 2, "loss": 2.0},
        {"update": 3, "loss": 30.0},
    ]
    assert len(list(board.glob("events.*"))) == 2


def test_a_start_without_an_update_does_not_block_the_corrected_one(tmp_path):
    """Until the first measurement or checkpoint the folder belongs to nobody; from then on it does."""
    run = Run(tmp_path / "run")
    wrong, right, third = (parse({"name": "a", "balls": balls}, "a.yaml") for balls in ("large", "narrow", "medium"))
    run.open(wrong)
    MetricsLog(run.metrics, run.tensorboard, 0).close()  # made before the first update
    run.check(right)
    run.open(right)
    assert run.config() == right and len(json.loads((run.folder / "run.json").read_text())) == 2
    run.metrics.write_text('{"update": 1}\n')
    with pytest.raises(RunError, match="balls: the run has 'narrow', now 'medium'"):
        run.open(third)
    run.metrics.write_text("")
    checkpoint.save(run.checkpoints, 1, state(1.0), {})
    with pytest.raises(RunError, match="belongs to another configuration"):
        run.check(third)
    for path in run.checkpoints.iterdir():
        path.unlink()
    (run.folder / "journal.jsonl").write_text("{}\n")  # of a fine-tuning, whose balls a person has played
    with pytest.raises(RunError, match="belongs to another configuration"):
        run.check(third)


def test_a_run_that_has_just_begun_keeps_its_configuration(tmp_path):
    run = Run(tmp_path / "run")
    mine, other = (parse({"name": "a", "balls": balls}, "a.yaml") for balls in ("narrow", "large"))
    run.open(mine)
    with run.locked(), pytest.raises(RunError, match="another process is training here"):
        Run(run.folder).open(other)
    assert run.config() == mine
