"""Joint limits, and the limiter that every velocity command passes, in simulation and on the robot.

Rate limits alone do not keep position limits: the braking envelope does. A velocity v towards a limit at distance d is
allowed when the joint, after one more period at v, can still stop with the acceleration limit a:
    v dt + v^2 / (2 a) <= d   =>   v <= -a dt + sqrt((a dt)^2 + 2 a d)
A command inside the envelope can always be braked at a in the next period, so envelope and acceleration limit never
contradict each other. Written with array operators only, so that NumPy and JAX arrays both work.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import numpy as np


@dataclass(frozen=True)
class JointLimits:
    """Kinematic limits of a robot's joints, each a tuple in the order of ``joints``; SI units.

    lower, upper      position range [m] / [rad]
    velocity          highest joint speed [m/s] / [rad/s]: what the hardware does (ABB 120T manual; Festo: estimate)
    acceleration      highest commanded acceleration [m/s^2] / [rad/s^2]
    margin            distance kept from lower and upper by the braking envelope [m] / [rad]
    policy_velocity   joint velocity that an action of 1 asks for; at most ``velocity``
    joints            names of the joints

    Raises ValueError naming the limit, the joint and what was given.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    margin: tuple[float, ...]
    policy_velocity: tuple[float, ...]
    joints: tuple[str, ...]

    def __post_init__(self) -> None:
        for name, values in self.numbers().items():
            if len(values) != len(self.joints):
                raise ValueError(
                    f"JointLimits.{name} needs {len(self.joints)} numbers in the order {self.joints}, got {len(values)}"
                )
            if not np.all(np.isfinite(values)):
                raise ValueError(f"JointLimits.{name} has a non-finite number: {values}")
        for i, joint in enumerate(self.joints):
            if not self.upper[i] - self.lower[i] > 2 * self.margin[i] >= 0:
                raise ValueError(
                    f"{joint}: range [{self.lower[i]}, {self.upper[i]}] leaves no room inside a margin of "
                    f"{self.margin[i]}"
                )
            if not 0 < self.policy_velocity[i] <= self.velocity[i]:
                raise ValueError(
                    f"{joint}: policy_velocity {self.policy_velocity[i]} must be in (0, {self.velocity[i]}]"
                )
            if not self.acceleration[i] > 0:
                raise ValueError(f"{joint}: acceleration {self.acceleration[i]} must be positive")

    def numbers(self) -> dict[str, tuple[float, ...]]:
        """The limits by name, without the joints' names."""
        return {name: values for name, values in asdict(self).items() if name != "joints"}


def _rad(*degrees: float) -> tuple[float, ...]:
    return tuple(float(np.deg2rad(d)) for d in degrees)


# Arm: ABB manual 3HAC035728 (ranges, 120T speeds). Accelerations: the base moments allow about 70 rad/s^2 on a
# stretched joint 1; wrist joints are lighter. Gantry: estimates (2 m and 1 m stroke, 2 m/s, 15 m/s^2),
# centred on the stroke.
LIMITS = JointLimits(
    lower=(-1.0, -0.5, *_rad(-165.0, -110.0, -110.0, -160.0, -120.0, -400.0)),
    upper=(1.0, 0.5, *_rad(165.0, 110.0, 70.0, 160.0, 120.0, 400.0)),
    velocity=(2.0, 2.0, *_rad(250.0, 250.0, 250.0, 420.0, 590.0, 600.0)),
    acceleration=(15.0, 15.0, 60.0, 60.0, 60.0, 100.0, 100.0, 120.0),
    margin=(0.01, 0.01, *_rad(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)),
    policy_velocity=(2.0, 2.0, *_rad(250.0, 250.0, 250.0, 420.0, 590.0, 600.0)),
    joints=("gantry_x", "gantry_y", "joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"),
)


def limit_velocity(
    request: Any, previous: Any, reference: Any, dt: float, limits: JointLimits = LIMITS, xp: ModuleType = np
) -> Any:
    """The velocity to command for the next ``dt`` seconds.

    request    (8, ...) wanted joint velocity [m/s], [rad/s]; finite
    previous   (8, ...) velocity commanded for the period before
    reference  (8, ...) commanded joint position at the start of the period [m], [rad]: the sum of commands times dt
    xp         the array module, numpy or jax.numpy

    Returns (8, ...). If ``previous`` and ``reference`` came from this function, the result keeps velocity, acceleration
    and position limits (less their margin).
    """
    column = (slice(None),) + (None,) * (request.ndim - 1)

    def bound(values: tuple[float, ...]) -> np.ndarray:
        return np.asarray(values, request.dtype)[column]

    a, v_max, margin = bound(limits.acceleration), bound(limits.velocity), bound(limits.margin)
    step = a * dt
    velocity = xp.clip(request, -v_max, v_max)
    velocity = xp.clip(velocity, previous - step, previous + step)
    above = bound(limits.upper) - margin - reference
    below = reference - bound(limits.lower) - margin
    v_up = xp.sqrt(xp.maximum(step * step + 2.0 * a * above, 0.0)) - step
    v_down = step - xp.sqrt(xp.maximum(step * step + 2.0 * a * below, 0.0))
    return xp.clip(velocity, v_down, v_up)
