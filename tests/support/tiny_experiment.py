"""The smallest experiment that trains, evaluates and exports in seconds; all of its runs share one compiled update."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen
from typing import Any

import yaml

from experiments.runs import checkpoint
from experiments.runs.metrics import read

# The training itself, without what follows it: YAML, folder, devices, [where, [processes, process]] as --distributed
# takes them; "where" may also be a number, a limit on the size of files, which stands for a full disk.
DRIVER = """
import resource, sys
from mjx_tt import platform
yaml, folder, devices, *where = sys.argv[1:]
platform.configure(int(devices))
from rich.console import Console
from experiments.config import build, experiment as config
from experiments.errors import explained
from experiments.runs.run_dir import Run
from experiments.training import loop, ranks
together = ranks.SINGLE
if where and where[0].isdigit():
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(where[0]), resource.RLIM_INFINITY))
elif where:
    together = ranks.join(where[0], *(map(int, where[1:]) if where[1:] else (None, None)))
try:
    with together.failing_fast():
        loop.train(build.experiment(config.load(yaml), yaml), Run(folder), Console(), together)
        together.disconnect()
except KeyboardInterrupt as stopped:
    sys.exit(f"stopped: {stopped}")
except Exception as error:
    if not explained(error):
        raise
    sys.exit(f"explained: {error}")
"""
TRAINING = [sys.executable, "-c", DRIVER]
# ``mjx-tt train`` as a whole; with this environment it draws no films, which take longest without a graphics card.
PROGRAM = [sys.executable, "-c", "from experiments.cli import program; program()", "train"]
NO_FILMS = os.environ | {"MUJOCO_GL": "disable"}


def write_tiny(folder: Path, evaluation: dict[str, Any] | None = None, **training: Any) -> Path:
    """Writes tiny.yaml into a folder and returns its path; keywords are keys of the section ``training``."""
    content = {
        "name": "tiny",
        "balls": "player5/M0",
        "task": {"max_steps": 60, "sim_rate": 75.0},
        "optimiser": {"num_directions": 2, "repeats": 2},
        "training": {"updates": 3, "pool": 64, "evaluate_episodes": 8, "devices": 1} | training,
        "evaluation": {"episodes": 8, "reachable_balls": None} | (evaluation or {}),
    }
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def assert_same_run(folder: Path, reference: Path, updates: int) -> None:
    """The last checkpoints agree in every bit of every array, and the measurements of every update agree."""
    (arrays, notes), (expected, expected_notes) = (
        checkpoint.read_latest(f / "checkpoints") for f in (folder, reference)
    )
    assert notes["update"] == expected_notes["update"] == updates
    assert arrays.keys() == expected.keys()
    assert {"bgs.theta", "bgs.average", "statistics.mean", "statistics.count", "key"} <= arrays.keys()
    for name, array in arrays.items():
        assert array.dtype == expected[name].dtype and array.tobytes() == expected[name].tobytes(), name
    rows, expected_rows = ([row | {"seconds": 0} for row in read(f / "metrics.jsonl")] for f in (folder, reference))
    assert [row["update"] for row in rows] == list(range(1, updates + 1))
    assert rows == expected_rows


def wait_for(condition: Callable[[], object], process: Popen | None = None, seconds: float = 240.0) -> None:
    """Waits until a condition holds, while a process that should bring it about lives."""
    until = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, f"ended too early: {process.communicate()}"
        assert time.monotonic() < until
        time.sleep(0.01)
