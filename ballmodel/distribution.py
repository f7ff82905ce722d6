"""Where and how people's balls start: a box of 16 numbers, or a Gaussian mixture of start states.

The box is Abeyruwan et al. 2022's, "Modeling Human Ball Distributions": minima and maxima of initial position (6),
initial velocity (6) and landing x and y on the robot's side (4), signed and in the table frame, so a ball towards the
robot has vy < 0. A box knows no correlation and fills its corners: half of its balls are unlike every ball that the
person played. The mixture keeps them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from jaxtyping import Float
from pydantic import BeforeValidator, Field
from typing_extensions import TypedDict

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from ballmodel.io import validation
from ballmodel.io.atomic_files import replacing
from ballmodel.io.ranges import Within
from ballmodel.io.validation import Finite, Increasing, Section

AXES = {"position": ("x", "y", "z"), "velocity": ("x", "y", "z"), "landing": ("x", "y")}
ROWS = 9  # numbers of a start state: position [m], velocity [m/s], spin [rad/s]


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
            low, high = (tuple(map(float, end)) for end in self._ends(part))
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
            part: {axis: [low, high] for axis, low, high in zip(axes, *self._ends(part), strict=True)}
            for part, axes in AXES.items()
        }
        return {"name": self.name, "source": self.source, **intervals, **_short(self.short_balls)}

    def _ends(self, part: str) -> tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]:
        return getattr(self, f"{part}_min"), getattr(self, f"{part}_max")


@dataclass(frozen=True, eq=False)
class BallMixture:
    """Gaussian components over start states; ``name`` and ``source`` tell their origin.

    Raises ValueError for shapes that do not match, weights that are no shares, and covariances that are none.
    """

    weights: Float[np.ndarray, " k"]
    means: Float[np.ndarray, "k 9"]  # position [m], velocity [m/s], spin [rad/s]
    covariances: Float[np.ndarray, "k 9 9"]
    name: str = ""
    source: str = ""
    short_balls: bool = False  # as of a BallDistribution

    def __post_init__(self) -> None:
        weights, means, covariances = (
            np.asarray(getattr(self, part), np.float64) for part in ("weights", "means", "covariances")
        )
        k, shapes = weights.size, (weights.shape, means.shape, covariances.shape)
        if not k or shapes != ((k,), (k, ROWS), (k, ROWS, ROWS)):
            wanted = f"weights (k,), means (k, {ROWS}) and covariances (k, {ROWS}, {ROWS})"
            raise ValueError(f"{self.name}: expected {wanted}, got {', '.join(map(str, shapes))}")
        if not all(np.all(np.isfinite(part)) for part in (weights, means, covariances)):
            raise ValueError(f"{self.name}: expected finite numbers")
        if np.any(weights < 0.0) or abs(weights.sum() - 1.0) > 1e-3:
            raise ValueError(f"{self.name}: weights: expected shares that sum to 1, got {weights.tolist()}")
        for i, covariance in enumerate(covariances):
            size = np.abs(covariance).max()
            symmetric = np.allclose(covariance, covariance.T, atol=1e-6 * size)
            if not symmetric or np.linalg.eigvalsh(covariance)[0] < -1e-5 * size:
                where = f"{self.name}: covariance of component {i}"
                raise ValueError(f"{where}: expected symmetry and no negative eigenvalues")
        for part, value in (("weights", weights / weights.sum()), ("means", means), ("covariances", covariances)):
            object.__setattr__(self, part, value)

    @property
    def factors(self) -> Float[np.ndarray, "k 9 9"]:
        """Matrices F with F F^T = covariance."""
        values, vectors = np.linalg.eigh(self.covariances)
        return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]

    @property
    def box(self) -> BallDistribution:
        """Bounds: three standard deviations about the components' means, and the robot's half of the table."""
        spread = 3.0 * np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        low, high = (ends.tolist() for ends in ((self.means - spread).min(axis=0), (self.means + spread).max(axis=0)))
        ends = low[:3], high[:3], low[3:6], high[3:6], (-TABLE_WIDTH / 2, -TABLE_LENGTH / 2), (TABLE_WIDTH / 2, 0.0)
        return BallDistribution(*ends, self.name, self.source, self.short_balls)

    def to_dict(self) -> dict[str, Any]:
        """The YAML form."""
        components = [
            {"weight": float(w), "mean": m.tolist(), "covariance": c.tolist()}
            for w, m, c in zip(self.weights, self.means, self.covariances, strict=True)
        ]
        return {"name": self.name, "source": self.source, **_short(self.short_balls), "components": components}


def _short(short_balls: bool) -> dict[str, bool]:
    return {"short_balls": True} if short_balls else {}


Interval = Annotated[tuple[Finite, Finite], Increasing]


class Space(TypedDict):
    x: Interval
    y: Interval
    z: Interval


class Plane(TypedDict):
    x: Interval
    y: Interval


class Gaussian(TypedDict):
    weight: Annotated[float, Within(0.0)]
    mean: list[Finite]
    covariance: list[list[Finite]]


Text = Annotated[str, BeforeValidator(str)]


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
    """[m] where the ball first bounces."""

    def build(self, name: str, source: str) -> BallDistribution:
        """The box; ``name`` and ``source`` stand in for missing ones."""
        ends: dict[str, Any] = {
            f"{part}_{end}": [getattr(self, part)[axis][i] for axis in axes]
            for part, axes in AXES.items()
            for i, end in enumerate(("min", "max"))
        }
        return BallDistribution(**ends, **self.labels(name, source))


class MixtureFile(BallFile):
    """The YAML of a mixture."""

    components: Annotated[list[Gaussian], Field(min_length=1)]
    """The Gaussians: share of the balls, nine numbers (position [m], velocity [m/s], spin [rad/s]), nine times nine."""

    def build(self, name: str, source: str) -> BallMixture:
        """The mixture; ``name`` and ``source`` stand in for missing ones. Raises ValueError as BallMixture does."""
        rows = [(g["weight"], g["mean"], g["covariance"]) for g in self.components]
        weights, means, covariances = map(np.array, zip(*rows, strict=True))
        return BallMixture(weights, means, covariances, **self.labels(name, source))


def load_distribution(path: str | os.PathLike) -> BallDistribution:
    """Reads one distribution from YAML. Raises ValueError naming file, key, what was given and what is allowed."""
    return validation.read(BoxFile, path).build(Path(path).stem, "")


def save_distribution(path: str | os.PathLike, balls: BallDistribution | BallMixture) -> None:
    """Writes a distribution or a mixture as YAML; an existing file is replaced only by a complete one."""
    with replacing(path) as temporary:
        width = 200 if isinstance(balls, BallMixture) else 80
        temporary.write_text(yaml.safe_dump(balls.to_dict(), sort_keys=False, width=width), encoding="utf-8")
