"""Gaussian mixture over a person's start states: position, velocity and spin of a ball as it leaves the racket.

A box knows no correlation and fills its corners: half of its balls are unlike every ball that the person played. The
mixture keeps them; its number of components is the one under which held-out balls are likeliest.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import yaml
from jaxtyping import Float
from pydantic import Field

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from ballmodel.distribution import BallDistribution, BallFile
from ballmodel.io.atomic_files import replacing
from ballmodel.io.ranges import Within
from ballmodel.io.validation import Finite, Section, validate
from ballmodel.state import BallState

ROWS = tuple(f"{part}.{axis}" for part in ("position", "velocity", "spin") for axis in "xyz")
NUMBERS_OF_COMPONENTS = (1, 2, 3, 5, 8, 12, 16, 24)
FOLDS = 3
MOST_BALLS = 4000  # that choose the number of components
TOLERANCE = 3e-3  # of the mean log likelihood, at which a fit has converged
FEWEST_EACH = 30  # balls of a component
REGULARISATION = 1e-3  # of a standardised covariance's diagonal
LEAST_SPREAD = 1e-9  # in SI units, below which a row does not vary


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
        k, rows = weights.size, len(ROWS)
        if weights.shape != (k,) or not k or means.shape != (k, rows) or covariances.shape != (k, rows, rows):
            raise ValueError(
                f"{self.name}: expected weights (k,), means (k, {rows}) and covariances (k, {rows}, {rows}), got "
                f"{weights.shape}, {means.shape}, {covariances.shape}"
            )
        if not all(np.all(np.isfinite(part)) for part in (weights, means, covariances)):
            raise ValueError(f"{self.name}: expected finite numbers")
        if np.any(weights < 0.0) or abs(weights.sum() - 1.0) > 1e-3:
            raise ValueError(f"{self.name}: weights: expected shares that sum to 1, got {weights.tolist()}")
        for i, covariance in enumerate(covariances):
            size = np.abs(covariance).max()
            symmetric = np.allclose(covariance, covariance.T, atol=1e-6 * size)
            if not symmetric or np.linalg.eigvalsh(covariance)[0] < -1e-5 * size:
                raise ValueError(
                    f"{self.name}: covariance of component {i}: expected symmetry and no negative eigenvalues"
                )
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
        half_x, half_y = TABLE_WIDTH / 2, TABLE_LENGTH / 2
        landing = ((-half_x, -half_y), (half_x, 0.0))
        return BallDistribution(
            low[:3], high[:3], low[3:6], high[3:6], *landing, self.name, self.source, self.short_balls
        )

    def to_dict(self) -> dict[str, Any]:
        """The YAML form."""
        components = [
            {"weight": float(w), "mean": m.tolist(), "covariance": c.tolist()}
            for w, m, c in zip(self.weights, self.means, self.covariances, strict=True)
        ]
        short = {"short_balls": True} if self.short_balls else {}
        return {"name": self.name, "source": self.source, **short, "components": components}


class Component(Section):
    """A Gaussian over start states: position [m], velocity [m/s], spin [rad/s]."""

    weight: Annotated[float, Within(0.0)]
    """Share of the balls."""
    mean: list[Finite]
    """Nine numbers."""
    covariance: list[list[Finite]]
    """Nine times nine."""


class MixtureFile(BallFile):
    """The YAML of a mixture."""

    components: Annotated[list[Component], Field(min_length=1)]
    """The Gaussians."""


def parse_mixture(data: Any, where: str, name: str = "", source: str = "") -> BallMixture:
    """Builds a mixture from its YAML form; ``where`` (file and key) opens every message. Raises ValueError."""
    file = validate(MixtureFile, data, where)
    try:
        weights, means, covariances = (
            np.array([getattr(component, part) for component in file.components], np.float64)
            for part in ("weight", "mean", "covariance")
        )
        return BallMixture(weights, means, covariances, **file.labels(name, source))
    except ValueError as error:
        raise ValueError(f"{where}: components: {error}") from None


def save_mixture(path: str | os.PathLike, mixture: BallMixture) -> None:
    """Writes the mixture as YAML; an existing file is replaced only by a complete one."""
    with replacing(path) as temporary:
        temporary.write_text(yaml.safe_dump(mixture.to_dict(), sort_keys=False, width=200), encoding="utf-8")


@dataclass(frozen=True)
class MixtureReport:
    """Choice of the number of components."""

    balls: int
    scores: dict[int, float]  # components -> mean log likelihood of held-out balls, standardised

    @property
    def chosen(self) -> int:
        """Number of components under which held-out balls are likeliest."""
        return max(self.scores, key=lambda k: self.scores[k])


def start_states(state: BallState) -> Float[np.ndarray, "n 9"]:
    """Start states of balls (3, n), a row each."""
    return np.concatenate([np.asarray(part, np.float64) for part in (state.position, state.velocity, state.spin)]).T


def fit_mixture(
    state: BallState,
    name: str = "",
    source: str = "",
    seed: int = 0,
    components: Sequence[int] = NUMBERS_OF_COMPONENTS,
) -> tuple[BallMixture, MixtureReport]:
    """Mixture of the balls' starts (3, n), with the number of components that held-out balls prefer.

    More components are tried until two in a row do worse. Rows that do not vary (spin, where none is known) stay at
    their value. Raises ValueError for fewer than FEWEST_EACH balls or numbers that are not finite.
    """
    from sklearn.mixture import GaussianMixture  # sklearn takes about a second to import
    from sklearn.model_selection import KFold, cross_val_score

    rows = start_states(state)
    if len(rows) < FEWEST_EACH or not np.all(np.isfinite(rows)):
        raise ValueError(f"{len(rows)} finite start states are too few for a mixture, {FEWEST_EACH} are wanted")
    varies = np.ptp(rows, axis=0) > LEAST_SPREAD
    middle, scale = rows.mean(axis=0), np.where(varies, rows.std(axis=0), 1.0)
    standard = ((rows - middle) / scale)[:, varies]

    def model(k: int, starts: int) -> GaussianMixture:
        return GaussianMixture(k, reg_covar=REGULARISATION, n_init=starts, random_state=seed, tol=TOLERANCE)

    some = standard[np.random.default_rng(seed).permutation(len(standard))[:MOST_BALLS]]
    scores: dict[int, float] = {}
    folds = KFold(FOLDS, shuffle=True, random_state=seed)
    for k in components:
        if k > 1 and k * FEWEST_EACH > len(some) * (FOLDS - 1) // FOLDS:
            break
        scores[k] = float(np.mean(cross_val_score(model(k, 1), some, cv=folds)))
        if len(scores) > 2 and max(list(scores.values())[-2:]) < max(scores.values()):
            break
    report = MixtureReport(len(rows), scores)
    fitted = model(report.chosen, 1).fit(standard)
    chosen = np.flatnonzero(varies)
    means = np.tile(middle, (report.chosen, 1))
    means[:, chosen] += fitted.means_ * scale[chosen]
    covariances = np.zeros((report.chosen, len(ROWS), len(ROWS)))
    covariances[:, chosen[:, None], chosen[None]] = fitted.covariances_ * scale[chosen, None] * scale[None, chosen]
    return BallMixture(fitted.weights_, means, covariances, name, source), report
