"""From the findings of the flights to named causes: sizes with intervals, groups, confidence, and what stays open."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from mjx_tt.diagnosis.ball import cross_validation, experiment_design
from mjx_tt.diagnosis.ball.cross_validation import Prediction
from mjx_tt.diagnosis.ball.diagnose import BallFindings, jitter_cause
from mjx_tt.diagnosis.ball.effects import BY_NAME, INVISIBLE, Effect, Twin, Values
from mjx_tt.diagnosis.ball.flights import tracker_gate
from mjx_tt.diagnosis.ball.flights.linearization import MAGNUS
from mjx_tt.diagnosis.ball.search import NO_ERROR
from mjx_tt.diagnosis.verdict import Cause, Estimate, Expressed, Left, Part, Together, Unexplained
from mjx_tt.sim import model as models
from mjx_tt.sim.randomisation import Samples

LEVEL = 0.90  # of intervals
DRAWS = 256  # of what may be wrong, for training
LEAST_FREEDOM = 5  # of Student's distribution
WIDER = 3.0  # times what is not chosen may be off, for intervals: small causes pull at the large ones
OPEN = 10.0  # the same, for training: some 1 mm at a flight's end


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
) -> Part:
    """The flights' part of the verdict. hits: the robot's hits are judged, which show the ball's latency."""
    search, picked, effects = found.search, found.search.picked, found.problem.effects
    named, beside = _causes(found, without)
    held_out = cross_validation.held_out(prediction, seed)
    unexplained = None
    if found.unexplained:
        top = found.patterns[0]
        unexplained = Unexplained(top.name, _where(found, top.name), top.direction, f"{1e3 * top.size:.1f} mm")
    hidden, quiet = unseen(found, without, hits)
    say("the next experiment")
    pairs = [(group[0], rival) for group in found.groups.values() for rival in group[1:]]
    dark = [i for i, e in enumerate(effects) if e.name in quiet and i not in found.left_out]
    return Part(
        tuple(_standing_in(n, without) for n in named),
        beside,
        unexplained,
        held_out,
        tuple(hidden),
        tuple(quiet),
        experiment_design.experiments(found, pairs, dark),
        tuple(
            {"effects": [effects[j].name for j in s], "gain": evidence - max(picked.evidence)}
            for s, evidence in zip(picked.path, picked.evidence, strict=True)
            if set(s) != set(search.chosen)
        ),
        (),
        _together(found),
        _samples(found, seed) if named else (),
        held_out.low > 0.0,
        Left(1e3 * found.left, (found.left / max(found.whole, NO_ERROR)) ** 2, 1e3 * found.whole),
    )


def _where(found: BallFindings, name: str) -> str:
    """Label of the family's function that is the largest."""
    s = found.search
    columns = np.concatenate([f.columns for f in s.model.families if f.name == name])
    labels = [label for f in s.model.families if f.name == name for label in f.labels]
    size = np.abs(s.picked.left.coefficients[columns]) * np.sqrt(np.diagonal(s.model.total[0])[columns])
    return labels[int(np.argmax(size))]


def _together(found: BallFindings) -> tuple[Together, ...]:
    """All effects where they are fitted at once, with 90 % intervals."""
    model, wide = found.search.model, quantile(found.problem.grid.n - 10)
    size, covariance, _ = model.solve(model.candidates)
    half = wide * np.sqrt(np.diagonal(covariance))
    return tuple(
        Together(e.name, float(size[i]), float(size[i] - half[i]), float(size[i] + half[i]), e.scale, e.unit)
        for i, e in enumerate(found.problem.effects)
        if i in model.candidates
    )


def _causes(found: BallFindings, without: Container[str]) -> tuple[list[Expressed], dict[str, float]]:
    """Named causes, and the values of what was fitted beside them without being named."""
    search, problem = found.search, found.problem
    wide = quantile(problem.grid.n - 10)
    error = np.sqrt(np.diagonal(replace(search.model, spike=WIDER * search.model.spike).solve(search.chosen)[1]))
    named = [_effect_cause(found, j, wide * error[j], without) for j in found.named]
    beside: dict[str, float] = {}
    size = search.model.solve((*search.chosen, *found.companions))[0]
    for j in (*search.chosen, *found.companions):
        if j not in found.named:
            change = problem.effects[j].values(problem.nominal, float(size[j]))
            beside |= {path: float(value) for path, value in change.items()}
    if search.prior is not None:
        if found.spin_is_cause:
            named.insert(0, _spin_cause(found, wide, error))
        else:
            for axis, mean, std in zip("xyz", search.prior.mean, search.prior.std, strict=True):
                beside |= {f"ball_spin.mean_{axis}": float(mean), f"ball_spin.std_{axis}": float(std)}
    if any(n.cause.name == "tracker_filter" for n in named):
        beside = {tracker_gate.GATE: problem.nominal[tracker_gate.GATE], **beside}
    jitter = None if "latency_jitter" in without else jitter_cause(found)
    if jitter is not None:
        name, shaken = jitter
        effect = BY_NAME[name]
        estimate = Estimate(problem.nominal[effect.path], shaken.seconds, shaken.low, shaken.high, effect.unit)
        cause = Cause(name, (name,), 0.95, {effect.path: estimate}, 1e3 * shaken.shift, "")
        named.append(Expressed.by(cause, cause.parameters))
    return sorted(named, key=lambda n: -n.cause.share), beside


def _samples(found: BallFindings, seed: int) -> tuple[Samples, ...]:
    """Draws of all that the flights leave open of the model; none where nothing is open."""
    search, nominal = found.search, found.problem.nominal
    model = replace(search.model, spike=OPEN * search.model.spike)
    size, covariance, _ = model.solve(search.chosen)
    changes = np.zeros((DRAWS, len(size)))
    able = [*model.candidates]
    rng = np.random.default_rng([seed, 1])
    changes[:, able] = rng.multivariate_normal(size[able], covariance[np.ix_(able, able)], DRAWS, method="eigh")
    changes = np.maximum(changes, [e.low for e in found.problem.effects])
    if found.problem.coefficient in model.always:
        changes[:, found.problem.coefficient] = search.at.theta[found.problem.coefficient]
    values = {path: np.clip(v, *models.bounds(path)) for path, v in found.problem.values(changes.T).items()}
    open_ = {path: v for path, v in values.items() if np.ptp(v) > 0.0 or v[0] != nominal[path]}
    if not open_:
        return ()
    return (Samples(tuple(open_), np.stack(list(open_.values()), axis=1), np.ones(DRAWS)),)


def _effect_cause(found: BallFindings, j: int, half: float, without: Container[str]) -> Expressed:
    """A chosen effect, with what looks like it. half: of its interval."""
    search, effects, nominal = found.search, found.problem.effects, found.problem.nominal
    effect, theta, rivals = effects[j], float(search.at.theta[j]), [effects[k] for k in found.groups[j][1:]]
    low, high = max(theta - half, min(effect.low, theta)), theta + half
    twins = [t for t in effect.twins if t.name not in without]
    alike = [name for r in rivals for name in (r.name, *(t.name for t in r.twins)) if name not in without]
    parameters = estimates(effect, nominal, theta, low, high)
    cause = Cause(
        effect.name,
        tuple(dict.fromkeys((effect.name, *(t.name for t in twins), *alike))),
        found.confidence[j],
        parameters | {t.path: _twin(effect, t, nominal, theta, low, high) for t in twins},
        float(1e3 * abs(theta) * search.shift[j]),
        readings(effect, (*twins, *rivals)),
        search.share(j),
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


def _spin_cause(found: BallFindings, wide: float, error: Float[np.ndarray, " K"]) -> Expressed:
    """Balls that spin: the coefficient, and the distribution of the spins that goes with it."""
    search, problem = found.search, found.problem
    prior, n = search.prior, problem.grid.n
    if prior is None or problem.coefficient is None:
        raise ValueError("the chosen causes hold no spin")
    k, half = float(search.at.theta[problem.coefficient]), wide * float(error[problem.coefficient])
    parameters = {MAGNUS: Estimate(problem.nominal[MAGNUS], k, max(k - half, 0.0), k + half, "1")}
    for axis, mean, std in zip("xyz", prior.mean, prior.std, strict=True):
        of_mean, of_std = wide * std / np.sqrt(n), wide * std / np.sqrt(2.0 * n)
        for kind, value, off in (("mean", mean, of_mean), ("std", std, of_std)):
            low = float(value - off) if kind == "mean" else max(float(value - off), 0.0)
            parameters[f"ball_spin.{kind}_{axis}"] = Estimate(0.0, float(value), low, float(value + off), "rad/s")
    rms = float(np.sqrt(np.sum(prior.std**2 + prior.mean**2)))
    text = "in flight only the product of coefficient and spin shows: " + BY_NAME["magnus"].reading
    # Without spins, and all other causes, the nominal model is left.
    picked = search.picked
    most = max([picked.remaining[1], *(w[1] for w in picked.without.values())])
    share = 1.0 - (most - search.level) / max(picked.errors[1] - search.level, NO_ERROR)
    cause = Cause("magnus", ("magnus",), 1.0, parameters, float(1e3 * rms * search.spin_shift), text, share)
    coefficient = {path: e for path, e in parameters.items() if path == MAGNUS}  # the spins are a distribution already
    return replace(Expressed.by(cause, parameters), ranges=Expressed.by(cause, coefficient).ranges)


def unseen(found: BallFindings, without: Container[str], hits: bool) -> tuple[list[str], list[str]]:
    """Effects that no ball log shows, with the reason, and effects that these balls do not excite."""
    invisible = {n: why for n, why in INVISIBLE.items() if n not in without and not (hits and n == "ball_latency")}
    hidden = [f"{name}: {why}" for name, why in invisible.items()]
    search = found.search
    if found.spin_is_cause:
        hidden.append("magnus_coefficient and spin: in flight only their product shows")
    shown = {*search.model.candidates, *search.model.always}
    quiet = [
        e.name
        for i, e in enumerate(found.problem.effects)
        if i not in shown and i not in found.left_out and e.name not in invisible and not e.made_of
    ]
    if search.prior is None:
        quiet = [name for name in quiet if not BY_NAME[name].needs_spin]
    return hidden, quiet
