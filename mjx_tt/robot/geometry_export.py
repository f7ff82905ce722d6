"""Writes ``robot_io/safety/robot_geometry.json``: what the robot's side has to know of the MJCF to compute clearances.

    python -m mjx_tt.robot.geometry_export            writes the file
    python -m mjx_tt.robot.geometry_export --check    compares; exit status 1 when the shipped file is not current

The bridge runs without MuJoCo and without this package, hence a file. Lengths in metres, rounded to 1e-12.
"""

from __future__ import annotations

import json
import sys
from importlib import resources
from pathlib import Path

from mjx_tt.robot import geometry, robots
from mjx_tt.robot.robots import Robot


def text(described: Robot) -> str:
    """The file's content, one line per joint, capsule and list."""
    lines = []
    for key, value in geometry.describe(described.file, described.model()).items():
        if key in ("joints", "capsules"):
            entries = ",\n".join("    " + json.dumps(entry) for entry in value)
            lines.append(f'  "{key}": [\n{entries}\n  ]')
        else:
            lines.append(f'  "{key}": {json.dumps(value)}')
    return "{\n" + ",\n".join(lines) + "\n}\n"


def path() -> Path:
    """Path of the shipped file."""
    return Path(str(resources.files("robot_io.safety"))) / "robot_geometry.json"


def main(arguments: list[str]) -> int:
    if arguments not in ([], ["--check"]):
        print(
            f"unknown arguments {arguments}; usage: python -m mjx_tt.robot.geometry_export [--check]", file=sys.stderr
        )
        return 2
    wanted, file = text(robots.paper()), path()
    if arguments:
        current = file.exists() and file.read_text(encoding="utf-8") == wanted
        print(f"{file} is {'current' if current else 'not current: run python -m mjx_tt.robot.geometry_export'}")
        return 0 if current else 1
    file.write_text(wanted, encoding="utf-8")
    print(f"wrote {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
