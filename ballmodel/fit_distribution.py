"""From measured balls to the human ball distribution: fit, land, drop outliers, take minima and maxima."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel import constants as c
from ballmodel.distribution import BallDistribution, DistributionReport, fit_distribution
from ballmodel.flight import BallParams
from ballmodel.initial_state import MIN_SAMPLES, fit_gauss_newton
from ballmodel.io import MeasuredStates
from ballmodel.sampling import KEPT, OUTCOMES, SECOND_BOUNCE, throw
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset, free_flight

LANDED_TOGETHER = 512  # flights are simulated in multiples of it
ROBOT_SIDE = ((-c.TABLE_WIDTH / 2, -c.TABLE_LENGTH / 2), (c.TABLE_WIDTH / 2, 0.0))  # [m] corners of its half


@dataclass(frozen=True)
class HumanReport:
    """Counts of the measured balls on the way to a distribution."""

    measured: int
    too_short: int  # fewer than MIN_SAMPLES samples before the first bounce
    elsewhere: int  # not from the human's side towards the robot
    outcomes: dict[str, int]  # simulated flights of the others, keys from pool.OUTCOMES
    landed: BallState  # (3, n) starts of those that land on the robot's side
    landing: np.ndarray  # (2, n) [m]
    fit_rms: np.ndarray  # (m,) [m] of each fitted flight; empty where states were measured
    outliers: DistributionReport


def fit_human(
    measured: Dataset | MeasuredStates,
    params: BallParams,
    eps: float | None = None,
    min_samples: int = 5,
    name: str = "",
) -> tuple[BallDistribution, HumanReport]:
    """The 16 numbers of a person's balls, from trajectories or from start states.

    Landing points are those of the fitted states' simulated flights. A ball counts when it starts on the human's side,
    flies towards the robot, clears the net and lands on the robot's side. eps, min_samples: see ``fit_distribution``.
    Raises ValueError when no ball is left.
    """
    if isinstance(measured, Dataset):
        flights = [free_flight(t) for t in measured]
        long_enough = [t for t in flights if len(t) >= MIN_SAMPLES]
        fitted = fit_gauss_newton(long_enough, params.flight)
        state, rms, too_short = fitted.state, fitted.rms, len(flights) - len(long_enough)
    else:
        state, rms, too_short = measured.state, np.zeros(0), 0
    state = jax.tree.map(np.asarray, state)
    towards = (state.position[1] > 0.0) & (state.velocity[1] < 0.0)
    state = jax.tree.map(lambda a: a[:, towards], state)
    if not towards.any():
        raise ValueError(f"{measured.source}: none of {towards.size} balls flies from the human's side to the robot's")
    # In numbers that similar data sets share, so that one compiled flight serves them.
    n, extra = int(towards.sum()), -int(towards.sum()) % LANDED_TOGETHER
    padded = jax.tree.map(lambda a: jnp.asarray(np.pad(a, ((0, 0), (0, extra)), mode="edge"), jnp.float32), state)
    thrown = jax.tree.map(lambda a: a[..., :n], throw(params, padded, *ROBOT_SIDE))
    outcome = np.asarray(thrown.outcome)
    good = (outcome == KEPT) | (outcome == SECOND_BOUNCE)
    counts = np.bincount(outcome, minlength=len(OUTCOMES))
    outcomes = {text: int(count) for text, count in zip(OUTCOMES, counts, strict=True)}
    if not good.any():
        raise ValueError(f"{measured.source}: none of {towards.size} balls lands on the robot's side: {outcomes}")
    landed, landing = jax.tree.map(lambda a: a[:, good], state), np.asarray(thrown.landing)[:, good]
    distribution, outliers = fit_distribution(landed, landing, eps, min_samples, name, measured.source)
    report = HumanReport(len(measured), too_short, int((~towards).sum()), outcomes, landed, landing, rms, outliers)
    return distribution, report
