"""The paper's eleven reward terms (appendix "Rewards in Simulation and the Real World"), named.

The paper gives names, ranges and weights; what each term measures in detail is ours and stands here.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

TERMS = (
    "state_transition",
    "net_clearance",
    "hit_and_land",
    "fault",
    "jerk",
    "acceleration",
    "velocity",
    "joint_angle",
    "collision",
    "paddle_height",
    "style",
)
SIM_WEIGHTS = dict(zip(TERMS, (1.0, 1.0, 0.1, 0.0, 0.3, 0.3, 0.4, 1.0, 1.0, 0.5, 1.0), strict=True))
REAL_WEIGHTS = dict(zip(TERMS, (1.0, 1.0, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), strict=True))

TARGET = (0.0, 0.685)  # [m] x, y: centre of the human's half
TARGET_RANGE = 0.7  # [m] e-folding distance of the bonus around the target
APPROACH_RANGE = 0.25  # [m] e-folding distance of the closest approach of paddle and ball
NET_TARGET = 0.35  # [m] height of the ball's centre over the net plane that earns the whole bonus
NET_RANGE = 0.25  # [m] deviation from it that earns exp(-1)
BLADE_CLEARANCE = 0.05  # [m] between blade and table below which the paddle counts as low
FACING = 0.3  # smallest y component of the blade's normal in good style (72 degrees from the table's axis)
SOFT_RANGE = 0.05  # share of a joint's range at each end that the joint-angle term counts as unsafe

# One episode on the robot has plain numbers, a batch in simulation arrays (...).
Flag = Bool[Array | np.ndarray, "*batch"] | np.bool_ | bool
Number = Float[Array | np.ndarray, "*batch"] | np.floating | float


def state_transition(
    closest: Number,
    hit: Flag,
    crossed: Flag,
    returned: Flag,
    landing: Float[Array | np.ndarray, "2 *batch"],
) -> Float[Array, "*batch"]:
    """Term 1, in [0, 5]: nearing the ball up to 3, hit 3, over the net 3.5, on the human's half 4, plus up to 1 more.

    closest [m]: least distance of ball and blade centre; landing [m]: where the outgoing ball came down to the
    table's height (anywhere). After a hit, coming down near the target is worth up to 0.5, and up to 1 once the ball
    lands on the human's half.
    """
    distance = jnp.hypot(landing[0] - TARGET[0], landing[1] - TARGET[1])
    near = jnp.exp(-distance / TARGET_RANGE)
    after_hit = 3.0 + jnp.where(returned, 1.0 + near, 0.5 * jnp.asarray(crossed).astype(near.dtype) + 0.5 * near)
    return jnp.where(hit, after_hit, 3.0 * jnp.exp(-closest / APPROACH_RANGE))


def net_clearance(hit: Flag, crossed: Flag, net_height: Number) -> Float[Array, "*batch"]:
    """Term 2, in [0, 1]: the outgoing ball's height over the net plane [m] against a target height."""
    bonus = jnp.exp(-(((net_height - NET_TARGET) / NET_RANGE) ** 2))
    return jnp.where(hit & crossed, bonus, 0.0)
