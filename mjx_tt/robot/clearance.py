"""Clearances of the robot from the table and from itself, by capsules, as element-wise operations over the batch.

Segment to segment: Ericson, Real-Time Collision Detection, 2005, section 5.1.9. Segment to box: the squared distance is
convex along the segment, its derivative is found zero by bisection.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.contact import TABLE, Box, box_gap
from ballmodel.vec import TINY, dot
from mjx_tt.robot.chain import WORLD, Frame
from mjx_tt.robot.kinematics import PaddleKinematics, stack
from mjx_tt.robot.model import Capsule
from mjx_tt.robot.scalar_algebra import materialise

BISECTIONS = 10  # of a link of 0.3 m: 0.3 mm along it, micrometres in distance

# Pairs that joint limits let touch; neighbours along the arm never separate and are left out.
SELF_PAIRS = (
    ("col_base", ("col_forearm", "col_wrist", "col_blade_axis", "col_blade_cross")),
    ("col_upper_arm", ("col_wrist", "col_blade_axis", "col_blade_cross")),
    ("col_beam", ("col_forearm", "col_wrist", "col_blade_axis", "col_blade_cross")),
)
TABLE_CAPSULES = ("col_upper_arm", "col_forearm", "col_wrist", "col_blade_axis", "col_blade_cross")
BLADE_CAPSULES = ("col_blade_axis", "col_blade_cross")


def segment_distance(p1, q1, p2, q2):
    """Distance [m] between segments p1-q1 and p2-q2, each end (3, ...)."""
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, b = dot(d1, d1), dot(d2, d2), dot(d1, d2)
    f, c = dot(d2, r), dot(d1, r)
    denominator = a * e - b * b
    s = jnp.where(denominator > TINY, (b * f - c * e) / jnp.maximum(denominator, TINY), 0.0)
    t = jnp.clip((b * jnp.clip(s, 0.0, 1.0) + f) / jnp.maximum(e, TINY), 0.0, 1.0)
    s = jnp.clip((b * t - c) / jnp.maximum(a, TINY), 0.0, 1.0)
    gap = r + s * d1 - t * d2
    return jnp.sqrt(dot(gap, gap))


def segment_box_distance(box: Box, p, q):
    """Distance [m] between the segment p-q, ends (3, ...), and a box; 0 where they meet."""
    d = q - p
    low, high = jnp.zeros_like(p[0]), jnp.ones_like(p[0])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        gap, _ = box_gap(box, 0.0, p + middle * d)
        rising = dot(gap, d) > 0.0
        low, high = materialise((jnp.where(rising, low, middle), jnp.where(rising, middle, high)))
    best = jnp.zeros_like(p[0]) + jnp.inf
    for s in (jnp.zeros_like(low), 0.5 * (low + high), jnp.ones_like(low)):
        best = jnp.minimum(best, box_gap(box, 0.0, p + s * d)[1])
    return best


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Clearances:
    """Smallest gaps [m], (...); negative or zero: in contact."""

    table: jax.Array  # any capsule to the table
    own: jax.Array  # any listed pair of capsules
    blade: jax.Array  # the blade to the table


class CapsuleClearance:
    """Clearances of one robot."""

    def __init__(self, kinematics: PaddleKinematics, capsules: list[Capsule]) -> None:
        self._kinematics = kinematics
        self._capsules = {capsule.name: capsule for capsule in capsules}
        needed = {*TABLE_CAPSULES} | {n for first, others in SELF_PAIRS for n in (first, *others)}
        missing = sorted(needed - self._capsules.keys())
        if missing:
            raise ValueError(f"the model lacks the capsules {missing}; it has {sorted(self._capsules)}")

    def segments(self, motions, like) -> dict:
        """World end points, each (3, ...), of every capsule by name."""

        def ends(capsule: Capsule):
            frame = Frame(capsule.link, np.zeros(3), np.eye(3))
            return tuple(stack(self._kinematics.point(motions, frame, p), like) for p in (capsule.p0, capsule.p1))

        return {name: ends(capsule) for name, capsule in self._capsules.items() if capsule.link != WORLD}

    def __call__(self, motions, like) -> Clearances:
        """Clearances from links' world poses (``PaddleKinematics.links``); ``like`` gives the batch shape."""
        ends = materialise(self.segments(motions, like))
        batch = (1,) * like.ndim

        def gather(names):  # both ends (3, len(names), ...) and the radii (len(names), 1...)
            p, q = (jnp.stack([ends[name][end] for name in names], axis=1) for end in (0, 1))
            radii = np.array([self._capsules[name].radius for name in names], like.dtype)
            return *materialise((p, q)), radii.reshape(-1, *batch)

        p, q, radius = gather(TABLE_CAPSULES)
        to_table = materialise(segment_box_distance(TABLE, p, q) - radius)
        p1, q1, radius1 = gather([first for first, others in SELF_PAIRS for _ in others])
        p2, q2, radius2 = gather([other for _, others in SELF_PAIRS for other in others])
        own = segment_distance(p1, q1, p2, q2) - radius1 - radius2
        blade = [TABLE_CAPSULES.index(name) for name in BLADE_CAPSULES]
        return Clearances(_least(to_table), _least(own), _least([to_table[i] for i in blade]))


def _least(gaps):
    """Minimum over the first axis, element-wise: as a reduction it would leave the vector loops."""
    return reduce(jnp.minimum, list(gaps))
