"""A robot's geometry as plain data: joints, capsules, table and floor, from which its own side computes clearances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from ballmodel.contact import TABLE
from mjx_tt.robot.chain import WORLD, chain_from_model
from mjx_tt.robot.kinematics import centred_on_anchors
from mjx_tt.robot.mjcf import capsules
from robot_io.robot_file import RobotFile
from robot_io.safety.clearance import FIXED

FORMAT = 1
FLOOR = "floor"  # the MJCF's plane


def describe(file: RobotFile, model: mujoco.MjModel) -> dict[str, Any]:
    """The geometry of the robot at the table as plain data, keys as documented in ``robot_io.safety.clearance``.

    Raises ValueError when the model's joints are not the contract's or the floor is missing.
    """
    chain, joints = chain_from_model(model), file.contract.joints
    names = tuple(link.name for link in chain.links)
    if names != joints:
        raise ValueError(f"the model's joints are {names}, the contract's are {joints}")
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
                "joint": FIXED if c.link == WORLD else joints[c.link],
                "p0": _numbers(c.p0 - (0.0 if c.link == WORLD else anchors[c.link])),
                "p1": _numbers(c.p1 - (0.0 if c.link == WORLD else anchors[c.link])),
                "radius": c.radius,
            }
            for c in capsules(model)
        ],
        "table": {"centre": _numbers(TABLE.centre), "half": _numbers(TABLE.half)},
        "floor": float(model.geom_pos[floor, 2]),
        "table_capsules": list(file.table),
        "blade_capsules": list(file.blade),
        "self_pairs": [list(pair) for pair in file.pairs],
        "home": _numbers(file.home),
    }


def _numbers(values: Sequence | np.ndarray) -> list:
    """Nested lists, without rounding errors of rotations around 0."""
    return (np.round(np.asarray(values, float), 12) + 0.0).tolist()
