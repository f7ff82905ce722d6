"""The smallest experiment that trains, evaluates and exports in seconds; all of its runs share one compiled update."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml


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
