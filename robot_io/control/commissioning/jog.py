"""Small motions that a person asks for, one joint or the blade, at a low speed and through the safety gate."""

from __future__ import annotations

import numpy as np

from robot_io.contract import FESTO_JOINTS, N_JOINTS
from robot_io.errors import RefusedError
from robot_io.safety.clearance import RobotGeometry

SPEED = 0.03  # share of the policy's velocity limits
LARGEST = np.array([0.02 if i in FESTO_JOINTS else 0.05 for i in range(N_JOINTS)])  # [m], [rad] of a step
LARGEST_BLADE = 0.02  # [m]
MISSED = 0.2  # share of a step of the blade that its points may miss it by
TINY = 1e-4  # of a joint, for the Jacobian
DAMPING = 1e-3


def joints_of(step: np.ndarray, geometry: RobotGeometry, q: np.ndarray) -> np.ndarray:
    """Step (8,) of the joints at q (8,) for one of theirs or, (3,) [m], of the blade. Raises RefusedError."""
    return blade_step(geometry, q, step) if np.shape(step) == (3,) else joint_step(step)


def joint_step(step: np.ndarray) -> np.ndarray:
    """A step (8,) that is small enough. Raises RefusedError."""
    step = np.asarray(step, float)
    if step.shape != (N_JOINTS,) or not np.isfinite(step).all() or (np.abs(step) > LARGEST).any():
        raise RefusedError(f"not jogged: a step of {step.tolist()}; at most 0.02 m and 0.05 rad at a time")
    return step


def blade_step(geometry: RobotGeometry, q: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Step (8,) of the joints at q (8,) that moves the blade by (3,) [m] without turning it.

    Shorter where a joint would move further than ``LARGEST``. Raises RefusedError.
    """
    step = np.asarray(step, float)
    if step.shape != (3,) or not np.linalg.norm(step) <= LARGEST_BLADE:
        raise RefusedError(f"not jogged: the blade by {step.tolist()} m; at most {LARGEST_BLADE} m at a time")
    beside = q[:, None] + TINY * np.concatenate([np.zeros((N_JOINTS, 1)), np.eye(N_JOINTS)], axis=1)
    points = geometry.blade_points(beside).reshape(-1, N_JOINTS + 1)  # x of each, then y, then z
    jacobian = (points[:, 1:] - points[:, :1]) / TINY
    wanted = np.repeat(step, len(points) // 3)
    found = np.linalg.solve(jacobian.T @ jacobian + DAMPING**2 * np.eye(N_JOINTS), jacobian.T @ wanted)
    missed = np.abs(jacobian @ found - wanted).max()
    if missed > MISSED * np.linalg.norm(step):
        raise RefusedError(f"not jogged: from here the blade cannot move like that ({1e3 * missed:.1f} mm off)")
    shorter = found / max(1.0, float((np.abs(found) / LARGEST).max()))
    return joint_step(np.clip(shorter, -LARGEST, LARGEST))  # which rounding may have missed
