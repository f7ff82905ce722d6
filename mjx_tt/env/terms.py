"""Reward and observation terms: a term is one function, marked by a decorator.

    @reward_term()  # of a ControlStep: the term is the mean over the control steps under the policy
    def calm_wrist(step):
        return -abs(step.command[7])

    @reward_term(per="ball")  # of a PlayedBall: the term is this number
    def deep(ball):
        return ball.returned * ball.landing[1]

    @observation_term()  # of what is Sensed: further rows of the observation
    def last_command(sensed):
        return sensed.command

Functions get JAX arrays with the batch on the last axes. They are traced once and compiled with everything else, so
they branch with ``jnp.where``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ballmodel.flight import PaddlePose
from mjx_tt.env.user_network import check_name
from mjx_tt.pytrees import pytree
from robot_io.limits import JointLimits

# One episode on the robot has plain numbers, a batch in simulation arrays (...).
Flag: TypeAlias = Bool[Array | np.ndarray, "*batch"] | np.bool_ | bool
Number: TypeAlias = Float[Array | np.ndarray, "*batch"] | np.floating | float


@pytree
class ControlStep:
    """One control period under the policy, as it is at its end. SI units, the batch last."""

    # what the policy saw, late and with noise: ball [m], joints [m, rad], then further observation terms
    observation: Float[Array, "observed *batch"]
    command: Float[Array, "joints *batch"]  # [m/s, rad/s] velocities after the limits
    acceleration: Float[Array, "joints *batch"]  # [m/s^2, rad/s^2] change of the command
    jerk: Float[Array, "joints *batch"]  # [m/s^3, rad/s^3] change of the acceleration
    joints: Float[Array, "joints *batch"]  # [m, rad] true positions
    blade: PaddlePose  # position [m], normal, velocity [m/s], angular_velocity [rad/s] of the blade's centre
    ball_position: Float[Array, "3 *batch"]  # [m] true
    ball_velocity: Float[Array, "3 *batch"]  # [m/s]
    bounced: Bool[Array, "*batch"]  # the ball has bounced on the robot's side
    table_gap: Float[Array, "*batch"]  # [m] least distance of arm or paddle to the table; not above 0: contact
    own_gap: Float[Array, "*batch"]  # [m] of the robot to itself
    blade_gap: Float[Array, "*batch"]  # [m] of the blade to the table
    limits: JointLimits = field(metadata={"static": True})  # of the robot
    period: float = field(metadata={"static": True})  # [s] of control


@pytree
class PlayedBall:
    """One ball once all is over. SI units, the batch last."""

    hit: Flag  # touched after its bounce
    crossed: Flag  # flew over the net plane after the hit
    returned: Flag  # and landed on the human's half
    net_height: Number  # [m] of its centre over the net plane where it crossed
    landing: Float[Array | np.ndarray, "2 *batch"]  # [m] x, y where it came down to the table's height
    closest: Number  # [m] least distance of ball and blade centre after the bounce
    steps: Number  # control steps under the policy
    peak_velocity: Float[Array | np.ndarray, "joints *batch"]  # [m/s, rad/s] highest commanded speeds
    fault: Flag = False  # the robot stopped itself; never in a single episode of the simulation


@pytree
class Sensed:
    """Measurements that the policy may see at a control step. SI units, the batch last."""

    ball: Float[Array, "3 *batch"]  # [m] as the tracker reports it, late and with noise
    joints: Float[Array, "joints *batch"]  # [m, rad] as the encoders report them, late
    command: Float[Array, "joints *batch"]  # [m/s, rad/s] of the control step before, after the limits; 0 at first


# What becomes of the sum over an episode's control steps.
REDUCTIONS: dict[str, Callable[[Array, Array], Array]] = {
    "mean": lambda total, steps: total / steps,
    "one_minus_mean": lambda total, steps: 1.0 - total / steps,
    "minus_sum": lambda total, steps: -total,
}


@dataclass(frozen=True)
class RewardTerm:
    """A reward term: a function of ``ControlStep`` (per "step") or of ``PlayedBall`` (per "ball"), and its weight.

    reduce: of a term per step, a key of ``REDUCTIONS``. Raises ValueError.
    """

    name: str
    function: Callable[[Any], Any]
    per: Literal["step", "ball"] = "step"
    reduce: str = "mean"
    weight: float = 0.0

    def __post_init__(self) -> None:
        check_name("reward term", self.name, "calm_wrist")
        for what, given, allowed in (("per", self.per, ("step", "ball")), ("reduce", self.reduce, tuple(REDUCTIONS))):
            if given not in allowed:
                raise ValueError(f"reward term {self.name!r}: {what} is {given!r}, allowed: {', '.join(allowed)}")

    def __call__(self, given: ControlStep | PlayedBall) -> Any:
        return self.function(given)


@dataclass(frozen=True)
class ObservationTerm:
    """An observation term: a function of ``Sensed`` that gives rows (k, ...), and what they are multiplied by."""

    name: str
    function: Callable[[Sensed], Any]
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_name("observation term", self.name, "last_command")

    def __call__(self, sensed: Sensed) -> Array:
        rows = jnp.asarray(self.function(sensed))
        return rows if self.weight == 1.0 else self.weight * rows


def reward_term(
    name: str = "", per: Literal["step", "ball"] = "step", reduce: str = "mean"
) -> Callable[[Callable[[Any], Any]], RewardTerm]:
    """Makes a function a reward term, by default of its own name; an experiment gives its weight: ``{NAME: 0.5}``."""
    return lambda function: RewardTerm(name or function.__name__, function, per, reduce)


def observation_term(name: str = "") -> Callable[[Callable[[Sensed], Any]], ObservationTerm]:
    """Makes a function an observation term, by default of its own name; an experiment asks for it: ``{NAME: 1.0}``."""
    return lambda function: ObservationTerm(name or function.__name__, function)
