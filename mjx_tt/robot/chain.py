"""The constants of a serial chain of hinges and slides, read from a MuJoCo model, for engines that do not use MuJoCo.

A ``Chain`` describes exactly what MuJoCo C integrates with ``implicitfast``: every feature of the model that would
change the motion is either carried by ``Chain`` or refused by name. MuJoCo's conventions are kept: a joint turns about
(slides along) an axis through an anchor, both fixed in the frame of the body that the joint moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjx_tt.robot.checks import object_name, unsupported
from mjx_tt.robot.scalar_algebra import Constant, ConstantMatrix, matrix, vector

WORLD = -1  # link index of everything that does not move

_SLIDE, _AFFINE_BIAS = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtBias.mjBIAS_AFFINE)


@dataclass(frozen=True)
class Link:
    """One joint and the rigid body that it moves; every vector is in the link's own frame unless it says otherwise.

    At joint position q the link's frame in its parent link's frame has, with R(axis, q) the rotation about the axis,
        hinge: rotation  rot @ R(axis, q),  origin  pos + rot @ (anchor - R(axis, q) @ anchor)
        slide: rotation  rot,               origin  pos + rot @ axis * q
    Generalised force of the actuator: gain * ctrl[ctrl_index] + bias0 + bias_qpos * q + bias_qvel * qd.
    """

    name: str  # the joint's name
    slide: bool  # True: slide, q in m; False: hinge, q in rad
    axis: Constant  # unit vector
    anchor: Constant  # [m]
    pos: Constant  # origin in the parent link's frame at q = 0 [m]
    rot: ConstantMatrix  # rotation of this frame in the parent link's frame at q = 0
    mass: float  # [kg]; 0 for all but the last joint of a body with several joints
    com: Constant  # [m]
    inertia: ConstantMatrix  # about the centre of mass [kg m^2]
    armature: float  # [kg], [kg m^2]
    damping: float  # [N s/m], [N m s/rad]
    gravcomp: float  # fraction of this link's weight that is compensated at its centre of mass
    ctrl_index: int  # index into ctrl, -1 without an actuator
    gain: float
    bias0: float
    bias_qpos: float
    bias_qvel: float


@dataclass(frozen=True)
class Chain:
    """A serial chain, link 0 on the world. All tuples of floats: it is hashable and can be a static argument of jit."""

    links: tuple[Link, ...]
    gravity: Constant  # world frame [m/s^2]
    timestep: float  # [s]


@dataclass(frozen=True)
class Frame:
    """A frame fixed to a link: pos (3,) and rot (3, 3) in the frame of ``link`` (``WORLD`` when it never moves)."""

    link: int
    pos: np.ndarray
    rot: np.ndarray


def chain_from_model(model: mujoco.MjModel) -> Chain:
    """The model's only kinematic chain. Bodies without joints are merged into the link that carries them, a body with
    several joints becomes that many links, and joint references (``ref``) are folded into ``pos`` and ``rot``.

    Raises ValueError that lists, by name, every element that a ``Chain`` cannot represent.
    """
    frames = body_frames(model)
    problems = list(unsupported(model, [frame.link for frame in frames]))
    if problems:
        raise ValueError("the model is not a supported serial chain:\n  " + "\n  ".join(problems))
    actuator_of = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)}
    inertias = _merged_inertias(model, frames)
    links = []
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        parent = int(model.body_parentid[body])
        slide = model.jnt_type[joint] == _SLIDE
        axis, anchor = model.jnt_axis[joint], np.zeros(3) if slide else model.jnt_pos[joint]
        if joint == model.body_jntadr[body]:
            pos = frames[parent].pos + frames[parent].rot @ model.body_pos[body]
            rot = _snap(frames[parent].rot @ _quat_to_matrix(model.body_quat[body]))
        else:
            pos, rot = np.zeros(3), np.eye(3)
        ref = float(model.qpos0[joint])
        if slide:
            pos = pos - rot @ axis * ref
        elif ref:
            at_zero = _axis_rotation(axis, -ref)
            pos, rot = pos + rot @ (anchor - at_zero @ anchor), rot @ at_zero
        mass, com, inertia, gravcomp = inertias[joint]
        dof = int(model.jnt_dofadr[joint])
        links.append(
            Link(
                name=object_name(model, mujoco.mjtObj.mjOBJ_JOINT, joint),
                slide=bool(slide),
                axis=vector(axis),
                anchor=vector(anchor),
                pos=vector(pos),
                rot=matrix(rot),
                mass=mass,
                com=vector(com),
                inertia=matrix(inertia),
                armature=float(model.dof_armature[dof]),
                damping=float(model.dof_damping[dof]),
                gravcomp=gravcomp,
                **_actuation(model, actuator_of.get(joint)),
            )
        )
    return Chain(tuple(links), vector(model.opt.gravity), float(model.opt.timestep))


def body_frames(model: mujoco.MjModel) -> list[Frame]:
    """For every body of the model the link that carries it and its fixed place in that link's frame.

    Links are numbered as the model's joints, so the frame of a body with joints is that of its last joint.
    """
    frames = [Frame(WORLD, np.zeros(3), np.eye(3))]
    for body in range(1, model.nbody):
        if model.body_jntnum[body]:
            frames.append(Frame(int(model.body_jntadr[body] + model.body_jntnum[body] - 1), np.zeros(3), np.eye(3)))
        else:
            parent = frames[model.body_parentid[body]]
            frames.append(_fixed_child(parent, model.body_pos[body], model.body_quat[body]))
    return frames


def site_frame(model: mujoco.MjModel, name: str) -> Frame:
    """The site's frame in the link that carries it. Raises ValueError that lists the known sites for another name."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site < 0:
        known = [object_name(model, mujoco.mjtObj.mjOBJ_SITE, i) for i in range(model.nsite)]
        raise ValueError(f"the model has no site {name!r}; it has {known}")
    return _fixed_child(body_frames(model)[model.site_bodyid[site]], model.site_pos[site], model.site_quat[site])


def _fixed_child(parent: Frame, pos: np.ndarray, quat: np.ndarray) -> Frame:
    return Frame(parent.link, parent.pos + parent.rot @ pos, _snap(parent.rot @ _quat_to_matrix(quat)))


def _merged_inertias(model: mujoco.MjModel, frames: list[Frame]) -> list[tuple[float, np.ndarray, np.ndarray, float]]:
    """(mass, centre of mass, inertia about it, gravcomp) of every link, with the fixed bodies that it carries."""
    parts: list[list[tuple]] = [[] for _ in range(model.njnt)]
    for body in range(1, model.nbody):
        frame = frames[body]
        if frame.link == WORLD or model.body_mass[body] == 0:
            continue
        axes = _snap(frame.rot @ _quat_to_matrix(model.body_iquat[body]))
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        com = frame.pos + frame.rot @ model.body_ipos[body]
        parts[frame.link].append((float(model.body_mass[body]), com, inertia, float(model.body_gravcomp[body])))
    merged = []
    for bodies in parts:
        if len(bodies) == 1:
            merged.append(bodies[0])
            continue
        mass = sum(m for m, *_ in bodies)
        com = sum((m * c for m, c, *_ in bodies), np.zeros(3)) / (mass or 1.0)
        inertia = sum((i + m * _point_inertia(c - com) for m, c, i, _ in bodies), np.zeros((3, 3)))
        merged.append((mass, com, inertia, bodies[0][3] if bodies else 0.0))
    return merged


def _actuation(model: mujoco.MjModel, actuator: int | None) -> dict[str, Any]:
    """The fields of a ``Link`` from ``ctrl_index`` on."""
    if actuator is None:
        return dict(ctrl_index=-1, gain=0.0, bias0=0.0, bias_qpos=0.0, bias_qvel=0.0)
    gear = float(model.actuator_gear[actuator, 0])
    affine = model.actuator_biastype[actuator] == _AFFINE_BIAS
    bias0, qpos, qvel = (float(b) if affine else 0.0 for b in model.actuator_biasprm[actuator, :3])
    gain = gear * float(model.actuator_gainprm[actuator, 0])
    return dict(ctrl_index=actuator, gain=gain, bias0=gear * bias0, bias_qpos=gear**2 * qpos, bias_qvel=gear**2 * qvel)


def _snap(matrix: np.ndarray) -> np.ndarray:
    """Rounds the last bit off -1, 0 and 1, so that engines can omit multiplications by them."""
    nearest = np.round(matrix)
    return np.where(np.abs(matrix - nearest) < 1e-15, nearest + 0.0, matrix)


def _quat_to_matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return _snap(matrix.reshape(3, 3))


def _axis_rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    return _quat_to_matrix(quat)


def _point_inertia(r: np.ndarray) -> np.ndarray:
    return np.dot(r, r) * np.eye(3) - np.outer(r, r)
