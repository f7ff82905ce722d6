"""Folders of runs: whom they belong to, their measurements and checkpoints; policies that are found by name."""

from __future__ import annotations

import json
import os
import resource

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from experiments.config.experiment import parse
from experiments.errors import CheckpointError, RunError
from experiments.runs import checkpoint
from experiments.runs.locate import SHIPPED, artefact_of, find_policy
from experiments.runs.metrics import MetricsLog
from experiments.runs.run_dir import Run
from robot_io.policy import artefact


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
    checkpoint.save(run.checkpoints, 1, {"theta": jnp.zeros(3)}, {})
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


@pytest.mark.parametrize("name", ["quickstart", "rallies"])
def test_a_shipped_policy_is_found_by_its_name_and_answers_as_it_was_exported(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = artefact_of(name)
    assert folder == SHIPPED / name
    golden = np.load(folder / "golden.npz")
    session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
    answer = session.run(None, {session.get_inputs()[0].name: golden["history"].astype(np.float32)})[0]
    np.testing.assert_allclose(answer, golden["action"], atol=1e-5)
    assert artefact.load(folder).policy.theta.size == 976  # its checksums are as they were
    (tmp_path / name).mkdir()
    with pytest.raises(RunError, match="neither a run"):
        find_policy(name)
