"""Robot to table: base, joint zeros and paddle from touched points, by least squares through the kinematics.

Every number has a prior: nobody mounts a base a metre off, and what the poses cannot tell stays where it was. Which
combinations those are is said: of each, the data know less than the prior does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from robot_io.calibrated import LARGEST_ROBOT_RESIDUAL, Frame, RobotCalibration
from robot_io.contract import PAPER, Contract
from robot_io.safety.clearance import RobotGeometry

REST = (
    *(f"base {axis}" for axis in "xyz"),
    *(f"base turned about {axis}" for axis in "xyz"),
    *(f"paddle {axis}" for axis in "xyz"),
)
PRIOR_ZERO = 0.02  # standard deviation of the zero of a joint [rad]
PRIOR_REST = (0.01,) * 3 + (0.005,) * 3 + (0.002,) * 3  # [m], [rad], [m]
TOUCH = 0.001  # [m] of a touch along each axis
FEWEST = 8
OUTLIER = 4.0  # robust deviations beyond which a touch is not used
FINEST = 0.001  # [m] least deviation that is taken for one
UNKNOWN = 3.0  # variance that the prior has over what the data leave, below which they do not tell a combination
NAMED = 0.3  # share of a combination from which on a number is named


@dataclass(frozen=True)
class RobotFit:
    """Found numbers.

    residuals   (n,) [m] distance of every touch
    used        (n,) touches that agree
    deviation   standard deviations in the order of ``names``, priors included
    unknown     combinations that the poses do not separate, in words
    """

    calibration: RobotCalibration
    residuals: np.ndarray
    used: np.ndarray
    deviation: np.ndarray
    unknown: tuple[str, ...]


def names(contract: Contract = PAPER) -> tuple[str, ...]:
    """Names of the numbers that are found: zeros of the arm's joints, base and paddle."""
    return (*(f"zero of {contract.joints[i]}" for i in contract.arm), *REST)


def fit(
    table: np.ndarray,
    joints: np.ndarray,
    paddle: np.ndarray,
    axes_zero: tuple[float, ...],
    date: str,
    contract: Contract = PAPER,
) -> RobotFit:
    """The robot's calibration from touches.

    table   (n, 3) [m] touched points in the table frame
    joints  (n, joints) what axes and controller report there, in the order of the contract
    paddle  (n, 3) [m] nominal touching points in the last joint's frame

    Raises ValueError for too few touches, or when no majority agrees.
    """
    n, shape, rows_of_arm = len(table), RobotGeometry.of(contract), list(contract.arm)
    a = len(rows_of_arm)  # zeros; then three numbers each of the base's place, its turn and the paddle
    prior = np.array((PRIOR_ZERO,) * a + PRIOR_REST)
    if n < FEWEST:
        raise ValueError(f"{n} touched points with joint positions; at least {FEWEST} are needed")

    def misses(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
        x = x * prior
        q = joints[rows].T.copy()
        q[rows_of_arm] += x[:a, None]
        hand = shape.hand(q)
        points = np.einsum("nij,nj->ni", hand[:, :3, :3], paddle[rows] + x[a + 6 :]) + hand[:, :3, 3]
        return Frame(tuple(x[a : a + 3]), tuple(x[a + 3 : a + 6])).outward(points) - table[rows]

    def cost(x: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.concatenate([(misses(x, rows) / TOUCH).ravel(), x])

    every = np.arange(n)
    solved = least_squares(cost, np.zeros(len(prior)), args=(every,), loss="cauchy", f_scale=2.0)
    for _ in range(3):
        residuals = np.linalg.norm(misses(solved.x, every), axis=1)
        used = residuals <= OUTLIER * max(1.4826 * float(np.median(residuals)) / 1.54, FINEST)
        if used.sum() < max(FEWEST, n / 2):
            raise ValueError(f"only {used.sum()} of {n} touches agree with each other; measure them again")
        solved = least_squares(cost, solved.x, args=(np.flatnonzero(used),))
    residuals = np.linalg.norm(misses(solved.x, every), axis=1)
    if np.median(residuals) > LARGEST_ROBOT_RESIDUAL:
        raise ValueError(f"no calibration fits: half of the touches are {np.median(residuals):.3f} m off or more")
    x = np.round(solved.x * prior, 7).tolist()
    found = RobotCalibration(
        tuple(x[a : a + 3]),
        tuple(x[a + 3 : a + 6]),
        tuple(x[:a]),
        tuple(x[a + 6 :]),
        axes_zero,
        round(float(np.sqrt((residuals[used] ** 2).mean())), 6),
        int(used.sum()),
        date,
    )
    deviation = prior * np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
    return RobotFit(found, residuals, used, deviation, _unknown(solved.jac[: -len(prior)], names(contract)))


def _unknown(jacobian: np.ndarray, numbers: tuple[str, ...]) -> tuple[str, ...]:
    """Combinations of which the data know less than the prior, from the scaled Jacobian (m, numbers)."""
    information, directions = np.linalg.eigh(jacobian.T @ jacobian)
    found = []
    for known, direction in zip(information, directions.T, strict=True):
        if known > UNKNOWN:
            continue
        direction = direction * np.sign(direction[np.abs(direction).argmax()])
        parts = [(s, name) for s, name in zip(direction, numbers, strict=True) if abs(s) > NAMED]
        found.append(" ".join(f"{'+' if s > 0 else '-'} {name}" for s, name in sorted(parts, key=lambda p: -abs(p[0]))))
    return tuple(text.removeprefix("+ ") for text in found)
