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

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ballmodel.contact import TABLE
from mjx_tt.robot import model as robot
from mjx_tt.robot.clearance import BLADE_CAPSULES, SELF_PAIRS, TABLE_CAPSULES
from mjx_tt.robot.kinematics import centred_on_anchors
from robot_io.contract import JOINT_NAMES

FORMAT = 1
FLOOR = "floor"  # the MJCF's plane


def describe(model: mujoco.MjModel) -> dict:
    """The geometry as plain data, keys as documented in ``robot_io.safety.clearance``.

    Raises ValueError when the model's joints are not the contract's or the floor is missing.
    """
    chain = robot.chain_from_model(model)
    names = tuple(link.name for link in chain.links)
    if names != JOINT_NAMES:
        raise ValueError(f"the model's joints are {names}, the contract's are {JOINT_NAMES}")
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, FLOOR)
    if floor < 0:
        raise ValueError(f"the model has no geom named {FLOOR!r}")
    anchors = [np.array(link.anchor) for link in chain.links]
    return {
        "format": FORMAT,
        "joints": [
            {
                "name": link.name,
                "type": "slide" if link.slide else "hinge",
                "axis": _numbers(link.axis),
                "pos": _numbers(link.pos),
                "rot": _numbers(link.rot),
            }
            for link in centred_on_anchors(chain).links
        ],
        "capsules": [
            {
                "name": c.name,
                "joint": JOINT_NAMES[c.link],
                "p0": _numbers(c.p0 - anchors[c.link]),
                "p1": _numbers(c.p1 - anchors[c.link]),
                "radius": c.radius,
            }
            for c in robot.capsules(model)
            if c.link != robot.WORLD
        ],
        "table": {"centre": _numbers(TABLE.centre), "half": _numbers(TABLE.half)},
        "floor": float(model.geom_pos[floor, 2]),
        "table_capsules": list(TABLE_CAPSULES),
        "blade_capsules": list(BLADE_CAPSULES),
        "self_pairs": [[first, other] for first, others in SELF_PAIRS for other in others],
        "home": _numbers(robot.home_qpos(model)),
    }


def text(model: mujoco.MjModel) -> str:
    """The file's content, one line per joint, capsule and list."""
    lines = []
    for key, value in describe(model).items():
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
    wanted, file = text(robot.load_model()), path()
    if arguments:
        current = file.exists() and file.read_text(encoding="utf-8") == wanted
        print(f"{file} is {'current' if current else 'not current: run python -m mjx_tt.robot.geometry_export'}")
        return 0 if current else 1
    file.write_text(wanted, encoding="utf-8")
    print(f"wrote {file}")
    return 0


def _numbers(values: ArrayLike) -> list:
    """Nested lists, without rounding errors of rotations around 0."""
    return (np.round(np.asarray(values, float), 12) + 0.0).tolist()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
