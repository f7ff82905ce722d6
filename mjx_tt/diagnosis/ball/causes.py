"""From the findings of the flights to named causes: sizes with intervals, groups, confidence, and what stays open."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from mjx_tt.diagnosis.ball import cross_validation, experiment_design, leading, scores, selection
from mjx_tt.diagnosis.ball.cross_validation import Prediction
from mjx_tt.diagnosis.ball.diagnose import BallFindings, shaking
from mjx_tt.diagnosis.ball.effects import BY_NAME, INVISIBLE, Effect, Twin, Values
from mjx_tt.diagnosis.ball.flights import tracker_gate
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS, REFERENCE_MAGNUS
from mjx_tt.diagnosis.ball.leading import Leading
from mjx_tt.diagnosis.ball.model_averaging import Averaged, averaged
from mjx_tt.diagnosis.verdict import Cause, Estimate, Expressed, HeldOut, Part, Together, Unexplained
from mjx_tt.sim import model as models
from mjx_tt.sim.randomisation import Samples

BOOTSTRAP = 100
LEVEL = 0.90  # of intervals
DRAWS = 256  # of what may be wrong, for training
LEAST_GAIN = 0.01  # share of the error on unseen balls that causes larger than it have to be able to take away
LEAST_FREEDOM = 5  # of Student's distribution


def quantile(freedom: int) -> float:
    """Standard errors of half an interval, by Student's distribution."""
    return float(stdtrit(max(freedom, LEAST_FREEDOM), 0.5 + LEVEL / 2))


def part(
    found: BallFindings,
    prediction: Prediction,
    without: Container[str],
    hits: bool,
    seed: int,
    say: Callable[[str], None],
    lead: Leading | None = None,
) -> Part:
    """The flights' part of the verdict. hits: the robot's hits are judged, which show the ball's latency.

    lead: the cause that accounts for nearly all of flights of which something stays open.
    """
    say("confidence and intervals")
    sets = _averaged(found, seed)
    named, beside = _causes(found, sets, without, seed)
    unexplained = None
    if found.findings:
        # A name that does not outlive the block beside it was a stand-in for what has none.
        named, beside = [n for n in named if n.cause.name in found.survivors], {}
        top = found.findings[0]
        unexplained = Unexplained(top.block, top.where, top.direction, f"{1e3 * top.size:.1f} mm")
        if lead is not None:
            named, beside = [_leading_cause(lead, without)], leading.beside(lead)
            prediction = lead.prediction
    if any(n.cause.name == "tracker_filter" for n in named):
        beside = {tracker_gate.GATE: found.problem.nominal[tracker_gate.GATE], **beside}
    held_out = cross_validation.held_out(prediction, seed)
    # A tracker's filter shows for a moment behind the bounce, of which a whole flight's error says little.
    sizes = [n.cause.effect_mm for n in named if not n.cause.name.startswith("tracker_")]
    if unexplained is None and refuted(sizes, held_out):
        size = f"{held_out.before:.1f} mm"
        unexplained = Unexplained("unseen balls", "which the causes found predict no better", "all axes", size)
    hidden, quiet = _unseen(found, without, hits)
    names = [e.name for e in found.trial.effects]
    spin = ["magnus"] if found.trial.spin == "none" else []
    say("the next experiment")
    pairs = [(group[0], rival) for group in found.choice.groups for rival in group[1:]]
    dark = [i for i, name in enumerate(names) if not found.seen[i] and name in quiet]
    return Part(
        tuple(_standing_in(n, without) for n in named),
        beside,
        _undetermined(found) or bool(found.imitated),
        unexplained,
        held_out,
        tuple(hidden),
        tuple(quiet),
        experiment_design.experiments(found, pairs, dark),
        tuple(
            {"effects": [names[i] for i in subset] + (spin if spun else []), "gain": float(gain - found.choice.gain)}
            for subset, spun, gain in found.choice.runners_up
        ),
        tuple(
            f"two of the causes together are just what {name} alone would look like, which was left out"
            for name in found.imitated
        )
        + (() if lead is None else (_led(lead, without),)),
        _together(found),
        _samples(found, sets, seed) if named and lead is None else (),
        lead is not None,
    )


def _leading_cause(lead: Leading, without: Container[str]) -> Expressed:
    """The leading cause with its rivals; its interval holds what stays open."""
    choice, wide = lead.found.choice, quantile(lead.found.problem.grid.n - 10)
    theta, half = float(choice.theta[lead.place]), float(choice.error[lead.place]) * wide
    low = max(theta - half, lead.found.trial.effects[choice.effects[lead.place]].low)
    return _effect_cause(lead.found, lead.place, lead.confidence, (low, theta + half), without)


def _led(lead: Leading, without: Container[str]) -> str:
    name, *rivals = (lead.found.trial.effects[i].name for i in lead.found.choice.groups[lead.place])
    others = f" (or {' or '.join(r for r in rivals if r not in without)}, alike on these balls)" if rivals else ""
    spins = ", with lift and spins of the balls' own," if lead.found.choice.spin else ""
    return (
        f"{name}{others}{spins} accounts for {100 * lead.share:.0f} % of what is wrong: the extended model holds it, "
        "although something small stays open beside it, which its interval allows for"
    )


def refuted(sizes: list[float], held_out: HeldOut) -> bool:
    """True where causes are said to move balls by more [mm] than unseen ones are missed by, and gain nothing there.

    Such causes undo each other: together they follow the flights that they were fitted to.
    """
    said = float(np.sqrt(np.sum(np.square(sizes)))) if sizes else 0.0
    return said > held_out.before and held_out.high < LEAST_GAIN * held_out.before


def _together(found: BallFindings) -> tuple[Together, ...]:
    """All effects that were fitted at once, with 90 % intervals."""
    fitted, wide = found.together, quantile(found.problem.grid.n - 10)
    return tuple(
        Together(
            effect.name,
            float(fitted.theta[i]),
            float(fitted.theta[i] - wide * fitted.std[i]),
            float(fitted.theta[i] + wide * fitted.std[i]),
            effect.scale,
            effect.unit,
        )
        for i, effect in enumerate(found.trial.effects)
        if i in fitted.free
    )


def _causes(
    found: BallFindings, sets: Averaged, without: Container[str], seed: int
) -> tuple[list[Expressed], dict[str, float]]:
    """Named causes, and the values of what was fitted beside them without being named."""
    choice, nominal = found.choice, found.problem.nominal
    confidence, wide = _confidence(found, seed), quantile(found.problem.grid.n - 10)
    matters, ends = selection.named(choice, found.trial), _ends(found, sets, seed)
    named: list[Expressed] = []
    beside: dict[str, float] = {}
    for i, j in enumerate(choice.effects):
        if matters[i]:
            named.append(_effect_cause(found, i, confidence[i], (ends[0, i], ends[1, i]), without))
        elif any(matters) and choice.theta[i] >= found.trial.effects[j].low:
            # Too small to be named, but the others' sizes were fitted beside it.
            change = found.trial.effects[j].values(nominal, choice.theta[i])
            beside |= {path: float(value) for path, value in change.items()}
    if choice.prior is not None:
        if found.trial.spin == "none":
            named.append(_spin_cause(found, confidence[-1], wide))
        else:
            for axis, mean, std in zip("xyz", choice.prior.mean, choice.prior.std, strict=True):
                beside |= {f"ball_spin.mean_{axis}": float(mean), f"ball_spin.std_{axis}": float(std)}
    shaken = None if "latency_jitter" in without else shaking(found)
    if shaken is not None and shaken.shift > selection.FLOOR / 2:
        jitter = BY_NAME["latency_jitter"]
        estimate = Estimate(nominal[jitter.path], shaken.seconds, shaken.low, shaken.high, jitter.unit)
        cause = Cause(jitter.name, (jitter.name,), 0.95, {jitter.path: estimate}, 1e3 * shaken.shift, "")
        named.append(Expressed.by(cause, cause.parameters))
    return named, beside


def _averaged(found: BallFindings, seed: int) -> Averaged:
    """Sets of effects that could be true: what else may be wrong beside the chosen ones is not settled."""
    choice, effects, rated = found.choice, found.trial.effects, found.scores()
    barred = {*rated.always, *found.trial.left_out, *(i for i, e in enumerate(effects) if e.made_of)}
    barred |= {one for one, other in found.trial.bound if other not in choice.effects}
    able = [i for i in range(len(effects)) if i in choice.effects or (found.seen[i] and i not in barred)]
    freedom, scale = max(found.problem.grid.n - 10, LEAST_FREEDOM), np.array([e.scale for e in effects])
    return averaged(rated, able, choice.effects, scale, freedom, np.random.default_rng(seed))


def _ends(found: BallFindings, sets: Averaged, seed: int) -> Float[np.ndarray, "2 c"]:
    """Ends of the chosen changes' intervals, the changes within."""
    choice, effects = found.choice, found.trial.effects
    low, high = sets.intervals(choice.effects, LEVEL, np.random.default_rng(seed))
    low = np.maximum(low, [effects[j].low for j in choice.effects])
    return np.stack([np.minimum(low, choice.theta), np.maximum(high, choice.theta)])


def _samples(found: BallFindings, sets: Averaged, seed: int) -> tuple[Samples, ...]:
    """Draws of all that the flights leave open of the model; none where nothing is open."""
    effects, nominal = found.trial.effects, found.problem.nominal
    changes = sets.draws(DRAWS, np.random.default_rng([seed, 1]))
    changes = np.maximum(changes, [e.low for e in effects])
    if found.choice.magnus is not None and found.problem.coefficient is not None:
        changes[:, found.problem.coefficient] = found.situation.theta[found.problem.coefficient]
    values = {path: np.clip(v, *models.bounds(path)) for path, v in found.problem.values(changes.T).items()}
    open_ = {path: v for path, v in values.items() if np.ptp(v) > 0.0 or v[0] != nominal[path]}
    if not open_:
        return ()
    return (Samples(tuple(open_), np.stack(list(open_.values()), axis=1), np.ones(DRAWS)),)


def _effect_cause(
    found: BallFindings, i: int, confidence: float, ends: tuple[float, float], without: Container[str]
) -> Expressed:
    """The chosen effect number i, with what looks like it. ends: of its interval."""
    choice, effects, nominal = found.choice, found.trial.effects, found.problem.nominal
    j, theta, (low, high) = choice.effects[i], choice.theta[i], ends
    effect, rivals = effects[j], [effects[k] for k in choice.groups[i][1:]]
    twins = [t for t in effect.twins if t.name not in without]
    alike = [name for r in rivals for name in (r.name, *(t.name for t in r.twins)) if name not in without]
    parameters = estimates(effect, nominal, theta, low, high)
    # Where the nominal model has no Magnus force at all, that is the cause, whether or not the balls spin at first.
    name = "magnus" if j == found.problem.coefficient else effect.name
    cause = Cause(
        name,
        tuple(dict.fromkeys((name, effect.name, *(t.name for t in twins), *alike))),
        confidence,
        parameters | {t.path: _twin(effect, t, nominal, theta, low, high) for t in twins},
        float(1e3 * abs(theta) * found.trial.shift[j]),
        readings(effect, (*twins, *rivals)),
    )
    # Of a pair with the same pattern the extended model needs one.
    return Expressed.by(cause, parameters)


def readings(effect: Effect, rivals: Iterable[Effect | Twin]) -> str:
    """Measurements that would tell an effect from its rivals; empty without rivals."""
    rivals = tuple(rivals)
    return "; ".join(f"{e.name}: {e.reading}" for e in (effect, *rivals)) if rivals else ""


def estimates(effect: Effect, nominal: Values, theta: float, low: float, high: float) -> dict[str, Estimate]:
    """Estimates of the parameters that express a change of an effect."""
    out = {}
    for path, value in effect.values(nominal, theta).items():
        first, last = sorted(float(effect.values(nominal, end)[path]) for end in (low, high))
        out[path] = Estimate(nominal[path], float(value), first, last, effect.path_unit or effect.unit)
    return out


def _twin(effect: Effect, twin: Twin, nominal: Values, theta: float, low: float, high: float) -> Estimate:
    """The same deviation, expressed by the twin alone."""
    path = next(iter(effect.values(nominal, theta)))

    def of(change: float) -> float:
        ratio = float(effect.values(nominal, change)[path]) / nominal[path]
        return float(twin.of(nominal[twin.path], ratio))

    first, last = sorted((of(low), of(high)))
    return Estimate(nominal[twin.path], of(theta), first, last, twin.unit)


def _standing_in(named: Expressed, without: Container[str]) -> Expressed:
    """The cause under the name of its first twin, where its own is left out: what was fitted is the same."""
    cause = named.cause
    effect = BY_NAME[cause.name]
    twin = next((t for t in effect.twins if t.name not in without), None)
    if twin is None or cause.name not in without:
        return named
    others = [name for name in cause.group if name not in (effect.name, twin.name)]
    text = cause.separating_measurement.removeprefix(f"{effect.name}: {effect.reading}; ") if others else ""
    parameters = {path: p for path, p in cause.parameters.items() if path != effect.path}
    return Expressed.by(
        replace(cause, name=twin.name, group=(twin.name, *others), parameters=parameters, separating_measurement=text),
        {twin.path: cause.parameters[twin.path]},
    )


def _spin_cause(found: BallFindings, confidence: float, wide: float) -> Expressed:
    """Balls that spin: the coefficient, and the distribution of the spins that goes with it."""
    choice, problem = found.choice, found.problem
    rated, prior = found.scores(), choice.prior
    if prior is None:
        raise ValueError("the chosen causes hold no spin")
    error = np.sqrt(np.diagonal(scores.sandwich(rated, [*choice.effects, *rated.always])))
    n = problem.grid.n
    parameters: dict[str, Estimate] = {}
    if problem.coefficient is not None:
        k, half = float(found.situation.theta[problem.coefficient]), float(error[-1]) * wide
        low, high = (max(k - half, 0.0), k + half) if half < 0.5 * REFERENCE_MAGNUS else (0.3, 1.5)
        parameters[MAGNUS] = Estimate(problem.nominal[MAGNUS], k, low, high, "1")
    own = prior.std / np.sqrt(n) if prior.conditional else error[len(choice.effects) : len(choice.effects) + 3]
    for axis, mean, std, e in zip("xyz", prior.mean, prior.std, own, strict=True):
        half = wide * std / np.sqrt(2.0 * n)
        parameters[f"ball_spin.mean_{axis}"] = Estimate(
            0.0, float(mean), float(mean - wide * e), float(mean + wide * e), "rad/s"
        )
        parameters[f"ball_spin.std_{axis}"] = Estimate(
            0.0, float(std), float(max(std - half, 0.0)), float(std + half), "rad/s"
        )
    rms = float(np.sqrt(np.sum(prior.std**2 + prior.mean**2)))
    text = "in flight only the product of coefficient and spin shows: " + BY_NAME["magnus"].reading
    cause = Cause("magnus", ("magnus",), confidence, parameters, float(1e3 * rms * found.trial.spin_shift), text)
    coefficient = {path: e for path, e in parameters.items() if path == MAGNUS}  # the spins are a distribution already
    return replace(Expressed.by(cause, parameters), ranges=Expressed.by(cause, coefficient).ranges)


def _confidence(found: BallFindings, seed: int) -> list[float]:
    """Share of bootstrap draws of the balls in which each cause (or one of its group) is chosen; spin last."""
    choice, rng = found.choice, np.random.default_rng(seed)
    n, rated = found.problem.grid.n, scores.priced(found.scores(), found.trial.effects)
    useful = [i for i in np.flatnonzero(found.seen).tolist() if not (choice.spin and i == found.problem.coefficient)]
    hits = np.zeros(len(choice.effects))
    for _ in range(BOOTSTRAP):
        count = rng.multinomial(n, np.full(n, 1.0 / n)).astype(float)
        drawn = rated.weighted(count)
        if len(choice.effects) < scores.LARGEST_SUBSET:
            gains = scores.all_gains(drawn, tuple(useful))
        else:
            gains = scores.neighbours(drawn, choice.effects, tuple(useful))
        top = max(gains.items(), key=lambda x: x[1] - choice.threshold * len(x[0]))[0]
        hits += [bool(set(group) & set(top)) for group in choice.groups]
    return [*(float(h) / BOOTSTRAP for h in hits), float(choice.spin)]


def _unseen(found: BallFindings, without: Container[str], hits: bool) -> tuple[list[str], list[str]]:
    """Effects that no ball log shows, with the reason, and effects that these balls do not excite."""
    invisible = {n: why for n, why in INVISIBLE.items() if n not in without and not (hits and n == "ball_latency")}
    hidden = [f"{name}: {why}" for name, why in invisible.items()]
    if found.problem.coefficient is not None and found.choice.spin:
        hidden.append("magnus_coefficient and spin: in flight only their product shows")
    quiet = [
        e.name
        for i, e in enumerate(found.trial.effects)
        if not found.seen[i] and e.name not in invisible and i not in found.trial.left_out
    ]
    if found.trial.spin == "none" and not found.choice.spin:
        quiet = [name for name in quiet if not BY_NAME[name].needs_spin]
    return hidden, quiet


def _undetermined(found: BallFindings) -> bool:
    """True if another set of the same size explains as much, and differs by more than members of the groups.

    Where nothing is large enough to be named there is nothing to choose between.
    """
    choice = found.choice
    if not any(selection.named(choice, found.trial)) and not choice.spin:
        return False
    for subset, spun, gain in choice.runners_up:
        if len(subset) != len(choice.effects) or spun != choice.spin or choice.gain - gain > selection.TIE:
            continue
        strangers = [e for e in subset if not any(e in group for group in choice.groups)]
        if len(strangers) and len(set(choice.effects) - set(subset)) > 1:
            return True
    return False
