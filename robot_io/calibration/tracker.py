"""Tracker to table: the rigid motion that takes what the tracker gave for known points to where they are.

One wrong point must not bend the others: the motion is found from the triple of points that most of the others agree
with (least median of squares), then by least squares over those that agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from robot_io.calibrated import LARGEST_TRACKER_RESIDUAL, TrackerCalibration

FEWEST = 5
MOST_TRIPLES = 2000
OUTLIER = 3.5  # robust deviations beyond which a point is not used
FINEST = 5e-4  # [m] least deviation that is taken for one
HANDED = 5.0  # times the residual that the mirror image's must be, to be sure which of them the frame is
SPREAD = 0.1  # [m] root mean square extent that points need in two directions


@dataclass(frozen=True)
class TrackerFit:
    """Found motion.

    residuals  (n,) [m] distance of every point
    used       (n,) points that agree
    deviation  (6,) standard deviations: of the position at the points' centre [m], of the rotation [rad]
    """

    calibration: TrackerCalibration
    residuals: np.ndarray
    used: np.ndarray
    deviation: np.ndarray


def fit(table: np.ndarray, seen: np.ndarray, date: str) -> TrackerFit:
    """The tracker's frame from points (n, 3) [m] of the table frame and what the tracker gave for them.

    Raises ValueError for too few points, on one line or in one plane, of which no majority agrees, and where the frame
    is mirrored.
    """
    n = len(table)
    if n < FEWEST:
        raise ValueError(f"{n} points with the ball's place; at least {FEWEST} are needed")
    extent = np.linalg.svd(table - table.mean(0), compute_uv=False) / np.sqrt(n)
    if extent[1] < SPREAD:
        raise ValueError(f"the points lie on one line, within {extent[1]:.3f} m; spread them over the table")
    triples = np.array(list(combinations(range(n), 3)))
    sides = table[triples[:, 1:]] - table[triples[:, :1]]
    triples = triples[np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > SPREAD**2]
    if len(triples) > MOST_TRIPLES:
        triples = triples[np.random.default_rng(0).choice(len(triples), MOST_TRIPLES, replace=False)]
    motion, residuals, used = _agreeing(table, seen, triples)
    _, mirrored, others = _agreeing(table, -seen, triples)
    if others.sum() > used.sum():
        raise ValueError(
            f"the tracker's frame is a mirror image of the table's: so {others.sum()} of {n} points agree, without it "
            f"{used.sum()}; one of its axes points the other way, or two are exchanged"
        )
    if np.median(residuals) > LARGEST_TRACKER_RESIDUAL:
        raise ValueError(f"no rigid motion fits: half of the points are {np.median(residuals):.3f} m off or more")
    if used.sum() < max(FEWEST, n / 2):
        raise ValueError(f"only {used.sum()} of {n} points agree with each other; measure them again")
    told, doubt = (max(float(np.sqrt((r[used] ** 2).mean())), FINEST) for r in (residuals, mirrored))
    if doubt < HANDED * told:
        raise ValueError(
            "the points that agree lie in one plane, so nothing tells the tracker's frame from its mirror image; put "
            "the ball on a stand of 0.1 m or more at some of the places"
        )
    rotation, position = motion
    variance = float((residuals[used] ** 2).sum()) / max(3 * int(used.sum()) - 6, 1)
    lever = table[used] - table[used].mean(0)
    inertia = (lever**2).sum() * np.eye(3) - lever.T @ lever
    turns = np.sqrt(variance * np.diag(np.linalg.inv(inertia)))
    found = TrackerCalibration(
        tuple(np.round(position, 6).tolist()),
        tuple(np.round(rotation.as_rotvec(), 7).tolist()),
        round(float(np.sqrt((residuals[used] ** 2).mean())), 6),
        int(used.sum()),
        date,
    )
    return TrackerFit(found, residuals, used, np.array([*[np.sqrt(variance / used.sum())] * 3, *turns]))


def _agreeing(
    table: np.ndarray, seen: np.ndarray, triples: np.ndarray
) -> tuple[tuple[Rotation, np.ndarray], np.ndarray, np.ndarray]:
    """The motion that most points agree with, every point's distance (n,) under it, and which agree (n,)."""
    residuals = _of_triples(table, seen, triples)
    for _ in range(5):
        used = residuals <= OUTLIER * max(1.4826 * float(np.median(residuals)), FINEST)
        motion = _motion(table, seen, np.flatnonzero(used))
        residuals = _distances(table, seen, motion)
    return motion, residuals, residuals <= OUTLIER * max(1.4826 * float(np.median(residuals)), FINEST)


def _motion(table: np.ndarray, seen: np.ndarray, rows: np.ndarray) -> tuple[Rotation, np.ndarray]:
    a, b = table[rows], seen[rows]
    rotation, _ = Rotation.align_vectors(a - a.mean(0), b - b.mean(0))
    return rotation, a.mean(0) - rotation.apply(b.mean(0))


def _of_triples(table: np.ndarray, seen: np.ndarray, triples: np.ndarray) -> np.ndarray:
    """Distances (n,) under the motion of that triple whose median is least."""
    a, b = table[triples], seen[triples]
    u, _, v = np.linalg.svd(np.swapaxes(a - a.mean(1, keepdims=True), 1, 2) @ (b - b.mean(1, keepdims=True)))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ v))[:, None]  # no mirror images
    turned = np.einsum("tij,tnj->tni", u @ v, seen - b.mean(1, keepdims=True))
    distances = np.linalg.norm(turned + a.mean(1, keepdims=True) - table, axis=2)
    return distances[np.median(distances, axis=1).argmin()]


def _distances(table: np.ndarray, seen: np.ndarray, motion: tuple[Rotation, np.ndarray]) -> np.ndarray:
    rotation, position = motion
    return np.linalg.norm(rotation.apply(seen) + position - table, axis=1)
