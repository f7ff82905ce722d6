"""What a detector says of one ball in one picture, and what a detector is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


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


class BallDetector(Protocol):
    """Looks at the pictures of one camera, one after the other."""

    def detect(self, frame: np.ndarray, guesses: Sequence[np.ndarray] = ()) -> list[Detection]:
        """Balls in a raw frame (h, w) uint8, the surest first; guesses (2,) [px] say where they are expected."""
        ...
