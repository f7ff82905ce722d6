"""Diagnosis of the flights: from measured balls to chosen causes, blocks without a name, and what the data can show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball import evidence, posterior, scores, selection
from mjx_tt.diagnosis.ball.effects import BY_NAME, EFFECTS
from mjx_tt.diagnosis.ball.flights import noise, tracker_gate
from mjx_tt.diagnosis.ball.flights.fit import first_fit, fit_starts, heading, own_spins
from mjx_tt.diagnosis.ball.flights.forward_model import Grid, grid
from mjx_tt.diagnosis.ball.flights.linearization import BallProblem, Linear, Projected, Situation, shifts
from mjx_tt.diagnosis.ball.flights.noise import Jitter, Noise
from mjx_tt.diagnosis.ball.posterior import Posterior
from mjx_tt.diagnosis.ball.scores import Scores
from mjx_tt.diagnosis.ball.selection import Choice, Settled, Trial, search
from mjx_tt.diagnosis.ball.spins import Spins, estimate
from mjx_tt.diagnosis.ball.unexplained import Finding, Left, find
from mjx_tt.diagnosis.logs import before_racket
from mjx_tt.sim.model import SimModel, with_values

FEWEST_SAMPLES = 15  # of a flight
FEWEST_BALLS = 12
SCATTER = np.full(3, 0.1)  # [m/s] of bounces, before anything is known of it
# Lift of balls that spin fast, of which a flight shows the product with the spin: their valley is not found from
# ordinary spins on every processor.
WEAK_LIFT = 0.15
LEAST_SHIFT = selection.FLOOR / 2  # [m] of a flight's end, for bounces that differ from ball to ball
TRACKERS = {"tracker_smoothing", "tracker_filter", "tracker_gate"}
FILTERED = "the tracker filters: once more without most of the samples behind the bounce"
MORE = 1.2  # times the samples left out, for another try with more
BLURRED, BLUR = 5.0, (0.04, 0.12)  # memories of a tracker's filter for which it settles behind a bounce; [s] of it


@dataclass(frozen=True)
class BallFindings:
    """Findings of a set of flights."""

    problem: BallProblem
    situation: Situation
    linear: Linear
    choice: Choice
    trial: Trial
    noise: Noise
    projected: Projected
    findings: tuple[Finding, ...]
    survivors: tuple[str, ...]  # names that hold beside what is unexplained; all of them where nothing is
    start0: Float[np.ndarray, "9 n"]  # under the nominal model
    residual0: Float[np.ndarray, "3 T n"]  # [m] under the nominal model
    sessions: Int[np.ndarray, " n"]
    age: Float[np.ndarray, " n"]
    seen: Bool[np.ndarray, " K"]  # the data could show the effect, and it was not left out
    imitated: tuple[str, ...]  # effects that were left out, each of which would replace two of the causes
    together: Posterior  # all effects fitted at once, before any was chosen
    spins: Spins | None  # of every ball, where balls spin
    spin_notes: tuple[str, ...]  # what was tried about spin, and what it brought
    small_notes: tuple[str, ...]  # what causes too small to be named explain
    untried: bool  # spins and bounces that differ were not tried, because of a tracker's filter

    def scores(self) -> Scores:
        """Scores of the effects under the chosen treatment of spin."""
        return scores.under(self.projected, self.choice.prior)

    def residual(self) -> Float[np.ndarray, "3 T n"]:
        """Residual [m] beside the chosen causes and each ball's own start."""
        return selection.left_over(self.linear, self.situation, self.projected, self.choice, self.problem.grid)[0]


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
    """Chooses the causes, and once more without samples around the bounce that a tracker proves to have blurred.

    Time stamps that shake round the corner of the bounce, and so does a filter that predicts: for a moment behind it
    the samples say more about the tracker than about the table. What a bounce does to a ball stays.
    spin: "none" when the nominal ball does not spin, so that spin is a cause; "free" when every ball may.
    without: effects to omit from the catalogue. Raises ValueError when there are too few flights.
    """
    say = progress or (lambda text: None)
    choose = partial(_diagnose, trajectories, model, spin, without, seed, progress)
    found = choose()
    near = _blurred(found, found.problem.grid)
    if near is not None:
        say(FILTERED)
        clear = choose(near, found)
        more = _blurred(clear, found.problem.grid) if clear.findings else None
        if more is not None and more.sum() > MORE * near.sum():
            say("it filters for longer than it seemed: once more without these samples as well")
            near = near | more
            clear = choose(near, found)
        if found.untried and (clear.findings or evidence.extraordinary(clear.choice, clear.trial)):
            say("something stays open: it is not the filter's doing alone")
            found = choose(patient=False)
            near = _blurred(found, found.problem.grid)
            if near is not None:
                say(FILTERED)
                clear = choose(near, found)
        found = found if near is None else clear
    shaken = None if "latency_jitter" in without else shaking(found)
    if shaken is None:
        return found
    say(f"time stamps shake by {1e3 * shaken.seconds:.1f} ms: once more without the bounce's samples")
    shaky = np.abs(found.problem.grid.time - found.linear.base.bounce_time[0]) < 3.0 * shaken.seconds
    return choose(shaky if near is None else near | shaky, found)


def _blurred(found: BallFindings | Settled, g: Grid) -> Bool[np.ndarray, "T n"] | None:
    """Samples behind the bounce that a predicting filter blurs, but the first, which shows the filter; None without it.

    A filter that is not quite the catalogue's settles in a way of its own: it may also show in
    sets that explain more than the chosen one, but with a size that no filter has.
    """
    choice, names = found.choice, [e.name for e in found.trial.effects]
    filters = [t for j, t in zip(choice.effects, choice.theta, strict=True) if names[j] == "tracker_filter"]
    better = {names[j] for subset, _, gain in choice.runners_up if gain > choice.gain for j in subset}
    if not filters and (not better & TRACKERS or TRACKERS & {names[j] for j in choice.effects}):
        return None
    filters = filters or [0.0]
    behind = g.time - found.linear.base.bounce_time[0]
    first = (behind > 0.0) & (np.cumsum(behind > 0.0, axis=0) == 1)
    settling = np.clip(BLURRED * filters[0], *BLUR)
    return (behind > 0.0) & (behind < settling) & ~first


def shaking(found: BallFindings) -> Jitter | None:
    """Deviation of the time stamps in the residual beside the chosen causes, from the samples that count."""
    g = found.problem.grid
    g = replace(g, mask=g.mask & (found.projected.weight.T > 0.0))
    return noise.time_jitter(found.residual(), found.linear.base.velocity[:, :, 0], g)


def _diagnose(
    trajectories: Sequence[Trajectory],
    model: SimModel,
    spin: str,
    without: Sequence[str],
    seed: int,
    progress: Callable[[str], None] | None,
    hidden: Bool[np.ndarray, "T n"] | None = None,
    before: BallFindings | None = None,
    patient: bool = True,
) -> BallFindings:
    """Chooses the causes.

    hidden: samples that do not count. before: findings with these samples, at whose spins the search starts.
    patient: where a tracker's filter may be what stays open, spins and bounces that differ are not tried: a filter
    looks like either.
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
    fitted = tuple(e for e in EFFECTS if e.fit and not e.at_paddle and not (e.needs_spin and e.name in gone))
    left_out = tuple(i for i, e in enumerate(fitted) if e.gone(gone))
    mode = "never" if spin == "none" and "magnus" in gone else spin
    names, sessions, age = _sessions(kept)
    g = grid(kept)
    if before is not None:
        g, model = replace(g, surprise=before.problem.grid.surprise), before.problem.model
    if hidden is not None:
        g = replace(g, mask=g.mask & ~hidden)
    problem = BallProblem(g, model, fitted, heading(g))
    say(f"fitting {g.n} flights under the nominal model")
    none = np.zeros(len(fitted))
    start = first_fit(problem) if before is None else fit_starts(problem, none, before.start0, g)
    nominal = Situation(none, start)
    if before is None:
        flown = problem.fly(none, start)
        g = replace(g, surprise=noise.surprise(g.measured - flown.measured[:, :, 0], flown.bounce_time[0], g))
        problem = BallProblem(g, model, fitted, heading(g))
    linear = problem.linearise(nominal)
    if before is None and model.sensing.filter_time in (None, 0.0) and "tracker_filter" not in gone:
        gate = tracker_gate.likeliest(problem, nominal, linear)
        if gate is not None and gate != problem.nominal[tracker_gate.GATE]:
            problem = BallProblem(g, with_values(model, {tracker_gate.GATE: gate}), fitted, heading(g))
            linear = problem.linearise(nominal)
    called = [e.name for e in fitted]
    bound = tuple(
        (i, called.index(e.beside))
        for i, e in enumerate(fitted)
        if e.beside and problem.nominal[BY_NAME[e.beside].path] == 0.0
    )
    trial = Trial(fitted, *shifts(linear, g, fitted), mode, seed, left_out, bound)
    spin_notes: list[str] = []
    if before is not None and not (before.untried and mode == "none"):
        prior, together = before.choice.prior, before.together
        own = prior is not None and prior.conditional
        treated = replace(trial, spin="free") if own else trial
        best = search(problem, treated, before.situation, prior, say, scatter=before.noise.scatter)
        best = replace(best, trial=replace(best.trial, spin=trial.spin))
        if (
            own
            and mode == "none"
            and (evidence.shift_of_spins(best) < selection.FLOOR or evidence.spins_without_lift(best))
        ):
            best, together = plain(problem, replace(trial, spin="never"), nominal, say)
    elif mode == "free":
        best, together = spinning(problem, trial, nominal, say)
    else:
        best, together = plain(problem, trial, nominal, say)
        if mode == "none" and evidence.spins_without_lift(best):
            best, together = plain(problem, replace(trial, spin="never"), nominal, say)
            best = replace(best, trial=replace(best.trial, spin="none"))
    say("looking for what no entry explains")
    left = find(best, g, sessions, age, names)
    first = before is None
    untried = first and patient and bool(left.findings) and _blurred(best, g) is not None
    tries = first and not untried
    doubted = (
        bool(left.findings) or evidence.bent_too_far(best.choice) or evidence.extraordinary(best.choice, best.trial)
    )
    if mode == "none" and tries and doubted:
        # Strong spin is out of reach of derivatives taken about balls that do not spin.
        say("trying balls that spin fast, each in its own way")
        other, theirs = spinning(problem, trial, nominal, say)
        gained = evidence.misfit(best, g) - evidence.misfit(other, g)
        shift = evidence.shift_of_spins(other)
        bends = evidence.lifts(other)
        spin_notes.append(_tried(gained, shift, bends, bool(left.findings)))
        if gained > 0.0 and shift >= selection.FLOOR and bends:
            best, together = replace(other, trial=replace(other.trial, spin="none")), theirs
            left = find(best, g, sessions, age, names)
    if tries and left.findings:
        for attempt in _of_scattering(best.choice, mode):
            say("trying bounces that differ from ball to ball")
            other, theirs = attempt(problem, trial, nominal, say, SCATTER)
            gained = evidence.misfit(best, g) - evidence.misfit(other, g)
            shift = evidence.shift_of_scatter(other, g)
            beside = find(other, g, sessions, age, names)
            kept_so = gained > 0.0 and shift >= LEAST_SHIFT and not beside.findings
            spin_notes.append(_scattering(gained, shift, other.noise.scatter, kept_so))
            if kept_so:
                best, together, left = other, theirs, beside
                best = replace(best, trial=replace(best.trial, spin=mode))
                break
    seen = selection.visible(
        scores.under(best.projected, best.choice.prior), best.trial, bool(best.noise.scatter.any())
    )
    seen[list(left_out)] = False
    return BallFindings(
        problem,
        best.at,
        best.linear,
        best.choice,
        best.trial,
        best.noise,
        best.projected,
        left.findings,
        left.holding,
        start,
        linear.residual,
        sessions,
        age,
        seen,
        evidence.imitated(best.projected, best.trial, best.choice),
        together,
        estimate(problem, best, kept),
        tuple(spin_notes) if before is None else before.spin_notes,
        _of_small(left),
        untried,
    )


def plain(
    problem: BallProblem,
    trial: Trial,
    nominal: Situation,
    say: Callable[[str], None],
    scatter: Float[np.ndarray, 3] = noise.ALIKE,
) -> tuple[Settled, Posterior]:
    """Choice of causes about balls that do not spin to begin with, and all effects at once."""
    fitted_all = posterior.fit(problem, nominal, None, trial.left_out, say, scatter)
    found = search(problem, trial, fitted_all.at, None, say, fitted_all.linear, fitted_all.noise.scatter)
    return found, fitted_all


def _tried(gained: float, shift: float, bends: bool, open_: bool) -> str:
    """Account of balls with spins of their own, which shift [m] flights, against balls without, by twice the log
    evidence gained. bends: the air bends such balls as it does real ones. open_: something stayed open without."""
    why = "something stayed open without it" if open_ else "a cause was of a size that hardly any set-up has"
    if gained > 0.0 and shift < selection.FLOOR:
        then = f"dropped: it moves balls {1e3 * shift:.1f} mm"
    elif gained > 0.0 and not bends:
        then = "dropped: no air bends balls so much or little"
    elif gained > 0.0:
        then = f"kept: its evidence is {gained:.0f} better"
    else:
        then = f"dropped: its evidence is {-gained:.0f} worse"
    return f"spin was tried because {why}, and {then}"


def _of_small(left: Left) -> tuple[str, ...]:
    """Account of what stays beside the named causes and has an explanation."""
    if left.findings or not left.small:
        return ()
    most = left.small[0]
    return (
        f"small causes beside: {most.block}, {most.where}, up to {1e3 * most.size:.1f} mm, is what effects of the "
        "catalogue explain together that are each too small to be named",
    )


def _of_scattering(choice: selection.Choice, mode: str) -> tuple[Callable[..., tuple[Settled, Posterior]], ...]:
    """Searches that bounces of many kinds are tried with: kicks at the bounce may have been taken for spin."""
    if mode == "free":
        return (spinning,)
    return (plain, spinning) if choice.prior is not None and choice.prior.conditional else (plain,)


def _scattering(gained: float, shift: float, scatter: Float[np.ndarray, 3], kept: bool) -> str:
    """Account of bounces that differ from ball to ball against bounces that are alike."""
    across, against, up = scatter
    text = (
        "bounces that differ from ball to ball were tried because something stayed open without: by "
        f"{across:.3f} m/s across the ball's way, {against:.3f} along it, {up:.3f} upwards, "
        f"{1e3 * shift:.1f} mm at the end of a flight"
    )
    why = "something stays open with them as well, " if gained > 0.0 and not kept else ""
    return f"{text}; {'kept' if kept else 'dropped'}: {why}evidence {gained:+.0f}"


def spinning(
    problem: BallProblem,
    trial: Trial,
    nominal: Situation,
    say: Callable[[str], None],
    scatter: Float[np.ndarray, 3] = noise.ALIKE,
) -> tuple[Settled, Posterior]:
    """Choice of causes where each ball has a spin of its own, about which derivatives are taken; and all at once."""
    say("fitting each ball's spin")
    fitted_all = posterior.fit(problem, *own_spins(problem, nominal), trial.left_out, say, scatter)
    prior = fitted_all.prior
    if prior is not None:
        say(
            f"spins of {prior.components} kind{'s' * (prior.components > 1)}: mean {np.round(prior.mean)}, "
            f"deviation {np.round(prior.std)} rad/s about x, y, z"
        )
    spinning = replace(trial, spin="free")
    found = search(problem, spinning, fitted_all.at, prior, say, fitted_all.linear, fitted_all.noise.scatter)
    if prior is not None and evidence.extraordinary(found.choice, found.trial):
        say("a cause of a size that hardly any set-up has: once more from spins alone")
        coefficients = [None] if problem.coefficient is None else [fitted_all.at.theta[problem.coefficient], WEAK_LIFT]
        tried = [found]
        for coefficient in coefficients:
            alone = np.zeros(len(trial.effects))
            if coefficient is not None:
                alone[problem.coefficient] = coefficient
            start = fit_starts(problem, alone, fitted_all.at.start, problem.grid, fitted_all.noise, prior, rounds=5)
            tried.append(search(problem, spinning, Situation(alone, start), prior, say, scatter=scatter))
        found = min(tried, key=lambda settled: evidence.misfit(settled, problem.grid))
    return found, fitted_all


def _sessions(
    kept: Sequence[Trajectory],
) -> tuple[list[str], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Names of the sessions, each ball's number of its session, and its place in it from 0 to 1."""
    names = list(dict.fromkeys(t.session for t in kept))
    sessions = np.array([names.index(t.session) for t in kept])
    age = np.zeros(len(kept))
    for s in range(len(names)):
        own = np.flatnonzero(sessions == s)
        age[own] = np.arange(len(own)) / max(len(own) - 1, 1)
    return names, sessions, age
