"""The robot of the MJCF as a URDF in PyBullet, for comparison of speed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from mjx_tt.robot import mjcf


def urdf(model: mujoco.MjModel) -> str:
    """Joints, masses, inertias and damping of a chain of hinges and slides; no shapes.

    What URDF has no word for is left out: armature, joint limits of a robot that is commanded by velocity.
    """
    root = ElementTree.Element("robot", name="table_tennis")
    ElementTree.SubElement(root, "link", name="world")
    for joint in range(model.njnt):
        body = model.jnt_bodyid[joint]
        parent = model.body_parentid[body]
        kind = "prismatic" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "continuous"
        element = ElementTree.SubElement(root, "joint", name=model.joint(joint).name, type=kind)
        ElementTree.SubElement(element, "parent", link=model.body(parent).name)
        ElementTree.SubElement(element, "child", link=model.body(body).name)
        _origin(element, model.body_pos[body], model.body_quat[body])
        ElementTree.SubElement(element, "axis", xyz=_text(model.jnt_axis[joint]))
        ElementTree.SubElement(element, "dynamics", damping=repr(float(model.dof_damping[joint])), friction="0")
        if kind == "prismatic":  # lower > upper: unlimited
            ElementTree.SubElement(element, "limit", lower="1", upper="-1", effort="1e5", velocity="100")
        link = ElementTree.SubElement(root, "link", name=model.body(body).name)
        inertial = ElementTree.SubElement(link, "inertial")
        _origin(inertial, model.body_ipos[body], model.body_iquat[body])
        ElementTree.SubElement(inertial, "mass", value=repr(float(model.body_mass[body])))
        ixx, iyy, izz = (repr(float(i)) for i in model.body_inertia[body])
        ElementTree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
    return ElementTree.tostring(root, encoding="unicode")


class PyBulletRobot:
    """One robot in a world without gravity (the MJCF compensates it). Raises ImportError where PyBullet is missing."""

    def __init__(self, timestep: float) -> None:
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        model = mjcf.load_model()
        self.version = str(pybullet.getAPIVersion())
        self.client = BulletClient(pybullet.DIRECT)
        self.joints = list(range(model.njnt))
        self._home = mjcf.home_qpos(model)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(urdf(model), encoding="utf-8")
            self.body = self.client.loadURDF(str(path), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
        self.client.setTimeStep(timestep)
        self._mode = pybullet.VELOCITY_CONTROL

    def reset(self) -> None:
        for joint, position in zip(self.joints, self._home, strict=True):
            self.client.resetJointState(self.body, joint, position)

    def run(self, velocities: np.ndarray, steps: int) -> None:
        """Commands (8,) [m/s], [rad/s] and advances."""
        self.client.setJointMotorControlArray(self.body, self.joints, self._mode, targetVelocities=velocities)
        for _ in range(steps):
            self.client.stepSimulation()


def _origin(element: ElementTree.Element, position: np.ndarray, quaternion: np.ndarray) -> None:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    r = rotation.reshape(3, 3)
    pitch = -np.arcsin(np.clip(r[2, 0], -1, 1))
    if abs(r[2, 0]) > 1 - 1e-12:  # roll and yaw turn about one axis
        rpy = (0.0, pitch, np.arctan2(-r[0, 1], r[1, 1]))
    else:
        rpy = (np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0]))
    ElementTree.SubElement(element, "origin", xyz=_text(position), rpy=_text(rpy))


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
