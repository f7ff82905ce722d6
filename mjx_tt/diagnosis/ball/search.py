"""Search of the causes: fit those that are chosen, look what else is there, choose again, until nothing changes.

Each round takes derivatives about the present fit and asks the evidence (``inclusion``) which causes there are, and the
model itself how much of the error each takes away: a cause is worth its name by size, not by significance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from mjx_tt.diagnosis.ball import discrepancy
from mjx_tt.diagnosis.ball.effects import FLIGHT, TABLE
from mjx_tt.diagnosis.ball.flights import marginal, noise
from mjx_tt.diagnosis.ball.flights.fit import fit_starts, log_evidence, of_some, refit_worst
from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import KICK, SPIN, BallProblem, Linear, Situation, remove, shifts
from mjx_tt.diagnosis.ball.flights.noise import Noise, Whitening
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR, MAGNUS_RANGE, SpinPrior
from mjx_tt.diagnosis.inclusion import Chosen, Family, Left, LinearModel, Set, choose
from mjx_tt.diagnosis.robust import bounded_mean

ROUNDS = 12
EARLY = 2  # of them, in which no cause has to be worth its name
PASSES = 2  # of asking how spins and kicks are distributed
SETTLED = 1.0  # deviations by which a size may still move
LEAST_GAIN = 0.1  # of the logarithm of how likely the flights are, that a step must bring
STEPS = (1.0, 0.5, 0.25)  # of the way to where the linear model leads
WORSE = 1.0  # of the logarithm of how likely the flights are, by which a step may be worse
NO_ERROR = 1e-6  # [m^2] beside the noise, below which there is nothing to take away: a millimetre
PRICE_OF_SPINS = 20.0  # the same of a coefficient of lift and of the nine numbers of a distribution
SPIKE, VISIBLE = 1e-4, 1.5e-5  # [m] by which what is not chosen may be off, at a flight's end and in rms of its samples
FEW = 40  # balls, at most, by which sizes are told
SCATTER = np.full(3, 0.1)  # [m/s] of bounces, before anything is known of it
LEAST_KICK = 1e-3  # [m/s]


@dataclass(frozen=True)
class Sessions:
    """Number of each ball's session, its place in it from 0 to 1, and the sessions' names."""

    number: Int[np.ndarray, " n"]
    age: Float[np.ndarray, " n"]
    names: Sequence[str]


@dataclass(frozen=True)
class Search:
    """Where the search ended. Errors are mean squares [m^2] of the flights after each ball's own start."""

    at: Situation
    linear: Linear
    noise: Noise
    prior: SpinPrior | None  # of the spins, None where nothing spins
    model: LinearModel
    columns: Float[np.ndarray, "c 3 T n"]  # of the model
    picked: Chosen
    shift: Float[np.ndarray, " K"]  # [m] median shift of a flight's last sample per unit of each effect
    spin_shift: float  # [m] the same per rad/s of spin
    level: float  # of the noise

    @property
    def chosen(self) -> Set:
        return self.picked.causes

    def share(self, member: int) -> float:
        """Part of the nominal model's error, the noise left out, that comes back without one of the chosen."""
        return self.picked.share(member, self.level, NO_ERROR)


def search(
    problem: BallProblem,
    at: Situation,
    prior: SpinPrior | None,
    left_out: Set,
    sessions: Sessions,
    error: float,
    say: Callable[[str], None],
) -> Search:
    """Search from a situation, with spins of this distribution or without any.

    left_out: effects that are no candidates. error: [m^2] of the nominal model, where it is not the situation's.
    """
    g, count = problem.grid, len(problem.effects)
    able = tuple(
        i
        for i, e in enumerate(problem.effects)
        if i not in left_out and not (e.needs_spin and prior is None) and not e.made_of
    )
    before: Set = ()
    own = noise.nominal_noise(g)
    held: Set = ()  # causes of what else would be unexplained
    scatter, seen, unknowns = SCATTER, set[Set](), 6 if prior is None else 9
    for round_ in range(ROUNDS):
        linear = problem.linearise(at, across=True)
        families, smooth = discrepancy.build(linear, g, sessions.number, sessions.age, sessions.names, count)
        columns = np.concatenate([linear.effects, smooth])
        shift, spin_shift = shifts(linear, g, problem.effects)
        frame = noise.flight_frame(linear.base.velocity[:, :, 0])
        # What the model does not explain yet is smooth, and would pass for noise that remembers itself: the noise is
        # what effects and discrepancy together leave.
        known = prior
        for pass_ in range(1 if round_ else 2):
            if not round_ and not pass_:
                own = noise.without_memory(noise.estimate(linear.residual, frame, g, unknowns))
            own = replace(own, frame=frame, scatter=scatter)
            model, everything, own, prior = _linear_model(
                problem, linear, at, own, prior, families, columns, able, shift
            )
            scatter = own.scatter
            change = everything.coefficients - np.pad(at.theta, (0, len(smooth)))
            left = _left(linear, change, columns, at, own, prior, g)
            own = replace(noise.estimate(left, frame, g, unknowns), scatter=scatter)
        sizes = Sizes(problem, at, own, prior)
        level = sizes.of(left, unknowns)
        beside = model.hold(held)
        picked = choose(beside, partial(sizes.beside, beside), before, error, level, NO_ERROR, round_ < EARLY)
        chosen = (*picked.causes, *held)
        size, covariance, _ = model.solve(chosen)
        inside = [*model.always, *chosen]
        aim = sizes.theta(model, chosen)
        begun = np.where(np.isin(np.arange(count), inside), at.theta, 0.0)
        theta, prior, gain = _step(sizes, begun, aim, known, prior)
        say(f"round {round_ + 1}: {', '.join(problem.effects[i].name for i in inside) or 'nothing'}")
        moved = np.abs(aim - at.theta)[inside] / np.sqrt(np.diagonal(covariance))[inside]
        stays = np.max(moved, initial=0.0) < SETTLED or gain < LEAST_GAIN
        again = picked.causes in seen and picked.causes != before
        if round_ >= EARLY and ((picked.causes == before and stays) or again):
            if prior is not None:  # balls with spins of their own take up much: what is left is no other cause's
                break
            rows = remove_starts(columns, linear, g)
            square = np.einsum("nrc,nrd->cd", rows, rows, optimize=True) / g.mask.sum()
            whole = float(np.max(picked.errors)) - level
            more = model.find_catalogued(chosen, picked.left, square, whole, NO_ERROR)
            if not more:
                break
            held, seen = (*held, *more), set()
        seen.add(picked.causes)
        before = picked.causes
        start = fit_starts(problem, theta, at.start, g, own, prior, rounds=4)
        if prior is not None:
            start = refit_worst(problem, theta, start, g, own, prior)
        at = Situation(theta, start)
    if held:
        without = {j: sizes.beside(model, tuple(c for c in chosen if c != j)) for j in chosen}
        path = [(*s, *held) for s in picked.path]
        picked = replace(picked, causes=tuple(sorted(chosen)), path=path, without=without)
    level = sizes.of(left, unknowns)
    return Search(at, linear, own, prior, model, columns, picked, shift, spin_shift, level)


def _step(
    sizes: Sizes,
    begun: Float[np.ndarray, " K"],
    aim: Float[np.ndarray, " K"],
    known: SpinPrior | None,
    learnt: SpinPrior | None,
) -> tuple[Float[np.ndarray, " K"], SpinPrior | None, float]:
    """Changes on the way to the linear model's, as far as they are no loss, the spins' distribution, moved alike, and
    how much likelier they make the flights.

    The linear model is right nearby only: a step that makes the flights less likely under the model itself is halved,
    twice at most, and then not taken.
    """
    before = sizes.unlikely(begun, known)
    for part in STEPS:
        theta, prior = begun + part * (aim - begun), learnt
        if learnt is not None and known is not None:
            prior = learnt.moved((part - 1.0) * (learnt.mean - known.mean))
        if (after := sizes.unlikely(theta, prior)) < before + WORSE:
            return theta, prior, before - after
    return begun, known, 0.0


def spins_pay(problem: BallProblem, plain: Search, at: Situation, prior: SpinPrior) -> bool:
    """True where balls with spins of their own, of some distribution, are likelier than balls that do not spin.

    plain: the search without spins. at: with them. Both are asked about the same flights under the same noise.
    """
    index = np.unique(np.linspace(0, problem.grid.n - 1, 2 * FEW).round().astype(int))
    some, theta = of_some(problem, index), at.theta.copy()
    inside = list(plain.chosen)
    theta[inside] = plain.at.theta[inside]
    of_noise = Sizes(problem, plain.at, plain.noise, None, index).noise
    alone = log_evidence(some, plain.at.theta, plain.at.start[:, index], some.grid, of_noise, None, 2)[1]
    spun = log_evidence(some, theta, at.start[:, index], some.grid, of_noise, prior.of_some(index), 4)[1]
    return float((alone - spun).sum()) / plain.model.temper > 2.0 * PRICE_OF_SPINS


def _linear_model(
    problem: BallProblem,
    linear: Linear,
    at: Situation,
    own: Noise,
    prior: SpinPrior | None,
    families: Sequence[Family],
    columns: Float[np.ndarray, "c 3 T n"],
    candidates: Set,
    shift: Float[np.ndarray, " K"],
) -> tuple[LinearModel, Left, Noise, SpinPrior | None]:
    """The linear model, starts projected out, spins and kicks integrated out, all that it explains, and the noise and
    the distribution of the spins that go with it.
    """
    g, k = problem.grid, len(problem.effects)
    flights = marginal.starts_out(linear, at, own, noise.robust_weights(linear.residual, own, g), problem)
    products = marginal.products(replace(linear, effects=columns), flights)
    more = None
    if prior is not None:
        physical = [i for i, e in enumerate(problem.effects) if e.path.startswith((FLIGHT, TABLE))]
        more = marginal.growth(problem, flights, linear, at, physical)
    # What is wrong with all bounces would pass for bounces that scatter, and with all flights for spin: how spins and
    # kicks are distributed is asked of what effects and discrepancy together leave.
    theta, everything = np.pad(at.theta, (0, len(columns) - k)), Left(np.zeros(0), 0.0, 0.0)
    for _ in range(PASSES):
        prior, scatter = marginal.distributions(products, theta, prior, own.scatter)
        own = replace(own, scatter=scatter)
        shown = marginal.evidence(products, theta, prior, scatter, more)
        model = _about(problem, shown, theta, prior, own, families, candidates, shift)
        model, everything = model.tempered()
        theta = everything.coefficients
    return model, everything, own, prior


def _about(
    problem: BallProblem,
    shown: marginal.Evidence,
    theta: Float[np.ndarray, " c"],
    prior: SpinPrior | None,
    own: Noise,
    families: Sequence[Family],
    candidates: Set,
    shift: Float[np.ndarray, " K"],
) -> LinearModel:
    """The linear model by the evidence's gradient at theta."""
    k = len(problem.effects)
    # About the information under given distributions, which is never negative.
    right = shown.right + np.einsum("nkl,l->nk", shown.ball_alone - shown.gram, theta)
    scale, middle = np.array([e.scale for e in problem.effects]), np.zeros(k)
    always: Set = ()
    if prior is not None and problem.coefficient is not None:
        middle[problem.coefficient], scale[problem.coefficient] = MAGNUS_PRIOR
        always = (problem.coefficient,)
        candidates = tuple(c for c in candidates if c not in always)
    information = np.diagonal(shown.alone)
    visible = np.sqrt(information[:k] / problem.grid.mask.sum()) * float(np.median(own.scale))
    spike = np.minimum(SPIKE / np.maximum(shift, 1e-9), VISIBLE / np.maximum(visible, 1e-12))
    useful = tuple(f for f in families if information[f.columns].mean() * f.usual**2 > 0.1)
    candidates = tuple(c for c in candidates if information[c] * scale[c] ** 2 > 1.0)
    spike = np.minimum(spike, 0.3 * scale)
    low = np.array([e.low for e in problem.effects])
    return LinearModel(shown.ball_alone, right, middle, scale, spike, low, useful, candidates, always)


def _left(
    linear: Linear,
    change: Float[np.ndarray, " c"],
    columns: Float[np.ndarray, "c 3 T n"],
    at: Situation,
    own: Noise,
    prior: SpinPrior | None,
    g: Grid,
) -> Float[np.ndarray, "3 T n"]:
    """Residual [m] less a change along the columns, and less what each ball's start, spin and kick take up of it."""
    white = Whitening(own, g)
    target = np.where(g.mask, linear.residual - np.tensordot(change, columns, 1), 0.0)
    weight = noise.weights_at(white.distance(target))
    active = [*range(6), *([] if prior is None else range(6, 9)), *range(9, 12)]
    slopes, rest = white.rows(linear.starts[active], weight), white.rows(target[None], weight)[..., 0]
    precision, pull = np.zeros((g.n, 12, 12)), np.zeros((g.n, 12))
    if prior is not None:
        middle, precision[:, SPIN, SPIN] = prior.of_balls(g.n)
        pull[:, SPIN] = np.einsum("nab,bn->na", precision[:, SPIN, SPIN], middle - at.start[SPIN])
    precision[:, KICK, KICK] = np.diag(np.maximum(own.scatter, LEAST_KICK) ** -2.0)
    pull[:, KICK] = -np.einsum("nab,bn->na", precision[:, KICK, KICK], at.start[KICK])
    full = slopes.swapaxes(1, 2) @ slopes + precision[:, active][:, :, active] + 1e-9 * np.eye(len(active))
    right = (slopes.swapaxes(1, 2) @ rest[..., None])[..., 0] + pull[:, active]
    step = np.linalg.solve(full, right[..., None])[..., 0]
    return np.where(g.mask, target - np.einsum("actn,na->ctn", linear.starts[active], step), 0.0)


class Sizes:
    """Errors of some of the balls [m^2] under changes of the effects, by the model itself, after each ball's own start.

    Two of them: where bounces may differ from ball to ball as they were found to, and where they may not. What is wrong
    in the air shows in the first, though bounces scatter; what is wrong with all bounces in the second.
    """

    def __init__(
        self,
        problem: BallProblem,
        at: Situation,
        own: Noise,
        prior: SpinPrior | None,
        index: Int[np.ndarray, " m"] | None = None,
    ) -> None:
        if index is None:
            index = np.unique(np.linspace(0, problem.grid.n - 1, FEW).round().astype(int))
        self.index, self.problem, self.start = index, of_some(problem, index), at.start[:, index]
        self.noise = replace(own, frame=own.frame[..., index], scale=own.scale[:, index])
        self.prior = None if prior is None else prior.of_some(index)

    def theta(self, model: LinearModel, chosen: Set) -> Float[np.ndarray, " K"]:
        """Changes of a set, those of all others zero."""
        theta, inside = np.zeros(model.effects), [*model.always, *chosen]
        theta[inside] = model.solve(chosen)[0][inside]
        if self.problem.coefficient in model.always:
            theta[self.problem.coefficient] = np.clip(theta[self.problem.coefficient], *MAGNUS_RANGE)
        return theta

    def beside(self, model: LinearModel, chosen: Set) -> Float[np.ndarray, 2]:
        """Errors beside a set."""
        return self(self.theta(model, chosen))

    def __call__(self, theta: Float[np.ndarray, " K"]) -> Float[np.ndarray, 2]:
        """After each ball's own start, and its spin where balls spin."""
        return np.array([self._of(theta, own) for own in (self.noise, replace(self.noise, scatter=noise.ALIKE))])

    def unlikely(self, theta: Float[np.ndarray, " K"], prior: SpinPrior | None) -> float:
        """Minus the logarithm of how likely the flights are, but for a constant."""
        prior = None if prior is None else prior.of_some(self.index)
        cost = log_evidence(self.problem, theta, self.start, self.problem.grid, self.noise, prior, 3)[1]
        return 0.5 * float(cost.sum())

    def _of(self, theta: np.ndarray, own: Noise) -> float:
        start, g = self.start.copy(), self.problem.grid
        if not own.scatter.any():
            start[KICK] = 0.0
        start = fit_starts(self.problem, theta, start, g, own, self.prior, rounds=3)
        left = g.measured - self.problem.fly(theta, start).measured[:, :, 0]
        return mean_square(left, g, 6 if self.prior is None else 9)

    def of(self, left: Float[np.ndarray, "3 T n"], unknowns: int) -> float:
        """Of residuals of all balls."""
        return mean_square(left[..., self.index], self.problem.grid, unknowns)


def remove_starts(columns: Float[np.ndarray, "c 3 T n"], linear: Linear, g: Grid) -> Float[np.ndarray, "n s c"]:
    """Columns [m] of each ball's samples, less what its own start takes of them."""

    def rows(x: np.ndarray) -> np.ndarray:
        return np.moveaxis(np.where(g.mask, x, 0.0).reshape(len(x), -1, g.n), (0, 1, 2), (2, 1, 0))

    return remove(np.linalg.qr(rows(linear.starts[:6]))[0], rows(columns))


def mean_square(left: Float[np.ndarray, "3 T n"], g: Grid, unknowns: int) -> float:
    """Mean square [m^2] of the samples' distances, outliers bounded, after a fit of so many numbers to each ball."""
    square, samples = (left**2).sum(axis=0)[g.mask], int(g.mask.sum())
    return float(bounded_mean(square) * samples / max(samples - unknowns * g.n / 3.0, 0.2 * samples))
