"""The table-tennis robot: its MuJoCo model, home pose, and the capsules that its clearances are computed from.

World frame: origin at the centre of the table's top surface, x across, y along the table towards the human, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources

import mujoco
import numpy as np

from mjx_tt.robot.chain import Frame, body_frames, site_frame

PADDLE_SITE = "paddle"  # centre of the blade: x along the extension, z out of the striking face
COLLISION_PREFIX = "col_"


@dataclass(frozen=True)
class Capsule:
    """A capsule fixed to a link: segment p0-p1, each (3,) [m] in the frame of ``link`` (``chain.WORLD``: world)."""

    name: str
    link: int
    p0: np.ndarray
    p1: np.ndarray
    radius: float  # [m]


def load_model() -> mujoco.MjModel:
    """The robot, table, net and a mocap ball, from the package's ``assets/scene.xml``."""
    with resources.as_file(resources.files("mjx_tt") / "assets") as assets:
        return mujoco.MjModel.from_xml_path(str(assets / "scene.xml"))


def home_qpos(model: mujoco.MjModel) -> np.ndarray:
    """Joint positions (8,) of the keyframe "home", the forehand pose. Raises ValueError when there is no such key."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    if key < 0:
        raise ValueError("the model has no keyframe named 'home'")
    return model.key_qpos[key].copy()


def paddle_frame(model: mujoco.MjModel) -> Frame:
    """The blade's centre in the frame of the link that carries it; column 2 of ``rot`` is the striking normal."""
    return site_frame(model, PADDLE_SITE)


def capsules(model: mujoco.MjModel) -> list[Capsule]:
    """Every capsule geom whose name starts with ``col_``, in the frame of its link."""
    frames = body_frames(model)
    found = []
    for geom in range(model.ngeom):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or ""
        if not name.startswith(COLLISION_PREFIX) or model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
            continue
        body = frames[model.geom_bodyid[geom]]
        rot = np.zeros(9)
        mujoco.mju_quat2Mat(rot, model.geom_quat[geom])
        radius, half_length = (float(s) for s in model.geom_size[geom, :2])
        centre = body.pos + body.rot @ model.geom_pos[geom]
        half = body.rot @ rot.reshape(3, 3)[:, 2] * half_length
        found.append(Capsule(name, body.link, centre - half, centre + half, radius))
    return found
