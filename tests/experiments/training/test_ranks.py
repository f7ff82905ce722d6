"""Several processes train one policy: the same bits as one process, and an end with a checkpoint when one is lost."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.runs import checkpoint
from experiments.runs.metrics import read
from experiments.training import ranks
from tests.support import one_node_slurm
from tests.support.one_node_slurm import free_ports
from tests.support.paths import ROOT
from tests.support.tiny_experiment import TRAINING, assert_same_run, wait_for, write_tiny

UPDATES = 120
PROGRAM = [sys.executable, "-c", "from experiments.cli import program; program()", "train"]


@pytest.fixture(scope="module")
def yaml(tmp_path_factory) -> Path:
    training = {"updates": UPDATES, "evaluate_every": 40, "evaluate_episodes": 16, "checkpoint_seconds": 1000}
    evaluation = {"episodes": 16, "sim_rate": 75.0}
    return write_tiny(tmp_path_factory.mktemp("experiment"), evaluation, devices="auto", **training)


def pair(*command: str) -> list[subprocess.Popen]:
    """Two processes, whose numbers end the command."""
    to_pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return [subprocess.Popen([*command, str(i)], cwd=ROOT, **to_pipes) for i in range(2)]


def address() -> str:
    return f"127.0.0.1:{free_ports(1)[0]}"


@pytest.fixture(scope="module")
def alone(yaml, tmp_path_factory) -> Path:
    """One process with two devices."""
    run = tmp_path_factory.mktemp("alone") / "tiny"
    done = subprocess.run([*TRAINING, str(yaml), str(run), "2"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return run


@pytest.mark.slow
def test_two_processes_are_one_with_two_devices(yaml, alone, tmp_path):
    together = ["--distributed", address(), "--processes", "2", "--process"]
    first, second = pair(*PROGRAM, str(yaml), "--out", str(tmp_path), *together)
    (said, errors), (silent, _) = first.communicate(timeout=300), second.communicate(timeout=300)
    assert (first.returncode, second.returncode) == (0, 0), errors
    assert "trained by 2 processes, ended by updates" in said and silent == ""
    assert_same_run(tmp_path / "tiny", alone, UPDATES)
    assert (tmp_path / "tiny" / "artefact" / "manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("victim, number", [(1, signal.SIGKILL), (0, signal.SIGKILL), (1, signal.SIGSTOP)])
def test_a_lost_process_ends_the_other_with_a_checkpoint(victim, number, yaml, alone, tmp_path):
    run = tmp_path / "tiny"
    processes = pair(*TRAINING, str(yaml), str(run), "1", address(), "2")
    try:
        wait_for(lambda: read(run / "metrics.jsonl"), processes[0])
        processes[victim].send_signal(number)
        lost = time.monotonic()
        _, errors = processes[1 - victim].communicate(timeout=60)
        assert time.monotonic() - lost < 30.0
        assert processes[1 - victim].returncode == 1
        assert "another process is" in errors and "The same command continues" in errors
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    kept = checkpoint.newest(run / "checkpoints")
    assert 0 < kept < UPDATES and f"checkpoint after update {kept} is kept" in errors
    resumed = subprocess.run([*TRAINING, str(yaml), str(run), "2"], cwd=ROOT, capture_output=True, text=True)
    assert resumed.returncode == 0 and f"continues after update {kept}" in resumed.stdout, resumed.stderr
    assert_same_run(run, alone, UPDATES)


@pytest.mark.slow
@pytest.mark.skipif(one_node_slurm.missing() != "", reason=one_node_slurm.missing())
def test_slurm_starts_the_processes(yaml, alone, tmp_path):
    with one_node_slurm.slurm(tmp_path / "slurm") as environment:
        command = ["srun", "-n", "2", *TRAINING, str(yaml), str(tmp_path / "tiny"), "1", "auto"]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert_same_run(tmp_path / "tiny", alone, UPDATES)


def test_the_watch_calls_once_signs_stop(monkeypatch):
    monkeypatch.setattr(ranks, "SILENCE", 0.6)
    called: list[float] = []
    with ranks.Ranks(2, 0).watch(called.append) as watchdog:  # type: ignore[arg-type] - it returns here
        time.sleep(1.2)
        assert not called, "before the first sign, which waits for compilations"
        for _ in range(8):
            watchdog.beat()
            time.sleep(0.2)
        assert not called
        watchdog.pause()
        time.sleep(1.2)
        assert not called, "nor in a pause"
        watchdog.beat()
        time.sleep(1.6)
        assert called and called[0] > 0.6
