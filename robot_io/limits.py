"""The kinematic limiter that every velocity command passes, in simulation and on the robot.

Rate limits alone do not keep position limits: the braking envelope does. A velocity v towards a limit at distance d is
allowed when the joint, after one more period at v, can still stop with the acceleration limit a:
    v dt + v^2 / (2 a) <= d   =>   v <= -a dt + sqrt((a dt)^2 + 2 a d)
A command inside the envelope can always be braked at a in the next period, so envelope and acceleration limit never
contradict each other. Written with array operators only, so that NumPy and JAX arrays both work.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from robot_io.contract import LIMITS, JointLimits


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
