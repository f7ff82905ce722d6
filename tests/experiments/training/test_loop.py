"""Trainings that are killed, stopped or meet a full disk: what they continue from is bit for bit what they left."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

from experiments.runs.metrics import read
from tests.support.paths import ROOT
from tests.support.tiny_experiment import TRAINING, assert_same_run, wait_for, write_tiny

UPDATES = 600


def start(yaml: Path, folder: Path, *limit: int) -> subprocess.Popen:
    command = [*TRAINING, str(yaml), str(folder), "1", *map(str, limit)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process: subprocess.Popen, status: int = 0) -> str:
    output, _ = process.communicate(timeout=300)
    assert process.returncode == status, output
    return output


def checkpoints(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("checkpoints/*")}


@pytest.fixture(scope="module")
def yaml(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("experiment")
    return write_tiny(folder, updates=UPDATES, evaluate_every=None, checkpoint_seconds=0.2)


@pytest.fixture(scope="module")
def uninterrupted(yaml, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    finish(start(yaml, folder))
    return folder


@pytest.mark.slow
def test_killed_at_random_and_resumed_equals_uninterrupted(yaml, uninterrupted, tmp_path):
    # Where it is killed is counted in updates, since computers differ in how many they make in a second.
    run, update, moment = tmp_path / "run", random.randint(1, UPDATES // 2), random.uniform(0.0, 0.02)
    killed = start(yaml, run)
    wait_for(lambda: any(run.glob("checkpoints/[0-9]*.npz")) and len(read(run / "metrics.jsonl")) >= update, killed)
    time.sleep(moment)
    killed.send_signal(signal.SIGKILL)
    finish(killed, -signal.SIGKILL)
    assert "continues after update" in finish(start(yaml, run))
    assert_same_run(run, uninterrupted, UPDATES)


@pytest.mark.slow
def test_terminated_then_full_disk_then_resumed(yaml, uninterrupted, tmp_path):
    """SIGTERM saves a checkpoint; a disk that takes no more is said so and costs nothing; then the run goes on."""
    folder = tmp_path / "run"
    process = start(yaml, folder)
    wait_for(lambda: any(folder.glob("checkpoints/[0-9]*.npz")), process)
    process.send_signal(signal.SIGTERM)
    assert "stopped after update" in finish(process, 1)
    before = checkpoints(folder)
    output = finish(start(yaml, folder, 12_000), 1)  # less than the four vectors of 976 numbers in a checkpoint
    for said in ("explained: ", "cannot be written: File too large", "the last checkpoint is whole"):
        assert said in output, output
    assert checkpoints(folder) == before  # and no temporary files
    finish(start(yaml, folder))
    assert_same_run(folder, uninterrupted, UPDATES)
