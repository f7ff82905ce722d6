"""From measured balls to the human ball distribution: fit, land, drop outliers, take minima and maxima."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from ballmodel.distribution import BallDistribution, DistributionReport, fit_distribution
from ballmodel.flight import BallParams, step
from ballmodel.initial_state import MIN_SAMPLES, fit_all_nelder_mead, fit_gauss_newton
from ballmodel.io import MeasuredStates
from ballmodel.partial_params import without_nominal
from ballmodel.sampling import DT, KEPT, OUTCOMES, OWN_SIDE, ROBOT_SIDE, SECOND_BOUNCE, Throw, throw
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset, free_flight

LANDED_TOGETHER = 512  # flights are simulated in multiples of it
AFTER_BOUNCE = 6  # steps after a serve's bounce on the server's side at which its ball starts: 20 ms
LONGEST_SERVE = 300  # steps until that bounce
HALF_TURN = np.array([[-1.0], [-1.0], [1.0]])  # about the table's upright axis
Fit: TypeAlias = Literal["gauss-newton", "nelder-mead"]


@dataclass(frozen=True)
class HumanReport:
    """Counts of the measured balls on the way to a distribution."""

    measured: int
    too_short: int  # fewer than MIN_SAMPLES samples before the first bounce
    elsewhere: int  # not from the human's side towards the robot
    outcomes: dict[str, int]  # flights of the others, keys from pool.OUTCOMES
    landed: BallState  # (3, n) starts of those that land on the robot's side
    landing: np.ndarray  # (2, n) [m]
    fit_rms: np.ndarray  # (m,) [m] of each fitted flight; empty where states were measured
    outliers: DistributionReport
    serves: int = 0  # of those that landed


@jax.jit
def _after_own_bounce(params: BallParams, state: BallState) -> BallState:
    """Balls (3, n) AFTER_BOUNCE steps after their first bounce."""

    def advance(carry: tuple[BallState, jax.Array], _: None) -> tuple[tuple[BallState, jax.Array], None]:
        state, since = carry
        new, events = step(params, state, DT)
        over = since >= AFTER_BOUNCE
        state = jax.tree.map(lambda a, b: jnp.where(over, a, b), state, new)
        return (state, jnp.where((since > 0) | events.table, since + 1, 0)), None

    since = jnp.zeros(state.position.shape[1:], jnp.int32)
    (state, _), _ = jax.lax.scan(advance, (state, since), None, length=LONGEST_SERVE)
    return state


def _thrown(params: BallParams, state: BallState) -> tuple[Throw, BallState]:
    """Flights of balls (3, n), and where serves among them start, in numbers that similar data sets share."""
    n = state.position.shape[1]
    padded = jax.tree.map(
        lambda a: jnp.asarray(np.pad(a, ((0, 0), (0, -n % LANDED_TOGETHER)), mode="edge"), jnp.float32), state
    )
    thrown = throw(params, padded, *ROBOT_SIDE)
    return jax.tree.map(lambda a: np.asarray(a)[..., :n], (thrown, padded))


def fit_human(
    measured: Dataset | MeasuredStates,
    params: BallParams,
    eps: float | None = None,
    min_samples: int = 5,
    name: str = "",
    serves: bool = False,
    fit: Fit = "gauss-newton",
    progress: Callable[[int, int], None] | None = None,
    short_balls: bool = False,
    both_players: bool = False,
) -> tuple[BallDistribution, HumanReport]:
    """The 16 numbers of a person's balls, from trajectories or from start states.

    A ball counts when it starts on the human's side, flies towards the robot, clears the net and lands on the robot's
    side: where a bounce was measured there, or else by the start's simulated flight.
    eps, min_samples: see ``fit_distribution``.
    serves: balls that bounce on the human's side first count as well, from 20 ms after that bounce. Start states of a
    recording may spin; trajectories are taken not to (``mjx_tt.prediction`` estimates their spins).
    fit: of trajectories. Both minimise the same distance, "nelder-mead" as the paper does, "gauss-newton" all at once.
    both_players: strokes of the other player count as well, as if played from the human's side.
    short_balls: the distribution draws balls as well that would bounce twice on the robot's side, if the person played
    any; without, those set its bounds only, and none of them is drawn.
    progress: called with (flights fitted so far, all of them) by Nelder-Mead, which takes a tenth of a second for each.
    Raises ValueError for another fit, for Nelder-Mead on start states and when no ball is left.
    """
    if fit not in get_args(Fit):
        raise ValueError(f"fit {fit!r} is not one of {get_args(Fit)}")
    if isinstance(measured, Dataset):
        flights = [free_flight(t) for t in measured]
        long_enough = [t for t in flights if len(t) >= MIN_SAMPLES]
        too_short = len(flights) - len(long_enough)
        if fit == "nelder-mead":
            state, rms = fit_all_nelder_mead(long_enough, params.flight, progress)
        else:
            fitted = fit_gauss_newton(long_enough, params.flight)
            state, rms = fitted.state, fitted.rms
    elif fit == "nelder-mead":
        raise ValueError(f"{measured.source}: holds start states; {fit} fits trajectories")
    else:
        state, rms, too_short = measured.state, np.zeros(0), 0
    state = jax.tree.map(np.asarray, state)
    bounced = np.full((2, state.position.shape[1]), np.nan)
    if isinstance(measured, MeasuredStates) and measured.landing is not None:
        bounced = measured.landing
    if both_players:
        other = (state.position[1] < 0.0) & (state.velocity[1] > 0.0)
        state = jax.tree.map(lambda a: np.where(other, HALF_TURN * a, a), state)
        bounced = np.where(other, -bounced, bounced)
    towards = (state.position[1] > 0.0) & (state.velocity[1] < 0.0)
    state, bounced = jax.tree.map(lambda a: a[:, towards], state), bounced[:, towards]
    if not towards.any():
        raise ValueError(f"{measured.source}: none of {towards.size} balls flies from the human's side to the robot's")
    thrown, _ = _thrown(params, state)
    outcome, landing, served = np.asarray(thrown.outcome), np.asarray(thrown.landing), 0
    own = outcome == OWN_SIDE
    if serves and own.any():
        _, start = _thrown(params, jax.tree.map(lambda a: a[:, own], state))
        start = jax.tree.map(np.asarray, _after_own_bounce(without_nominal(params), start))
        again, _ = _thrown(params, start)
        state = jax.tree.map(lambda a, b: _replaced(a, own, b), state, start)
        landing = _replaced(landing, own, np.asarray(again.landing))
        outcome = _replaced(outcome, own, np.asarray(again.outcome))
        served = int(np.isin(again.outcome, (KEPT, SECOND_BOUNCE)).sum())
    # What was seen to land has landed, whatever a model that is not quite right makes of it.
    there = (np.abs(bounced[0]) < TABLE_WIDTH / 2) & (bounced[1] < 0.0) & (bounced[1] > -TABLE_LENGTH / 2)
    landing = np.where(there, bounced, landing)
    outcome = np.where(there & (outcome != SECOND_BOUNCE), KEPT, outcome)
    good = (outcome == KEPT) | (outcome == SECOND_BOUNCE)
    counts = np.bincount(outcome, minlength=len(OUTCOMES))
    outcomes = {text: int(count) for text, count in zip(OUTCOMES, counts, strict=True)}
    if not good.any():
        hint = "; serves are counted with serves=True" if own.any() and not serves else ""
        raise ValueError(f"{measured.source}: none of {towards.size} balls lands on the robot's side: {outcomes}{hint}")
    landed, landing = jax.tree.map(lambda a: a[:, good], state), landing[:, good]
    distribution, outliers = fit_distribution(landed, landing, eps, min_samples, name, measured.source)
    twice = (outcome == SECOND_BOUNCE)[good] & ~outliers.outlier
    distribution = replace(distribution, short_balls=bool(short_balls and twice.any()))
    report = HumanReport(
        len(measured), too_short, int((~towards).sum()), outcomes, landed, landing, rms, outliers, served
    )
    return distribution, report


def _replaced(values: np.ndarray, where: np.ndarray, new: np.ndarray) -> np.ndarray:
    """The values (..., n) with those of the chosen balls replaced."""
    out = np.array(values)
    out[..., where] = new
    return out
