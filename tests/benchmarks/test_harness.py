"""A side in a process of its own that does not answer in time."""

from __future__ import annotations

import pytest

from benchmarks.harness import Worker, WorkerError


def test_a_side_is_ended_at_its_limit():
    """Python and MuJoCo alone take longer to start."""
    with pytest.raises(WorkerError, match=r"mujoco_rollout: no answer within 0.05 s"):
        with Worker("mujoco_rollout", limit=0.05, robots=1, steps=4, threads=1) as worker:
            worker.wait_ready()


def test_a_side_within_its_limit_does_its_work():
    with Worker("mujoco_rollout", limit=120.0, robots=2, steps=4, threads=1) as worker:
        assert "version" in worker.wait_ready()
        worker.start()
        assert worker.finish() == 2 * 4
    assert worker.peak_memory > 10.0
