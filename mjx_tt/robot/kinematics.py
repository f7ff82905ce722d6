"""Forward kinematics of a chain, as element-wise operations over the batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ballmodel.flight import PaddlePose
from mjx_tt.lanes.functions import sin_cos
from mjx_tt.pytrees import pytree
from mjx_tt.robot import scalar_algebra as f
from mjx_tt.robot.chain import WORLD, Chain, Frame

Joints: TypeAlias = Float[jax.Array, "n *batch"]  # [m], [m/s] of slides, [rad], [rad/s] of hinges


def centred_on_anchors(chain: Chain) -> Chain:
    """The same chain with every link's frame moved to its joint's anchor, so that anchors are zero."""
    links, parent_anchor = [], np.zeros(3)
    for link in chain.links:
        anchor = np.array(link.anchor)
        pos = np.array(link.pos) + np.array(link.rot) @ anchor - parent_anchor
        links.append(replace(link, anchor=f.ZERO3, pos=f.vector(pos), com=f.vector(np.array(link.com) - anchor)))
        parent_anchor = anchor
    return replace(chain, links=tuple(links))


def joint_transforms(chain: Chain, q: Joints) -> list[tuple[f.Matrix, f.Vector]]:
    """Rotation and origin of every link in its parent's frame at joint positions q (n, ...), folded scalars."""
    sin, cos = f.optimization_barrier(sin_cos(q))  # of slides too: one loop over all joints is the cheapest
    transforms: list[tuple[f.Matrix, f.Vector]] = []
    for i, link in enumerate(chain.links):
        if link.slide:
            along = f.matvec(link.rot, link.axis)
            transforms.append((link.rot, f.vadd(link.pos, f.vscale(along, q[i]))))
            continue
        rot = f.matmul(link.rot, f.axis_rotation(link.axis, cos[i], sin[i]))
        # Where the entries are sine, cosine and their negatives there is nothing to store.
        transforms.append((rot if f.are_signs(link.rot, link.axis) else f.optimization_barrier(rot), link.pos))
    return transforms


@pytree
class LinkPose:
    """World pose of one link's frame, folded scalars."""

    rot: f.Matrix
    pos: f.Vector


def forward(chain: Chain, q: Joints) -> list[LinkPose]:
    """World pose of every link of a chain that is ``centred_on_anchors``, at joint positions q (n, ...)."""
    poses: list[LinkPose] = []
    rot: f.Matrix = f.EYE3
    pos: f.Vector = f.ZERO3
    for r, p in joint_transforms(chain, q):
        pos = f.vadd(pos, f.matvec(rot, p))
        rot, pos = f.optimization_barrier((f.matmul(rot, r), pos))
        poses.append(LinkPose(rot, pos))
    return poses


def point_motion(
    chain: Chain, link: int, point: f.Vector, direction: f.Vector, q: Joints, qd: Joints
) -> tuple[f.Vector, f.Vector, f.Vector, f.Vector]:
    """World position and velocity of a point, direction and angular velocity of the link that it is fixed to.

    chain: ``centred_on_anchors``; point, direction: constants in the link's frame; q, qd: (n, ...).
    Goes from the link to the base, seen from each joint in turn: four vectors a joint, where going outwards takes a
    rotation matrix more. Folded scalars: position, direction, velocity, angular velocity.
    """
    transforms = joint_transforms(chain, q)
    velocity: f.Vector = f.ZERO3
    spin: f.Vector = f.ZERO3
    for i in reversed(range(link + 1)):
        joint_velocity = f.vscale(chain.links[i].axis, qd[i])
        if chain.links[i].slide:
            velocity = f.vadd(velocity, joint_velocity)
        else:
            velocity = f.vadd(velocity, f.cross(joint_velocity, point))
            spin = f.vadd(spin, joint_velocity)
        rot, pos = transforms[i]
        point = f.vadd(f.matvec(rot, point), pos)
        direction, velocity, spin = (f.matvec(rot, x) for x in (direction, velocity, spin))
        if i % 3 == 0:  # storing every third is the cheapest
            point, direction, velocity, spin = f.optimization_barrier((point, direction, velocity, spin))
    return point, direction, velocity, spin


def to_world(chain: Chain, poses: list[LinkPose], frame: Frame, point: ArrayLike) -> f.Vector:
    """World coordinates, as folded scalars, of a point given in ``frame`` (fixed to a link of the original chain)."""
    local = np.asarray(frame.pos) + np.asarray(frame.rot) @ np.asarray(point, float)
    if frame.link == WORLD:
        return f.vector(local)
    local = local - np.array(chain.links[frame.link].anchor)
    pose = poses[frame.link]
    return f.vadd(pose.pos, f.matvec(pose.rot, f.vector(local)))


class PaddleKinematics:
    """Pose and motion of the paddle's site for joint states of shape (n, ...)."""

    def __init__(self, chain: Chain, site: Frame) -> None:
        self._chain = chain
        self._centred = centred_on_anchors(chain)
        self._site = site

    def links(self, q: Joints) -> list[LinkPose]:
        return forward(self._centred, q)

    def point(self, poses: list[LinkPose], frame: Frame, point: ArrayLike) -> f.Vector:
        return to_world(self._chain, poses, frame, point)

    def pose(self, q: Joints, qd: Joints) -> PaddlePose:
        """Blade centre [m], unit normal (the site's z axis), velocity [m/s] and angular velocity [rad/s], each (3,
        ...)."""
        link = self._site.link
        centre = f.vector(np.asarray(self._site.pos) - np.array(self._chain.links[link].anchor))
        blade_normal = f.vector(np.asarray(self._site.rot)[:, 2])
        position, normal, velocity, spin = point_motion(self._centred, link, centre, blade_normal, q, qd)
        return PaddlePose(*(stack(v, q[0]) for v in (position, normal, velocity, spin)))


def stack(values: Sequence[f.Scalar], like: Float[jax.Array, "*batch"]) -> Float[jax.Array, "n *batch"]:
    """Folded scalars as one array (len(values), ...) with the shape and type of ``like``."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), like.shape) for v in values])
