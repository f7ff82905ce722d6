"""Trainings that are killed, stopped or meet a full disk: what they continue from is bit for bit what they left."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.runs import checkpoint
from experiments.runs.metrics import read
from tests.support.paths import ROOT
from tests.support.tiny_experiment import write_tiny

UPDATES = 600
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


def updates_measured(folder: Path) -> int:
    metrics = folder / "metrics.jsonl"
    return metrics.read_bytes().count(b"\n") if metrics.exists() else 0


def wait_for_checkpoint(process: subprocess.Popen, folder: Path, updates: int = 0) -> None:
    """Wait for the first checkpoint, and until so many updates are measured."""
    while not list(folder.glob("checkpoints/[0-9]*.npz")) or updates_measured(folder) < updates:
        if process.poll() is not None:
            pytest.fail(f"ended before its first checkpoint and update {updates}: {finish(process)}")
        time.sleep(0.01)


@pytest.fixture(scope="module")
def yaml(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("experiment")
    return write_tiny(folder, updates=UPDATES, evaluate_every=None, checkpoint_seconds=0.2)


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


@pytest.mark.slow
def test_killed_at_random_and_resumed_equals_uninterrupted(yaml, uninterrupted, tmp_path):
    # Where it is killed is counted in updates, since computers differ in how many they make in a second.
    update, moment = random.randint(1, UPDATES // 2), random.uniform(0.0, 0.02)
    killed = start(yaml, tmp_path / "run")
    wait_for_checkpoint(killed, tmp_path / "run", update)
    time.sleep(moment)
    killed.send_signal(signal.SIGKILL)
    finish(killed)
    assert killed.returncode == -signal.SIGKILL, f"ended before it was killed, {moment} s after update {update}"
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
