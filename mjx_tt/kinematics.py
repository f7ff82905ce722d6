"""Where the links of a chain are and how fast they move, as element-wise operations over the batch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.flight import PaddlePose
from mjx_tt.chain import WORLD, Chain, Frame, Link
from mjx_tt.dynamics import fold as f


def centred_on_anchors(chain: Chain) -> Chain:
    """The same chain with every link's frame moved to its joint's anchor, so that anchors are zero."""
    links, parent_anchor = [], np.zeros(3)
    for link in chain.links:
        anchor = np.array(link.anchor)
        pos = np.array(link.pos) + np.array(link.rot) @ anchor - parent_anchor
        links.append(
            replace(link, anchor=f.ZERO3, pos=f.constants(pos), com=f.constants(np.array(link.com) - anchor))
        )
        parent_anchor = anchor
    return replace(chain, links=tuple(links))


def joint_transforms(chain: Chain, q) -> list:
    """Rotation and origin of every link in its parent's frame at joint positions q (n, ...), folded scalars."""
    sin, cos = f.materialise(f.sin_cos(q))  # of slides too: one loop over all joints is the cheapest
    transforms = []
    for i, link in enumerate(chain.links):
        if link.slide:
            along = f.matvec(link.rot, link.axis)
            transforms.append((link.rot, f.vadd(link.pos, f.vscale(along, q[i]))))
            continue
        rot = f.matmul(link.rot, f.axis_rotation(link.axis, cos[i], sin[i]))
        # Where the entries are sine, cosine and their negatives there is nothing to store.
        transforms.append((rot if f.are_signs(link.rot, link.axis) else f.materialise(rot), link.pos))
    return transforms


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LinkMotion:
    """World pose and velocity of one link's frame, folded scalars."""

    rot: tuple
    pos: tuple
    velocity: tuple | None
    angular_velocity: tuple | None


def forward(chain: Chain, q, qd=None) -> list[LinkMotion]:
    """World motion of every link of a chain that is ``centred_on_anchors``.

    q, qd: (n, ...) joint positions and velocities; without ``qd`` only poses are computed.
    """
    motions: list[LinkMotion] = []
    rot, pos, v, w = f.EYE3, f.ZERO3, f.ZERO3, f.ZERO3
    for i, (link, (r, p)) in enumerate(zip(chain.links, joint_transforms(chain, q))):
        offset = f.matvec(rot, p)
        if qd is not None:
            v = f.vadd(v, f.cross(w, offset))
        pos = f.vadd(pos, offset)
        rot = f.matmul(rot, r)
        if qd is not None:
            axis = f.matvec(rot, link.axis)
            if link.slide:
                v = f.vadd(v, f.vscale(axis, qd[i]))
            else:
                w = f.vadd(w, f.vscale(axis, qd[i]))
        rot, pos, v, w = f.materialise((rot, pos, v, w))
        motions.append(LinkMotion(rot, pos, v if qd is not None else None, w if qd is not None else None))
    return motions


def to_world(chain: Chain, motions: list[LinkMotion], frame: Frame, point) -> tuple:
    """World coordinates, as folded scalars, of a point given in ``frame`` (fixed to a link of the original chain)."""
    local = np.asarray(frame.pos) + np.asarray(frame.rot) @ np.asarray(point, float)
    if frame.link == WORLD:
        return f.constants(local)
    local = local - np.array(chain.links[frame.link].anchor)
    motion = motions[frame.link]
    return f.vadd(motion.pos, f.matvec(motion.rot, f.constants(local)))


class PaddleKinematics:
    """Pose and motion of the paddle's site for joint states of shape (n, ...)."""

    def __init__(self, chain: Chain, site: Frame) -> None:
        self._chain = chain
        self._centred = centred_on_anchors(chain)
        self._site = site

    def links(self, q, qd=None) -> list[LinkMotion]:
        return forward(self._centred, q, qd)

    def point(self, motions: list[LinkMotion], frame: Frame, point) -> tuple:
        return to_world(self._chain, motions, frame, point)

    def pose(self, q, qd) -> PaddlePose:
        """Blade centre [m], unit normal (the site's z axis), velocity [m/s] and angular velocity [rad/s], each (3, ...)."""
        return self.pose_of(forward(self._centred, q, qd), like=q[0])

    def pose_of(self, motions: list[LinkMotion], like) -> PaddlePose:
        """The same from links already computed; ``like`` gives the batch shape."""
        motion = motions[self._site.link]
        centre = to_world(self._chain, motions, self._site, np.zeros(3))
        normal = f.matvec(motion.rot, f.constants(np.asarray(self._site.rot)[:, 2]))
        velocity = f.vadd(motion.velocity, f.cross(motion.angular_velocity, f.vsub(centre, motion.pos)))
        return PaddlePose(*(stack(v, like) for v in (centre, normal, velocity, motion.angular_velocity)))


def stack(values, like):
    """Folded scalars as one array (len(values), ...) with the shape and type of ``like``."""
    return jnp.stack([jnp.broadcast_to(jnp.asarray(v, like.dtype), like.shape) for v in values])
