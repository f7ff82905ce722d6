"""A run's folder belongs to one configuration from its first measurement on; measurements go on after a checkpoint."""

from __future__ import annotations

import json

import jax.numpy as jnp
import pytest

from experiments.config.experiment import parse
from experiments.errors import RunError
from experiments.runs import checkpoint
from experiments.runs.metrics import MetricsLog
from experiments.runs.run_dir import Run


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
