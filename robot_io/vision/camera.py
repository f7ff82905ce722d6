"""Pinhole cameras whose lens bends as OpenCV's five coefficients say, in the table's frame.

A point p [m] is seen at K bend(x / z, y / z), (x, y, z) = R p + t; a pixel's centre has whole coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

ROUNDS = 12  # of the fixed point that takes the lens's bend away; each gains about a digit at the picture's corner


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera.

    name         of it, as the rig calls it
    size         width and height [px]
    matrix       (3, 3): focal lengths and principal point [px], no skew
    distortion   (5,) k1, k2, p1, p2, k3
    rotation     (3, 3) world to camera; rows right, down and forward
    translation  (3,) [m] of the world's origin in the camera's frame
    """

    name: str
    size: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    @cached_property
    def centre(self) -> np.ndarray:
        """Where it stands (3,) [m]."""
        return -self.rotation.T @ self.translation

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distances (...) [m] of points (..., 3) along its axis; not positive: behind it."""
        return points @ self.rotation[2] + self.translation[2]

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) [m]; NaN for points behind it."""
        local = points @ self.rotation.T + self.translation
        depth = np.where(local[..., 2:] > 0.0, local[..., 2:], np.nan)
        return self._bend(local[..., :2] / depth) * self._focal + self._principal

    def jacobian(self, point: np.ndarray) -> np.ndarray:
        """d pixel / d point (2, 3) [px/m] at a point (3,) [m]."""
        x, y, z = self.rotation @ point + self.translation
        plane = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]])
        return self._focal[:, None] * (self._bend_jacobian(x / z, y / z) @ plane) @ self.rotation

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) in the world of pixels (n, 2)."""
        bent = (pixels - self._principal) / self._focal
        plane = bent
        for _ in range(ROUNDS):
            plane = plane + bent - self._bend(plane)
        local = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
        return local / np.linalg.norm(local, axis=-1, keepdims=True) @ self.rotation

    def sees(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Which points (...) of (..., 3) lie in the picture, at least ``margin`` [px] from its edges."""
        pixels = self.project(points)
        return np.asarray((pixels >= margin).all(-1) & (pixels <= np.array(self.size) - 1.0 - margin).all(-1))

    def moved(self, turn: np.ndarray, shift: np.ndarray) -> Camera:
        """The camera turned by a matrix (3, 3) in its own frame and shifted by (3,) [m] in the world."""
        rotation = turn @ self.rotation
        return replace(self, rotation=rotation, translation=-rotation @ (self.centre + shift))

    @cached_property
    def _focal(self) -> np.ndarray:
        return np.array([self.matrix[0, 0], self.matrix[1, 1]])

    @cached_property
    def _principal(self) -> np.ndarray:
        return self.matrix[:2, 2].copy()

    def _bend(self, plane: np.ndarray) -> np.ndarray:
        x, y = plane[..., 0], plane[..., 1]
        k1, k2, p1, p2, k3 = self.distortion
        r = x * x + y * y
        radial = 1.0 + r * (k1 + r * (k2 + r * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r + 2.0 * x * x),
                y * radial + p1 * (r + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            -1,
        )

    def _bend_jacobian(self, x: float, y: float) -> np.ndarray:
        k1, k2, p1, p2, k3 = self.distortion
        r = x * x + y * y
        radial = 1.0 + r * (k1 + r * (k2 + r * k3))
        slope = 2.0 * (k1 + r * (2.0 * k2 + 3.0 * r * k3))
        across = x * y * slope + 2.0 * (p1 * x + p2 * y)
        return np.array(
            [
                [radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, across],
                [across, radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x],
            ]
        )


def look_at(
    name: str,
    centre: tuple[float, float, float],
    target: tuple[float, float, float] = (0.0, 0.0, 0.1),
    focal: float = 1042.0,
    size: tuple[int, int] = (1280, 1024),
) -> Camera:
    """A camera at a centre [m] that looks at a target [m], its picture upright; a focal length [px], no distortion.

    1042 px are a lens of 5 mm over pixels of 4.8 um.
    """
    place = np.array(centre)
    forward = np.array(target) - place
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[focal, 0.0, size[0] / 2 - 0.5], [0.0, focal, size[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
    return Camera(name, size, matrix, np.zeros(5), rotation, -rotation @ place)
