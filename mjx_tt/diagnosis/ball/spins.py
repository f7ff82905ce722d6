"""Spin of each ball, as the diagnosis found it: means, standard deviations, and a table of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ballmodel.io.atomic_files import replacing
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS, SPIN, BallProblem, project
from mjx_tt.diagnosis.ball.flights.noise import robust_weights
from mjx_tt.diagnosis.ball.flights.spin_prior import TINY
from mjx_tt.diagnosis.ball.search import Search

HEADER = ("session", "trajectory", "t", *(f"{kind}_{axis}" for kind in ("spin", "std") for axis in "xyz"))


@dataclass(frozen=True)
class Spins:
    """Spins [rad/s] at each ball's first sample, in the table's axes.

    In flight only the product of spin and coefficient k shows: deviations hold that of k, where it was estimated.
    """

    session: tuple[str, ...]
    name: tuple[str, ...]
    time: Float[np.ndarray, " n"]  # [s] of the first sample
    mean: Float[np.ndarray, "3 n"]
    std: Float[np.ndarray, "3 n"]

    def save(self, path: Path) -> None:
        """Writes a CSV: session, trajectory, t [s], spin and its standard deviation about x, y, z [rad/s]."""
        with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(HEADER)
            for i, (session, name) in enumerate(zip(self.session, self.name, strict=True)):
                numbers = [*self.mean[:, i], *self.std[:, i]]
                writer.writerow([session, name, f"{self.time[i]:.6f}", *(f"{x:.3f}" for x in numbers)])


def estimate(problem: BallProblem, found: Search, balls: Sequence[Trajectory]) -> Spins | None:
    """Posterior of every ball's spin beside the chosen causes; None where no ball spins."""
    prior, g = found.prior, problem.grid
    if prior is None:
        return None
    weight = robust_weights(found.linear.residual, found.noise, g)
    flown = project(found.linear, found.at, found.noise, weight, g)
    covariance = np.linalg.inv(flown.spin_gram + prior.of_balls(len(balls), TINY)[1]) * found.model.temper
    mean = np.einsum("can,an->cn", problem.axes, found.at.start[SPIN])
    variance = (
        np.einsum("can,nab,cbn->cn", problem.axes, covariance, problem.axes) + (mean * _of_lift(problem, found)) ** 2
    )
    return Spins(
        tuple(t.session for t in balls),
        tuple(t.name for t in balls),
        np.array([t.time[0] for t in balls]),
        mean,
        np.sqrt(variance),
    )


def _of_lift(problem: BallProblem, found: Search) -> float:
    """Relative standard deviation of the coefficient of lift; zero where it was taken as it is."""
    k = [e.path for e in problem.effects].index(MAGNUS)
    if k not in (*found.chosen, *found.model.always):
        return 0.0
    deviation = np.sqrt(found.model.solve(found.chosen)[1][k, k])
    return float(deviation / max(abs(problem.nominal[MAGNUS] + found.at.theta[k]), deviation))
