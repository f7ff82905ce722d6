"""Checkpoints: what is read is what was written; a damaged one, another program's and a full disk."""

from __future__ import annotations

import os
import resource

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.errors import CheckpointError
from experiments.runs import checkpoint


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
