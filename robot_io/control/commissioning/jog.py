"""Small motions that a person asks for, one joint or the blade, at a low speed and through the safety gate."""

from __future__ import annotations

import numpy as np

from robot_io.contract import JOINT_UNITS
from robot_io.errors import RefusedError
from robot_io.safety.clearance import RobotGeometry

SPEED = 0.03  # share of the policy's velocity limits
LARGEST = {"m": 0.02, "rad": 0.05}  # of a joint's step
LARGEST_BLADE = 0.02  # [m]
MISSED = 0.2  # share of a step of the blade that its points may miss it by
TINY = 1e-4  # of a joint, for the Jacobian
DAMPING = 1e-3


def joints_of(step: np.ndarray, geometry: RobotGeometry, q: np.ndarray) -> np.ndarray:
    """Step (n,) of the joints at q (n,) for one of theirs or, (3,) [m], of the blade. Raises RefusedError."""
    return blade_step(geometry, q, step) if np.shape(step) == (3,) else joint_step(step, geometry.units)


def joint_step(step: np.ndarray, units: tuple[str, ...] = JOINT_UNITS) -> np.ndarray:
    """A step (n,) that is small enough for joints with these units, "m" or "rad". Raises RefusedError."""
    step = np.asarray(step, float)
    if step.shape != (len(units),) or not np.isfinite(step).all() or (np.abs(step) > _largest(units)).any():
        raise RefusedError(f"not jogged: a step of {step.tolist()}; at most 0.02 m and 0.05 rad at a time")
    return step


def blade_step(geometry: RobotGeometry, q: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Step (n,) of the joints at q (n,) that moves the blade by (3,) [m] without turning it.

    Shorter where a joint would move further than ``LARGEST``. Raises RefusedError.
    """
    step = np.asarray(step, float)
    if step.shape != (3,) or not np.linalg.norm(step) <= LARGEST_BLADE:
        raise RefusedError(f"not jogged: the blade by {step.tolist()} m; at most {LARGEST_BLADE} m at a time")
    n, largest = len(geometry.units), _largest(geometry.units)
    beside = q[:, None] + TINY * np.concatenate([np.zeros((n, 1)), np.eye(n)], axis=1)
    points = geometry.blade_points(beside).reshape(-1, n + 1)  # x of each, then y, then z
    jacobian = (points[:, 1:] - points[:, :1]) / TINY
    wanted = np.repeat(step, len(points) // 3)
    found = np.linalg.solve(jacobian.T @ jacobian + DAMPING**2 * np.eye(n), jacobian.T @ wanted)
    missed = np.abs(jacobian @ found - wanted).max()
    if missed > MISSED * np.linalg.norm(step):
        raise RefusedError(f"not jogged: from here the blade cannot move like that ({1e3 * missed:.1f} mm off)")
    shorter = found / max(1.0, float((np.abs(found) / largest).max()))
    return joint_step(np.clip(shorter, -largest, largest), geometry.units)  # which rounding may have missed


def _largest(units: tuple[str, ...]) -> np.ndarray:
    return np.array([LARGEST[unit] for unit in units])
