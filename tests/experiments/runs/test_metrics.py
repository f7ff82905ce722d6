"""Measurements of a training go on after its last checkpoint."""

from __future__ import annotations

import json

from experiments.runs.metrics import MetricsLog


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
