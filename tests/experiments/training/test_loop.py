"""Trainings that are killed, stopped or meet a full disk continue bit for bit from what they left.

Several processes train with the bits of one, and end with a checkpoint when one of them is lost.
"""

from __future__ import annotations

import random
import signal
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.runs import checkpoint
from experiments.runs.metrics import read
from experiments.training import ranks
from tests.support import one_node_slurm
from tests.support.one_node_slurm import free_ports
from tests.support.paths import ROOT
from tests.support.tiny_experiment import NO_FILMS, PROGRAM, TRAINING, assert_same_run, wait_for, write_tiny

UPDATES, FEW = 600, 120


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


# Several processes


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> Path:
    training = {"updates": FEW, "evaluate_every": 40, "evaluate_episodes": 16, "checkpoint_seconds": 1000}
    evaluation = {"episodes": 16, "sim_rate": 75.0}
    return write_tiny(tmp_path_factory.mktemp("experiment"), evaluation, devices="auto", **training)


def pair(*command: str) -> list[subprocess.Popen]:
    """Two processes, whose numbers end the command."""
    to_pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": NO_FILMS}
    return [subprocess.Popen([*command, str(i)], cwd=ROOT, **to_pipes) for i in range(2)]


def address() -> str:
    return f"127.0.0.1:{free_ports(1)[0]}"


@pytest.fixture(scope="module")
def alone(shared, tmp_path_factory) -> Path:
    """One process with two devices."""
    run = tmp_path_factory.mktemp("alone") / "tiny"
    done = subprocess.run([*TRAINING, str(shared), str(run), "2"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return run


@pytest.mark.slow
def test_two_processes_are_one_with_two_devices(shared, alone, tmp_path):
    together = ["--distributed", address(), "--processes", "2", "--process"]
    first, second = pair(*PROGRAM, str(shared), "--out", str(tmp_path), *together)
    (said, errors), (silent, _) = first.communicate(timeout=300), second.communicate(timeout=300)
    assert (first.returncode, second.returncode) == (0, 0), errors
    assert "trained by 2 processes, ended by updates" in said and silent == ""
    assert_same_run(tmp_path / "tiny", alone, FEW)
    assert (tmp_path / "tiny" / "artefact" / "manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("victim, number", [(1, signal.SIGKILL), (0, signal.SIGKILL), (1, signal.SIGSTOP)])
def test_a_lost_process_ends_the_other_with_a_checkpoint(victim, number, shared, alone, tmp_path):
    run = tmp_path / "tiny"
    processes = pair(*TRAINING, str(shared), str(run), "1", address(), "2")
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
    assert 0 < kept < FEW and f"checkpoint after update {kept} is kept" in errors
    resumed = subprocess.run([*TRAINING, str(shared), str(run), "2"], cwd=ROOT, capture_output=True, text=True)
    assert resumed.returncode == 0 and f"continues after update {kept}" in resumed.stdout, resumed.stderr
    assert_same_run(run, alone, FEW)


@pytest.mark.slow
@pytest.mark.skipif(one_node_slurm.missing() != "", reason=one_node_slurm.missing())
def test_slurm_starts_the_processes(shared, alone, tmp_path):
    with one_node_slurm.slurm(tmp_path / "slurm") as environment:
        command = ["srun", "-n", "2", *TRAINING, str(shared), str(tmp_path / "tiny"), "1", "auto"]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert_same_run(tmp_path / "tiny", alone, FEW)


def test_the_watch_calls_once_signs_stop(monkeypatch):
    """On a clock of its own."""
    called: list[float] = []
    now = [0.0]
    monkeypatch.setattr(ranks, "time", SimpleNamespace(monotonic=lambda: now[0]))
    watchdog = ranks.Watchdog(called.append)  # type: ignore[arg-type] - it returns here

    def watch(seconds: float, beats: bool = False) -> None:
        until = now[0] + seconds

        def wait(step: float) -> bool:
            now[0] += step
            if beats:
                watchdog.beat()
            return now[0] > until

        watchdog._over = SimpleNamespace(wait=wait)
        watchdog.run()

    watch(100.0)
    assert not called, "before the first sign, which waits for compilations"
    watch(100.0, beats=True)
    watchdog.pause()
    watch(100.0)
    assert not called, "nor while signs come, nor in a pause"
    watchdog.beat()
    watch(ranks.SILENCE + 1.0)
    assert called and called[0] > ranks.SILENCE
