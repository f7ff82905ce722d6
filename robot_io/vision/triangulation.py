"""What cameras see of a ball, and the place in space that several agree on, with its covariance and misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_io.vision.camera import Camera

ROUNDS = 2  # of Gauss-Newton from the point nearest to the rays


@dataclass(frozen=True, eq=False)
class Detection:
    """A ball in a picture.

    centre              (2,) [px] of its streak at mid-exposure
    covariance          (2, 2) [px^2] of the centre
    velocity            (2,) [px/s]
    velocity_deviation  [px/s] of each component
    probability         that it is a ball
    """

    centre: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray
    velocity_deviation: float
    probability: float


@dataclass(frozen=True, eq=False)
class Sight:
    """A place that detections of several cameras agree on.

    detections  one of each camera
    point       (3,) [m]
    covariance  (3, 3) [m^2]
    deviation   sum of squared pixel residuals over their variances, of 2 n - 3 degrees of freedom
    """

    detections: tuple[Detection, ...]
    point: np.ndarray
    covariance: np.ndarray
    deviation: float

    @property
    def probability(self) -> float:
        """Of the least sure detection."""
        return min(d.probability for d in self.detections)


def intersect(centres: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Points (..., 3) with the least squared distance from unit rays (..., n, 3) through centres (n, 3)."""
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    pull = np.einsum("...nij,nj->...i", across, centres)
    return np.linalg.solve(across.sum(-3), pull[..., None])[..., 0]


def triangulate(cameras: Sequence[Camera], detections: Sequence[Detection], floor: float) -> Sight | None:
    """The place that detections, one of each camera, are of; None where it is behind a camera.

    floor  [px] deviation that is added to every covariance: calibration and lens, which no detector knows of
    """
    rays = np.concatenate([c.rays(d.centre[None]) for c, d in zip(cameras, detections, strict=True)])
    point = intersect(np.stack([c.centre for c in cameras]), rays)
    weights = [np.linalg.inv(d.covariance + floor**2 * np.eye(2)) for d in detections]
    for _ in range(ROUNDS):
        if any(c.depth(point) <= 0.0 for c in cameras):
            return None
        information, pull = np.zeros((3, 3)), np.zeros(3)
        for camera, detection, weight in zip(cameras, detections, weights, strict=True):
            slope = camera.jacobian(point)
            information += slope.T @ weight @ slope
            pull += slope.T @ weight @ (detection.centre - camera.project(point))
        point = point + np.linalg.solve(information, pull)
    residuals = [d.centre - c.project(point) for c, d in zip(cameras, detections, strict=True)]
    deviation = sum(float(r @ w @ r) for r, w in zip(residuals, weights, strict=True))
    return Sight(tuple(detections), point, np.linalg.inv(information), deviation)


def predict_deviation(cameras: Sequence[Camera], points: np.ndarray, pixels: float) -> np.ndarray:
    """Largest standard deviation [m] (n,) of places (n, 3) for a pixel's; infinite where not all cameras see them."""
    seen = np.all([camera.sees(points) for camera in cameras], axis=0)
    out = np.full(len(points), np.inf)
    for i in np.flatnonzero(seen):
        slopes = np.concatenate([camera.jacobian(points[i]) for camera in cameras])
        out[i] = pixels * np.linalg.svd(np.linalg.pinv(slopes), compute_uv=False)[0]
    return out
