"""The human ball distribution: 16 numbers that bound where balls start, how fast, and where they land.

Abeyruwan et al. 2022, "Modeling Human Ball Distributions": the minima and maxima of initial position (6), initial
velocity (6) and landing x and y on the robot's side (4), after DBSCAN took the outliers away. Velocities are signed
and in the table frame, so a ball towards the robot has vy < 0.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from jaxtyping import Bool, Float
from pydantic import BeforeValidator

from ballmodel.io.atomic_files import replacing
from ballmodel.io.validation import Finite, Increasing, Section, validate
from ballmodel.io.yaml import read as read_yaml
from ballmodel.state import BallState

AXES = {"position": ("x", "y", "z"), "velocity": ("x", "y", "z"), "landing": ("x", "y")}
EPS_FACTOR = 2.0


@dataclass(frozen=True)
class BallDistribution:
    """Box of start states and landing points; ``name`` and ``source`` say where it comes from.

    Raises ValueError for a number that is not finite or a minimum above its maximum.
    """

    position_min: tuple[float, float, float]  # [m]
    position_max: tuple[float, float, float]  # [m]
    velocity_min: tuple[float, float, float]  # [m/s]
    velocity_max: tuple[float, float, float]  # [m/s]
    landing_min: tuple[float, float]  # [m] x, y of the ball's first bounce
    landing_max: tuple[float, float]  # [m]
    name: str = ""
    source: str = ""
    short_balls: bool = False  # balls are drawn as well that would bounce a second time before the robot's end line

    def __post_init__(self) -> None:
        for part, axes in AXES.items():
            low, high = (tuple(float(v) for v in getattr(self, f"{part}_{end}")) for end in ("min", "max"))
            if not len(low) == len(high) == len(axes):
                raise ValueError(f"{self.name}: {part}: expected {len(axes)} numbers at each end, got {low}, {high}")
            for axis, a, b in zip(axes, low, high, strict=True):
                if not (np.isfinite(a) and np.isfinite(b) and a <= b):
                    raise ValueError(f"{self.name}: {part}.{axis}: expected finite numbers min <= max, got [{a}, {b}]")
            object.__setattr__(self, f"{part}_min", low)
            object.__setattr__(self, f"{part}_max", high)

    def to_dict(self) -> dict:
        """The YAML form: position, velocity and landing as {axis: [min, max]}."""
        intervals = {
            part: {
                axis: [low, high]
                for axis, low, high in zip(
                    axes, getattr(self, f"{part}_min"), getattr(self, f"{part}_max"), strict=True
                )
            }
            for part, axes in AXES.items()
        }
        short = {"short_balls": True} if self.short_balls else {}
        return {"name": self.name, "source": self.source, **intervals, **short}


Interval = Annotated[tuple[Finite, Finite], Increasing]
Text = Annotated[str, BeforeValidator(str)]


class Space(Section):
    """Ends of a quantity in space."""

    x: Interval
    """[min, max]."""
    y: Interval
    """[min, max]."""
    z: Interval
    """[min, max]."""


class Plane(Section):
    """Ends of a place on the table."""

    x: Interval
    """[min, max] in m."""
    y: Interval
    """[min, max] in m."""


class BallFile(Section):
    """Keys that the YAMLs of boxes and mixtures share."""

    name: Text | None = None
    """Name of the balls; null: the file's."""
    source: Text | None = None
    """Where they come from."""
    paper: Any = None
    """Notes on a published table."""
    short_balls: bool = False
    """Also balls that would bounce a second time before the robot's end line."""

    def labels(self, name: str, source: str) -> dict[str, Any]:
        """Fields that distributions and mixtures share; ``name`` and ``source`` stand in for missing ones."""
        return {
            "name": name if self.name is None else self.name,
            "source": source if self.source is None else self.source,
            "short_balls": self.short_balls,
        }


class BoxFile(BallFile):
    """The YAML of a box."""

    position: Space
    """[m] of the start."""
    velocity: Space
    """[m/s] at the start."""
    landing: Plane
    """Where the ball first bounces."""

    def box(self, name: str, source: str) -> BallDistribution:
        """The box; ``name`` and ``source`` stand in for missing ones."""
        ends: dict[str, Any] = {
            f"{part}_{end}": tuple(getattr(getattr(self, part), axis)[i] for axis in axes)
            for part, axes in AXES.items()
            for i, end in enumerate(("min", "max"))
        }
        return BallDistribution(**ends, **self.labels(name, source))


def parse_distribution(data: Any, where: str, name: str = "", source: str = "") -> BallDistribution:
    """Builds a distribution from its YAML form; ``where`` (file and key) opens every message. Raises ValueError."""
    return validate(BoxFile, data, where).box(name, source)


def load_distribution(path: str | os.PathLike) -> BallDistribution:
    """Reads one distribution from YAML. Raises ValueError naming file, key, what was given and what is allowed."""
    return parse_distribution(read_yaml(path), str(path), name=Path(path).stem)


def save_distribution(path: str | os.PathLike, distribution: BallDistribution) -> None:
    """Writes the distribution as YAML; an existing file is replaced only by a complete one."""
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(distribution.to_dict(), sort_keys=False), encoding="utf-8")


@dataclass(frozen=True)
class DistributionReport:
    """Outliers and settings of ``fit_distribution``."""

    n: int  # balls given
    outlier: Bool[np.ndarray, " n"]  # taken away by DBSCAN
    eps: float  # DBSCAN radius in robust standard deviations
    min_samples: int


def fit_distribution(
    states: BallState,
    landing: Float[np.ndarray, "2 n"],
    eps: float | None = None,
    min_samples: int = 5,
    name: str = "",
    source: str = "",
) -> tuple[BallDistribution, DistributionReport]:
    """Minima and maxima of balls without their outliers.

    states: position [m] and velocity [m/s] of the balls' starts, (3, n); landing: (2, n) [m].
    A ball is an outlier when DBSCAN puts it into no cluster. Its eight coordinates are first centred on the median and
    divided by a robust standard deviation (interquartile range / 1.349), so that outliers do not set their own scale.
    The paper gives neither eps nor min_samples. Without ``eps`` it is EPS_FACTOR times the median distance of a ball
    to its (min_samples - 1)-th neighbour, after Ester et al. 1996's k-distance, so that it follows the number of balls.
    Raises ValueError for non-finite input, unequal lengths, fewer than min_samples balls, or when all are outliers.
    """
    from sklearn.cluster import DBSCAN  # sklearn takes about a second to import; only this function needs it
    from sklearn.neighbors import NearestNeighbors

    position, velocity, landing = (np.asarray(a, float) for a in (states.position, states.velocity, landing))
    points = np.concatenate([position, velocity, landing])
    if points.shape[0] != 8 or not np.all(np.isfinite(points)):
        raise ValueError(
            f"finite position (3, n), velocity (3, n) and landing (2, n) are wanted, got a stack of {points.shape}"
        )
    if points.shape[1] < max(min_samples, 2):
        raise ValueError(f"{points.shape[1]} balls are too few for clusters of min_samples={min_samples}")
    low, middle, high = np.percentile(points, [25, 50, 75], axis=1, keepdims=True)
    scale = (high - low) / 1.349
    standard = (points - middle) / np.where(scale > 0, scale, 1.0)
    if eps is None:
        neighbours = NearestNeighbors(n_neighbors=max(min_samples - 1, 1)).fit(standard.T)
        distances, _ = neighbours.kneighbors()  # of the balls themselves: each one's own distance of zero is left out
        eps = EPS_FACTOR * float(np.median(distances[:, -1]))
    outlier = DBSCAN(eps=eps, min_samples=min_samples).fit_predict(standard.T) == -1
    if np.all(outlier):
        raise ValueError(
            f"DBSCAN with eps={eps}, min_samples={min_samples} calls all {outlier.size} balls outliers; raise eps"
        )
    inside = points[:, ~outlier]
    low, high = inside.min(axis=1), inside.max(axis=1)
    distribution = BallDistribution(low[:3], high[:3], low[3:6], high[3:6], low[6:], high[6:], name, source)
    return distribution, DistributionReport(outlier.size, outlier, eps, min_samples)
