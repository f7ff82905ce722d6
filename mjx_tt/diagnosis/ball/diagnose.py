"""Diagnosis of the flights: which causes there are, how much of the error each takes away, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball.effects import BY_NAME, EFFECTS
from mjx_tt.diagnosis.ball.flights import noise, tracker_gate
from mjx_tt.diagnosis.ball.flights.fit import first_fit, heading, own_spins
from mjx_tt.diagnosis.ball.flights.forward_model import Grid, grid
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem, Situation
from mjx_tt.diagnosis.ball.flights.noise import Jitter
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.diagnosis.ball.search import Search, Sessions, mean_square, remove_starts, search, spins_pay
from mjx_tt.diagnosis.ball.spins import Spins, estimate
from mjx_tt.diagnosis.inclusion import LEAST_LEFT_SHARE, Set
from mjx_tt.diagnosis.logs import before_racket
from mjx_tt.sim.model import SimModel, with_values

FEWEST_SAMPLES = 15  # of a flight
FEWEST_BALLS = 6
FLOOR = 0.003  # [m] shift of a flight's last sample below which a cause is of no practical interest
LEAST_LEFT = 0.0025  # [m] of what no cause explains, on one ball in ten
FILTER = "tracker_filter"


@dataclass(frozen=True)
class Pattern:
    """One smooth function that no cause of the catalogue explains."""

    name: str
    direction: str
    size: float  # [m] largest on a flight, beside its own start, on one ball in ten
    rms: float  # [m] over all samples


@dataclass(frozen=True)
class BallFindings:
    """Findings of a set of flights."""

    problem: BallProblem
    search: Search
    spinning: str  # "none", "free" or "cause", see diagnose_balls
    named: Set  # of the chosen, those of a size that matters
    groups: dict[int, Set]  # what can stand in for each of the chosen
    confidence: dict[int, float]  # share of half logs that choose it
    left_out: Set  # effects that were no candidates
    patterns: tuple[Pattern, ...]  # the largest first
    left: float  # [m] root mean square of all of them
    whole: float  # [m] the same of the nominal model's error, without the noise
    unexplained: bool  # the patterns are a fifth of the error, and large enough to matter
    residual0: Float[np.ndarray, "3 T n"]  # [m] under the nominal model
    start0: Float[np.ndarray, "12 n"]
    sessions: Sessions
    spins: Spins | None  # of every ball, where balls spin
    may_spin: bool  # something is left that spins may explain
    companions: Set = ()  # effects that are not named, and with which unseen balls are predicted better

    @property
    def spin_is_cause(self) -> bool:
        """True where balls spin that do not in the nominal model."""
        return self.spinning == "cause"

    def residual(self) -> Float[np.ndarray, "3 T n"]:
        """Residual [m] beside the chosen causes and each ball's own start."""
        return self.search.linear.residual


def flights(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """Flights free of rackets, of enough samples."""
    cut = (before_racket(t) for t in trajectories if len(t) >= FEWEST_SAMPLES)
    return [t for t in cut if len(t) >= FEWEST_SAMPLES]


def diagnose_balls(
    trajectories: Sequence[Trajectory],
    model: SimModel,
    spin: str = "none",
    without: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> BallFindings:
    """Chooses the causes.

    spin: "none" when no ball spins; "free" when every ball may, in the nominal model as well; "cause" when every ball
    may, and in the nominal model none does.
    without: effects to omit from the catalogue. Raises ValueError when there are too few flights.
    """
    say = progress or (lambda text: None)
    kept = flights(trajectories)
    if len(kept) < FEWEST_BALLS:
        raise ValueError(
            f"{len(kept)} usable flights of {len(trajectories)} (at least {FEWEST_SAMPLES} samples each), at least "
            f"{FEWEST_BALLS} are needed: what the balls share cannot be told from what each does"
        )
    gone = set(without)
    if "magnus" in gone and model.ball.flight.magnus_coefficient == 0.0:
        # Without the force the nominal model has no use for either.
        gone |= {"magnus_coefficient", "air_density", "lift_saturation", "spin_decay"}
    effects = tuple(e for e in EFFECTS if e.fit and not e.at_paddle)
    sessions = _sessions(kept)
    g = grid(kept)
    problem = BallProblem(g, model, effects, heading(g))
    say(f"fitting {g.n} flights under the nominal model")
    at = Situation(np.zeros(len(effects)), first_fit(problem))
    problem, at, filters = _with_filter(problem, at, gone)
    left_out = tuple(i for i, e in enumerate(effects) if e.gone(gone) or (e.name == FILTER and not filters))
    nominal = at  # starts under the nominal model, with spins where its balls have them
    spun: SpinPrior | None = None
    if spin != "none":
        say("fitting each ball's spin")
        at, spun = own_spins(problem, at)
        nominal = at if spin == "free" else nominal
    flown = problem.fly(np.zeros(len(effects)), nominal.start)
    residual0 = np.where(g.mask, g.measured - flown.measured[:, :, 0], 0.0)
    start_error = mean_square(residual0, g, 6)
    error = start_error if spin == "cause" else 0.0
    found = search(problem, at, spun, left_out, sessions, error, say)
    patterns, largest, rms = _patterns(found, g)
    # Bounces count with what differs between them: a place that returns balls otherwise is no scatter.
    whole = float(np.sqrt(max(start_error - found.level, rms**2)))
    unexplained = largest >= LEAST_LEFT and rms**2 > LEAST_LEFT_SHARE * whole**2
    may_spin = largest >= LEAST_LEFT
    if spin == "none" and not may_spin:
        say("asking whether balls spin, each in its own way")
        may_spin = spins_pay(problem, found, *own_spins(problem, at))
    rng = np.random.default_rng(seed)
    named = tuple(
        j for j in found.chosen if abs(found.at.theta[j]) * found.shift[j] >= FLOOR or problem.effects[j].fades
    )
    return BallFindings(
        problem,
        found,
        spin,
        named,
        {j: found.model.group(found.chosen, j) for j in found.chosen},
        found.model.confidence(found.chosen, rng),
        left_out,
        patterns,
        rms,
        whole,
        unexplained,
        residual0,
        nominal.start,
        sessions,
        estimate(problem, found, kept),
        may_spin and spin == "none" and "magnus" not in gone,
    )


def shaking(found: BallFindings) -> Jitter | None:
    """Deviation of the time stamps in the residual beside the chosen causes."""
    return noise.time_jitter(found.residual(), found.search.linear.base.velocity[:, :, 0], found.problem.grid)


def _with_filter(problem: BallProblem, at: Situation, gone: set[str]) -> tuple[BallProblem, Situation, bool]:
    """The problem with the gate of a tracker's filter and its memory to begin with, where such a filter shows."""
    model, index = problem.model, [e.name for e in problem.effects].index(FILTER)
    if model.sensing.filter_time not in (None, 0.0) or FILTER in gone:
        return problem, at, FILTER not in gone
    likeliest = tracker_gate.likeliest(problem, at, problem.linearise(at))
    if likeliest is None:
        return problem, at, False
    memory, gate = likeliest
    problem = BallProblem(
        problem.grid, with_values(model, {tracker_gate.GATE: gate}), problem.effects, heading(problem.grid)
    )
    theta = at.theta.copy()
    theta[index] = memory
    return problem, replace(at, theta=theta), True


def _patterns(found: Search, g: Grid) -> tuple[tuple[Pattern, ...], float, float]:
    """What the discrepancy is made of, the size [m] of all of it on one ball in ten, and its rms [m]."""
    left = found.picked.left

    def sizes(columns: np.ndarray) -> tuple[float, float]:
        smooth = np.where(np.isin(np.arange(len(found.columns)), columns), left.coefficients, 0.0)
        if found.prior is None:  # beside spins of their own, which take up much, functions count whole
            smooth = found.model.orthogonalise(found.chosen, smooth)
        shown = np.tensordot(smooth, found.columns, 1)[None]
        square = (remove_starts(shown, found.linear, g).reshape(g.n, 3, -1) ** 2).sum(axis=1)
        return float(np.percentile(np.sqrt(square.max(axis=1)), 90)), float(np.sqrt(square.sum() / g.mask.sum()))

    families = [f for f in found.model.families if found.picked.left.coefficients[f.columns].any()]
    if not families:
        return (), 0.0, 0.0
    every = [Pattern(f.name, f.direction, *sizes(f.columns)) for f in families]
    return tuple(sorted(every, key=lambda p: -p.rms)), *sizes(np.concatenate([f.columns for f in families]))


def jitter_cause(found: BallFindings) -> tuple[str, Jitter] | None:
    """The time stamps' scatter, where it moves a ball by half of FLOOR."""
    shaken = shaking(found)
    return (BY_NAME["latency_jitter"].name, shaken) if shaken is not None and shaken.shift > FLOOR / 2 else None


def _sessions(kept: Sequence[Trajectory]) -> Sessions:
    names = list(dict.fromkeys(t.session for t in kept))
    sessions = np.array([names.index(t.session) for t in kept])
    age = np.zeros(len(kept))
    for s in range(len(names)):
        own = np.flatnonzero(sessions == s)
        age[own] = np.arange(len(own)) / max(len(own) - 1, 1)
    return Sessions(sessions, age, names)
