"""Forward kinematics of a chain, as element-wise operations over the batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ballmodel.flight import PaddlePose
from mjx_tt.lanes.functions import sin_cos
from mjx_tt.robot import scalar_algebra as f
from mjx_tt.robot.chain import WORLD, Chain, Frame

Controls: TypeAlias = Float[jax.Array, "actuators *batch"]  # in the actuators' units
Joints: TypeAlias = Float[jax.Array, "n *batch"]  # [m], [m/s] of slides, [rad], [rad/s] of hinges


LinkPose: TypeAlias = tuple[f.Matrix, f.Vector]  # rotation and origin of a link's frame, folded scalars


def centred_on_anchors(chain: Chain) -> Chain:
    """The same chain with every link's frame moved to its joint's anchor, so that anchors are zero."""
    links, parent_anchor = [], np.zeros(3)
    for link in chain.links:
        anchor = np.array(link.anchor)
        pos = np.array(link.pos) + np.array(link.rot) @ anchor - parent_anchor
        links.append(replace(link, anchor=f.ZERO3, pos=f.vector(pos), com=f.vector(np.array(link.com) - anchor)))
        parent_anchor = anchor
    return replace(chain, links=tuple(links))


def joint_transforms(chain: Chain, q: Joints) -> list[LinkPose]:
    """Pose of every link in its parent's frame at joint positions q (n, ...)."""
    sin, cos = f.optimization_barrier(sin_cos(q))  # of slides too: one loop over all joints is the cheapest
    transforms: list[LinkPose] = []
    for i, link in enumerate(chain.links):
        if link.slide:
            along = f.matvec(link.rot, link.axis)
            transforms.append((link.rot, f.vadd(link.pos, f.vscale(along, q[i]))))
            continue
        rot = f.matmul(link.rot, f.axis_rotation(link.axis, cos[i], sin[i]))
        # Where the entries are sine, cosine and their negatives there is nothing to store.
        transforms.append((rot if f.are_signs(link.rot, link.axis) else f.optimization_barrier(rot), link.pos))
    return transforms


class PaddleKinematics:
    """Poses of a chain's links, and pose and motion of the paddle's site, for joint states of shape (n, ...)."""

    def __init__(self, chain: Chain, site: Frame) -> None:
        self._chain = centred_on_anchors(chain)
        self._anchors = [np.array(link.anchor) for link in chain.links]
        self._site = site

    def links(self, q: Joints) -> list[LinkPose]:
        """World pose of every link, whose frame is at its joint's anchor."""
        poses: list[LinkPose] = []
        rot: f.Matrix = f.EYE3
        pos: f.Vector = f.ZERO3
        for r, p in joint_transforms(self._chain, q):
            pos = f.vadd(pos, f.matvec(rot, p))
            rot, pos = f.optimization_barrier((f.matmul(rot, r), pos))
            poses.append((rot, pos))
        return poses

    def point(self, poses: list[LinkPose], link: int, point: np.ndarray) -> f.Vector:
        """World coordinates, as folded scalars, of a point (3,) given in the frame of a link of the original chain."""
        if link == WORLD:
            return f.vector(point)
        rot, pos = poses[link]
        return f.vadd(pos, f.matvec(rot, f.vector(point - self._anchors[link])))

    def pose(self, q: Joints, qd: Joints) -> PaddlePose:
        """Blade centre [m], unit normal (the site's z axis), velocity [m/s], angular velocity [rad/s], each (3, ...).

        Goes from the site's link to the base, seen from each joint in turn: four vectors a joint, where going outwards
        takes a rotation matrix more.
        """
        links, transforms = self._chain.links, joint_transforms(self._chain, q)
        point: f.Vector = f.vector(self._site.pos - self._anchors[self._site.link])
        normal: f.Vector = f.vector(self._site.rot[:, 2])
        velocity: f.Vector = f.ZERO3
        spin: f.Vector = f.ZERO3
        for i in reversed(range(self._site.link + 1)):
            joint_velocity = f.vscale(links[i].axis, qd[i])
            if links[i].slide:
                velocity = f.vadd(velocity, joint_velocity)
            else:
                velocity = f.vadd(velocity, f.cross(joint_velocity, point))
                spin = f.vadd(spin, joint_velocity)
            rot, pos = transforms[i]
            point = f.vadd(f.matvec(rot, point), pos)
            normal, velocity, spin = (f.matvec(rot, x) for x in (normal, velocity, spin))
            if i % 3 == 0:  # storing every third is the cheapest
                point, normal, velocity, spin = f.optimization_barrier((point, normal, velocity, spin))
        return PaddlePose(*(stack(v, q[0]) for v in (point, normal, velocity, spin)))


def stack(values: Sequence[f.Scalar], like: Float[jax.Array, "*batch"]) -> Float[jax.Array, "n *batch"]:
    """Folded scalars as one array (len(values), ...) with the shape and type of ``like``."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), like.shape) for v in values])
