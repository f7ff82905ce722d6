"""Clearances of the robot from the table and from itself, by capsules, as element-wise operations over the batch.

Segment to box: the squared distance is convex along the segment, its derivative is found zero by bisection. The robot's
own ``robot_io.safety.clearance``, with which a test compares both distances, branches, which would leave the vector
loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ballmodel.contact import TABLE, Box, box_gap
from ballmodel.vec import dot
from mjx_tt.pytrees import pytree
from mjx_tt.robot.kinematics import LinkPose, PaddleKinematics, stack
from mjx_tt.robot.mjcf import Capsule
from mjx_tt.robot.scalar_algebra import optimization_barrier
from robot_io.robot_file import RobotFile

PARALLEL = 1e-12  # segments more parallel than this are taken as parallel
BISECTIONS = 10  # of a link of 0.3 m: 0.3 mm along it, micrometres in distance


def segment_box_distance(
    box: Box, p: Float[jax.Array | np.ndarray, "3 *batch"], q: Float[jax.Array | np.ndarray, "3 *batch"]
) -> Float[jax.Array, "*batch"]:
    """Distance [m] between the segment p-q, ends (3, ...), and a box; 0 where they meet."""
    d = q - p
    low, high = jnp.zeros_like(p[0]), jnp.ones_like(p[0])
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        gap, _ = box_gap(box, 0.0, p + middle[None] * d)
        rising = dot(gap, d) > 0.0
        low, high = optimization_barrier((jnp.where(rising, low, middle), jnp.where(rising, middle, high)))
    best = jnp.zeros_like(p[0]) + jnp.inf
    for s in (jnp.zeros_like(low), 0.5 * (low + high), jnp.ones_like(low)):
        best = jnp.minimum(best, box_gap(box, 0.0, p + s[None] * d)[1])
    return best


def segment_distance(p1: jax.Array, q1: jax.Array, p2: jax.Array, q2: jax.Array) -> jax.Array:
    """Distance [m], (...), of segments p1-q1 and p2-q2, each end (3, ...).

    Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, b = dot(d1, d1), dot(d2, d2), dot(d1, d2)
    f, c = dot(d2, r), dot(d1, r)
    denominator = a * e - b * b
    s = jnp.where(denominator > PARALLEL, (b * f - c * e) / jnp.maximum(denominator, PARALLEL), 0.0)
    t = jnp.clip((b * jnp.clip(s, 0.0, 1.0) + f) / jnp.maximum(e, PARALLEL), 0.0, 1.0)
    s = jnp.clip((b * t - c) / jnp.maximum(a, PARALLEL), 0.0, 1.0)
    gap = r + s[None] * d1 - t[None] * d2
    return jnp.sqrt(dot(gap, gap))


@pytree
class Clearances:
    """Smallest gaps [m], (...); negative or zero: in contact."""

    table: Float[jax.Array, "*batch"]  # any capsule to the table
    own: Float[jax.Array, "*batch"]  # any listed pair of capsules
    blade: Float[jax.Array, "*batch"]  # the blade to the table


class CapsuleClearance:
    """Clearances of one robot; ``file`` names the capsules that are watched."""

    def __init__(self, kinematics: PaddleKinematics, capsules: list[Capsule], file: RobotFile) -> None:
        self._kinematics, self._file = kinematics, file
        self._capsules = {capsule.name: capsule for capsule in capsules}
        needed = {*file.table, *file.blade} | {name for pair in file.pairs for name in pair}
        missing = sorted(needed - self._capsules.keys())
        if missing:
            raise ValueError(f"the model lacks the capsules {missing}; it has {sorted(self._capsules)}")
        self._watched = needed

    def __call__(self, poses: list[LinkPose], like: Float[jax.Array, "*batch"]) -> Clearances:
        """Clearances from links' world poses (``PaddleKinematics.links``); ``like`` gives the batch shape."""

        def place(capsule: Capsule) -> tuple[jax.Array, jax.Array]:
            """World end points, each (3, ...)."""
            p, q = (stack(self._kinematics.point(poses, capsule.link, x), like) for x in (capsule.p0, capsule.p1))
            return p, q

        watched = {name: place(capsule) for name, capsule in self._capsules.items() if name in self._watched}
        ends = optimization_barrier(watched)
        batch = (1,) * like.ndim

        # Both ends (3, len(names), ...) and the radii (len(names), 1...).
        def gather(names: Sequence[str]) -> tuple[jax.Array, jax.Array, np.ndarray]:
            p, q = (jnp.stack([ends[name][end] for name in names], axis=1) for end in (0, 1))
            radii = np.array([self._capsules[name].radius for name in names], like.dtype)
            return *optimization_barrier((p, q)), radii.reshape(-1, *batch)

        file = self._file
        p, q, radius = gather(file.table)
        to_table = optimization_barrier(segment_box_distance(TABLE, p, q) - radius)
        blade = _least([to_table[file.table.index(name)] for name in file.blade])
        if not file.pairs:
            return Clearances(_least(to_table), jnp.full_like(blade, jnp.inf), blade)
        p1, q1, radius1 = gather([first for first, _ in file.pairs])
        p2, q2, radius2 = gather([second for _, second in file.pairs])
        own = segment_distance(p1, q1, p2, q2) - radius1 - radius2
        return Clearances(_least(to_table), _least(own), blade)


def _least(gaps: jax.Array | list[jax.Array]) -> jax.Array:
    """Minimum over the first axis, element-wise: as a reduction it would leave the vector loops."""
    return reduce(jnp.minimum, list(gaps))
