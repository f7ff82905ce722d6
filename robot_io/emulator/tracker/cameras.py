"""Two cameras that see the ball as pixels: triangulated places, drop-outs, false sights and identity switches.

Errors are those of pixels, hence larger in depth than across, and larger far from the cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ballmodel.io.ranges import Within

Coordinate = Annotated[float, Within(-10.0, 10.0, "m")]
Place = tuple[Coordinate, Coordinate, Coordinate]
BESIDE = 0.1  # [m]


@dataclass(frozen=True)
class CameraParams:
    """Of the emulated tracker's two cameras; only where ``triangulated``, which replaces its ``noise``.

    triangulated  True: the ball's place is computed from two images
    first, second [m] where the cameras are in the table frame; they look at the table's centre
    focal         [pixels]; half_width, half_height [pixels] of the images, beyond which nothing is seen
    pixel_noise   [pixels] standard deviation of the ball's centre in an image
    drop_out      probability per frame that a camera loses the ball, for ``lost_for`` [s] on average
    false_sight   probability per frame that a camera takes something else for the ball, anywhere in its image
    switch        probability per frame that the tracker takes the ball for a new one and changes its number; it does so
                  after every drop-out longer than 0.1 s, too
    """

    triangulated: bool = False
    first: Place = (-2.6, -1.6, 2.2)
    second: Place = (2.6, -1.6, 2.2)
    focal: Annotated[float, Within(100.0, 10000.0, "px")] = 1000.0
    half_width: Annotated[float, Within(10.0, 10000.0, "px")] = 720.0
    half_height: Annotated[float, Within(10.0, 10000.0, "px")] = 540.0
    pixel_noise: Annotated[float, Within(0.0, 100.0, "px")] = 0.7
    drop_out: Annotated[float, Within(0.0, 1.0)] = 0.0
    lost_for: Annotated[float, Within(0.001, 10.0, "s")] = 0.05
    false_sight: Annotated[float, Within(0.0, 1.0)] = 0.0
    switch: Annotated[float, Within(0.0, 1.0)] = 0.0

    def __post_init__(self) -> None:
        for name in ("first", "second"):
            place = getattr(self, name)
            if math.hypot(*place[:2]) < BESIDE:
                raise ValueError(
                    f"{name}: expected a place at least {BESIDE} m beside the table's centre, got {place}; a camera "
                    "that looks straight down has no upper edge"
                )
        if math.dist(self.first, self.second) < BESIDE:
            raise ValueError(f"second: expected a place at least {BESIDE} m away from first, got {self.second}")


FORGOTTEN = 0.1  # [s] out of sight after which the ball gets another number


class CameraPair:
    """Places and numbers as two cameras make them; ``see`` once per frame."""

    def __init__(self, params: CameraParams, rate: float, random: np.random.Generator) -> None:
        self._params, self._rate, self._random = params, rate, random
        self._centres = np.array([params.first, params.second])
        self._axes = np.stack([_looking_at_table(centre) for centre in self._centres])
        self._lost = np.zeros(2, int)  # frames that a camera will not see
        self._added, self._unseen, self._number = 0, 0, -1

    def see(self, number: int, ball: np.ndarray | None) -> tuple[int, np.ndarray | None]:
        """Number and place (3,) [m] of the ball that is truly there, None where not both cameras see it."""
        place = None if ball is None else self._place(ball)
        if number != self._number:
            self._number, self._unseen = number, 0
        elif ball is not None and place is None:
            self._unseen += 1
        elif place is not None:
            forgotten = self._unseen > FORGOTTEN * self._rate
            self._added += forgotten or self._random.random() < self._params.switch
            self._unseen = 0
        return number + self._added, place

    def _place(self, ball: np.ndarray) -> np.ndarray | None:
        params, random = self._params, self._random
        self._lost = np.maximum(self._lost - 1, 0)
        ends = random.random(2) < params.drop_out
        self._lost = np.where(
            ends, np.maximum(random.geometric(1 / max(params.lost_for * self._rate, 1), 2), 1), self._lost
        )
        inside = np.array([params.half_width, params.half_height])
        rays = np.empty((2, 3))
        for i, (centre, axes) in enumerate(zip(self._centres, self._axes, strict=True)):
            x, y, depth = axes @ (ball - centre)
            pixel = params.focal * np.array([x, y]) / depth + params.pixel_noise * random.normal(size=2)
            if random.random() < params.false_sight:
                pixel = random.uniform(-inside, inside)
            if depth <= 0.0 or (np.abs(pixel) > inside).any() or self._lost[i]:
                return None
            rays[i] = axes.T @ np.array([*pixel, params.focal])
        return triangulated(self._centres, rays)


def triangulated(centres: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Point (3,) with the least squared distance from rays (n, 3) through centres (n, 3)."""
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    return np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, centres))


def _looking_at_table(centre: np.ndarray) -> np.ndarray:
    """Rows: right, down and forward of a camera that looks at the table's centre."""
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
