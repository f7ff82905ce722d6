"""The diagnosis: logs and a model in; the verdict, the extended model and all that a report draws out.

from mjx_tt import gap, model
found = gap.diagnose(gap.load(["session1.csv"]), model.SimModel())
found.verdict.causes, found.extended
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr, stdtrit

from mjx_tt.diagnosis.ball import cross_validation, experiment_design, selection
from mjx_tt.diagnosis.ball import scores as evidence
from mjx_tt.diagnosis.ball.cross_validation import Prediction
from mjx_tt.diagnosis.ball.diagnose import BallFindings, diagnose_balls, shaking
from mjx_tt.diagnosis.ball.effects import AT_THE_PADDLE, BY_NAME, EFFECTS, INVISIBLE, SENSING, Effect
from mjx_tt.diagnosis.ball.linearization import REFERENCE_MAGNUS
from mjx_tt.diagnosis.hits.diagnose import HitFindings, diagnose_hits
from mjx_tt.diagnosis.hits.paddle_path import joint_path
from mjx_tt.diagnosis.joint import RobotFindings
from mjx_tt.diagnosis.joint import effects as joint_effects
from mjx_tt.diagnosis.joint.nominal import diagnose_joints
from mjx_tt.diagnosis.logs import Logs
from mjx_tt.diagnosis.verdict import Cause, Estimate, Experiment, HeldOut, Unexplained, Verdict
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, Range, SimModel

BOOTSTRAP = 100
LEVEL = 0.90  # of intervals
SPINS = ("none", "free")


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    verdict: Verdict
    extended: ModelFile
    balls: BallFindings | None
    prediction: Prediction | None  # held-out errors ball by ball
    hits: HitFindings | None  # the robot's hits, where balls and all joints were logged by one clock
    robot: RobotFindings | None


def diagnose(
    logs: Logs,
    model: SimModel | None = None,
    spin: str = "none",
    without: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    provenance: dict | None = None,
    randomise: bool = False,
) -> Diagnosis:
    """Finds what ``model`` gets wrong about the logs.

    spin: "none" when the nominal ball does not spin, "free" when every ball may. without: effects of the catalogue to
    leave out. randomise: the extended model draws the fitted parameters from their intervals in training.
    Raises ValueError for unknown names, too few balls, or logs without anything to diagnose.
    """
    model = SimModel() if model is None else model
    if spin not in SPINS:
        raise ValueError(f"spin is {spin!r}, allowed are {', '.join(SPINS)}")
    ball_names = {e.name for e in EFFECTS} | {t.name for e in EFFECTS for t in e.twins} | {"latency_jitter"}
    for name in without:
        if name not in ball_names and name.split(".")[-1] not in joint_effects.NAMES:
            raise ValueError(
                f"no effect {name!r} to leave out{models.nearest(name, ball_names | set(joint_effects.NAMES))}"
            )
    if not logs.balls and not logs.joints:
        raise ValueError("the logs hold neither balls nor joints")
    say = progress or (lambda text: None)
    found = prediction = hits = robot = None
    if logs.balls:
        found = diagnose_balls(logs.balls, model, spin, [n for n in without if n in ball_names], seed, say)
        say("predicting balls that were not used")
        prediction = cross_validation.predictions(found, seed)
        if found.choice.spin and spin == "none" and cross_validation.held_out(prediction, seed).high < 0.0:
            say("spin predicts unseen balls worse: once more without it")
            names = [n for n in without if n in ball_names] + ["magnus"]
            other = diagnose_balls(logs.balls, model, spin, names, seed, say)
            prediction_of_other = cross_validation.predictions(other, seed)
            if np.nanmedian(prediction_of_other.after) < np.nanmedian(prediction.after):
                found, prediction = other, prediction_of_other
        say("judging the robot's hits")
        hits = diagnose_hits(found, logs.balls, joint_path(logs.joints, model), without)
    if logs.joints:
        robot = diagnose_joints(logs.joints, model, seed, [n for n in without if n not in ball_names], say)
    verdict, values, ranges = _verdict(found, prediction, hits, robot, without, seed, say)
    verdict = replace(verdict, warnings=(*logs.notes, *verdict.warnings))
    if verdict.verdict in ("unexplained", "undetermined") and not (verdict.held_out and verdict.held_out.low > 0.0):
        values, ranges = {}, []  # names that are not to be relied on change the model only if they predict better
    extended = ModelFile(
        models.with_values(model, values),
        tuple(ranges) if randomise else (),
        {
            **(provenance or {}),
            "logs": logs.sources,
            "verdict": verdict.verdict,
            "causes": {
                c.name: {p: [e.estimate, e.low, e.high] for p, e in c.parameters.items()} for c in verdict.causes
            },
        },
    )
    return Diagnosis(verdict, extended, found, prediction, hits, robot)


def _verdict(found, prediction, hits, robot, without, seed, say) -> tuple[Verdict, dict, list[Range]]:
    causes: list[Cause] = []
    values: dict[str, float] = {}
    ranges: list[Range] = []
    unexplained = held = None
    hidden: list[str] = []
    excited: list[str] = []
    steps: tuple[Experiment, ...] = ()
    runners: list[dict] = []
    warnings: list[str] = []
    undetermined = False
    if found is not None:
        say("confidence and intervals")
        causes, values, ranges = _ball_causes(found, without, seed)
        if found.findings:
            # A name that does not outlive the block beside it was a stand-in for what has none.
            causes = [c for c in causes if c.name in found.survivors]
            kept = {path for c in causes for path in c.parameters}
            values, ranges = {k: v for k, v in values.items() if k in kept}, [r for r in ranges if r.path in kept]
        causes = [_standing_in(cause, without, values, ranges) for cause in causes]
        hidden, excited = _unseen(found, hits, without)
        if hits is not None:
            for cause, change, ends in _hit_causes(found, hits):
                causes.append(cause)
                values |= change
                ranges += ends
        undetermined = _undetermined(found) or bool(found.imitated)
        for name in found.imitated:
            warnings.append(
                f"two of the causes together are just what {name} alone would look like, which was left out"
            )
        if found.findings:
            top = found.findings[0]
            unexplained = Unexplained(top.block, top.where, top.direction, f"{1e3 * top.size:.1f} mm")
        held = cross_validation.held_out(prediction, seed)
        names = [e.name for e in found.trial.effects]
        best = found.choice.gain
        for subset, spun, gain in found.choice.runners_up:
            runners.append(
                {
                    "effects": [names[i] for i in subset] + (["magnus"] if spun and found.trial.spin == "none" else []),
                    "gain": float(gain - best),
                }
            )
        pairs = [(group[0], rival) for group in found.choice.groups for rival in group[1:]]
        say("the next experiment")
        quiet = [i for i, e in enumerate(found.trial.effects) if not found.seen[i] and e.name in excited]
        steps = experiment_design.experiments(found, pairs, quiet)
    if robot is not None:
        for c in robot.causes:
            joint = c.name.split(".")[0]
            parameters = {f"{joint}.{p}": Estimate(*x) for p, x in c.parameters.items()}
            causes.append(Cause(c.name, c.group, c.confidence, parameters, c.effect, c.separating_measurement))
            values |= _drive_values(c, robot)
        hidden += [f"{u.name}: {u.why}" for u in robot.not_identifiable]
        excited += [f"{u.name}: {u.why}" for u in robot.not_excited]
        steps += tuple(Experiment(text, (), 0.0) for text in robot.next_experiment)
        if robot.unexplained and unexplained is None:
            u = robot.unexplained
            unexplained = Unexplained(
                f"{u['joint']}: {u['block']}", str(u["where"]), str(u["direction"]), f"{u['size']:.2f} mrad or mm"
            )
        if held is None and robot.held_out:
            held = HeldOut(
                "rms of joint positions on windows not used, mean over joints [mrad], [mm]",
                *(
                    float(1e3 * np.mean([getattr(g, n) for g in robot.held_out]))
                    for n in ("before", "after", "low", "high")
                ),
            )
    if unexplained is not None:
        name = "unexplained"
    elif undetermined or (causes and held is not None and held.high < 0.0):
        # What makes the prediction of unseen balls worse is no cause to act on.
        name = "undetermined"
    else:
        name = "named" if causes else "none"
    return (
        Verdict(
            name,
            tuple(causes),
            unexplained,
            held,
            tuple(hidden),
            tuple(excited),
            steps,
            tuple(runners),
            tuple(warnings),
        ),
        values,
        ranges,
    )


def _drive_values(cause, robot: RobotFindings) -> dict[str, float]:
    joint, effect = cause.name.split(".")
    out = {}
    for path, (nominal, estimate, *_rest) in cause.parameters.items():
        name = path.split(".")[-1]
        # Delays of the drives are extra to the drawn latency.
        out[f"drives.{joint}.{name}"] = estimate - nominal if name.endswith("_delay") else estimate
    return out


def _ball_causes(found: BallFindings, without, seed: int) -> tuple[list[Cause], dict, list[Range]]:
    choice, effects, nominal = found.choice, found.trial.effects, found.problem.nominal
    confidence = _confidence(found, seed)
    quantile = float(stdtrit(max(found.problem.grid.n - 10, 5), 0.5 + LEVEL / 2))
    causes, values, ranges = [], {}, []
    matters = selection.named(choice, found.trial)
    for i, (j, theta, error) in enumerate(zip(choice.effects, choice.theta, choice.error)):
        effect = effects[j]
        if not matters[i]:
            if any(matters):  # too small to be named, but the others' sizes were fitted beside it
                values |= {path: float(value) for path, value in effect.values(nominal, theta).items()}
            continue
        low, high = theta - quantile * error, theta + quantile * error
        parameters = _parameters(effect, nominal, theta, low, high)
        rivals = [effects[k] for k in choice.groups[i][1:]]
        twins = [t for t in effect.twins if t.name not in without]
        group = (
            effect.name,
            *(t.name for t in twins),
            *(name for r in rivals for name in (r.name, *(t.name for t in r.twins)) if name not in without),
        )
        readings = [f"{t.name}: {t.reading}" for t in twins] + [f"{r.name}: {r.reading}" for r in rivals]
        text = f"{effect.name}: {effect.reading}; " + "; ".join(readings) if readings else ""
        # Of a pair with the same pattern the extended model needs one.
        for path, value in effect.values(nominal, theta).items():
            values[path] = float(value)
            a, b = sorted((float(effect.values(nominal, low)[path]), float(effect.values(nominal, high)[path])))
            ranges.append(Range(path, a, b))
        for t in twins:
            parameters[t.path] = _twin(effect, t, nominal, theta, low, high)
        name = effect.name
        if j == found.problem.coefficient:
            # The nominal model has no Magnus force at all: that is the cause, whether or not the balls spin at first.
            name, group = "magnus", ("magnus", *group)
        shift = float(1e3 * abs(theta) * found.trial.shift[j])
        causes.append(Cause(name, tuple(dict.fromkeys(group)), confidence[i], parameters, shift, text))
    if choice.spin and found.trial.spin == "none":
        causes.append(_spin_cause(found, confidence[-1], values, ranges, quantile))
    elif choice.spin:
        for axis, mean, std in zip("xyz", choice.prior.mean, choice.prior.std):
            values |= {f"ball_spin.mean_{axis}": float(mean), f"ball_spin.std_{axis}": float(std)}
    if "latency_jitter" not in without:
        shaken = shaking(found)
        if shaken is not None and shaken.shift > selection.FLOOR / 2:
            path = SENSING + "jitter"
            causes.append(
                Cause(
                    "latency_jitter",
                    ("latency_jitter",),
                    0.95,
                    {path: Estimate(nominal[path], shaken.seconds, shaken.low, shaken.high, "s")},
                    1e3 * shaken.shift,
                    "",
                )
            )
            values[path] = shaken.seconds
            ranges.append(Range(path, shaken.low, shaken.high))
    return causes, values, ranges


def _hit_causes(found: BallFindings, hits: HitFindings) -> list[tuple[Cause, dict, list[Range]]]:
    """Causes at the paddle with the leaves and ranges that express them."""
    nominal, out = found.problem.nominal, []
    quantile = float(stdtrit(max(hits.hits - 6, 5), 0.5 + LEVEL / 2))
    for c in hits.causes:
        low, high = c.change - quantile * c.error, c.change + quantile * c.error
        text = "; ".join(f"{e.name}: {e.reading}" for e in (c.effect, *c.rivals)) if c.rivals else ""
        parameters = _parameters(c.effect, nominal, c.change, low, high)
        sure = float(1.0 - 2.0 * stdtr(max(hits.hits - 6, 5), -abs(c.change) / c.error))
        cause = Cause(
            c.effect.name, (c.effect.name, *(e.name for e in c.rivals)), sure, parameters, 1e3 * c.shift, text
        )
        values = {path: e.estimate for path, e in parameters.items()}
        out.append((cause, values, [Range(path, e.low, e.high) for path, e in parameters.items()]))
    return out


def _parameters(effect: Effect, nominal, theta, low, high) -> dict[str, Estimate]:
    out = {}
    for path, value in effect.values(nominal, theta).items():
        ends = sorted((float(effect.values(nominal, low)[path]), float(effect.values(nominal, high)[path])))
        unit = {"gravity_x": "m/s^2", "gravity_y": "m/s^2", "gravity_z": "m/s^2"}.get(path.split(".")[-1], effect.unit)
        out[path] = Estimate(float(nominal[path]), float(value), *ends, unit)
    return out


def _twin(effect: Effect, twin, nominal, theta, low, high) -> Estimate:
    """The same deviation, expressed by the twin alone."""
    path = next(iter(effect.values(nominal, theta)))

    def of(change):
        ratio = float(effect.values(nominal, change)[path]) / nominal[path]
        return float(twin.of(nominal[twin.path], ratio))

    return Estimate(float(nominal[twin.path]), of(theta), *sorted((of(low), of(high))), twin.unit)


def _standing_in(cause: Cause, without, values: dict, ranges: list[Range]) -> Cause:
    """The cause under the name of its first twin, where its own is left out: what was fitted is the same.

    values, ranges: of the extended model; the twin's parameter takes the place of the entry's own.
    """
    effect = BY_NAME.get(cause.name)
    twin = next((t for t in effect.twins if t.name not in without), None) if effect else None
    if twin is None or cause.name not in without:
        return cause
    estimate = cause.parameters[twin.path]
    values.pop(effect.path)
    values[twin.path] = estimate.estimate
    ranges[:] = [r for r in ranges if r.path != effect.path] + [Range(twin.path, estimate.low, estimate.high)]
    others = [name for name in cause.group if name not in (effect.name, twin.name)]
    text = cause.separating_measurement.removeprefix(f"{effect.name}: {effect.reading}; ") if others else ""
    parameters = {path: p for path, p in cause.parameters.items() if path != effect.path}
    return replace(
        cause, name=twin.name, group=(twin.name, *others), parameters=parameters, separating_measurement=text
    )


def _spin_cause(found: BallFindings, confidence: float, values: dict, ranges: list, quantile: float) -> Cause:
    """Balls that spin: the coefficient, and the distribution of the spins that goes with it."""
    choice, problem = found.choice, found.problem
    path = "ball.flight.magnus_coefficient"
    parameters = {}
    scores = evidence.with_spin(found.projected, choice.prior.std)
    columns = [*choice.effects, *scores.always]
    error = np.sqrt(np.diagonal(evidence.sandwich(scores, columns)))
    k = float(found.situation.theta[problem.coefficient]) if problem.coefficient is not None else problem.nominal[path]
    if problem.coefficient is not None:
        wide = float(error[-1]) * quantile
        known = wide < 0.5 * REFERENCE_MAGNUS
        low, high = (max(k - wide, 0.0), k + wide) if known else (0.3, 1.5)
        parameters[path] = Estimate(problem.nominal[path], k, low, high, "1")
        values[path] = k
        ranges.append(Range(path, low, high))
    n = problem.grid.n
    for axis, mean, std, e in zip("xyz", choice.prior.mean, choice.prior.std, error[len(choice.effects) :]):
        wide = quantile * std / np.sqrt(2.0 * n)
        parameters[f"ball_spin.mean_{axis}"] = Estimate(
            0.0, float(mean), float(mean - quantile * e), float(mean + quantile * e), "rad/s"
        )
        parameters[f"ball_spin.std_{axis}"] = Estimate(
            0.0, float(std), float(max(std - wide, 0.0)), float(std + wide), "rad/s"
        )
        values |= {f"ball_spin.mean_{axis}": float(mean), f"ball_spin.std_{axis}": float(std)}
    rms = float(np.sqrt(np.sum(choice.prior.std**2 + choice.prior.mean**2)))
    return Cause(
        "magnus",
        ("magnus",),
        confidence,
        parameters,
        float(1e3 * rms * found.trial.spin_shift),
        "in flight only the product of coefficient and spin shows: " + BY_NAME["magnus"].reading,
    )


def _confidence(found: BallFindings, seed: int) -> list[float]:
    """Share of bootstrap draws of the balls in which each cause (or one of its group) is chosen; spin last."""
    choice, rng = found.choice, np.random.default_rng(seed)
    n, k = found.problem.grid.n, len(found.trial.effects)
    spins = [choice.spin] if found.trial.spin == "free" or choice.prior is None else [True]
    scores = {
        s: evidence.with_spin(found.projected, choice.prior.std) if s else evidence.without_spin(found.projected)
        for s in spins
    }
    ok = {s: tuple(i for i in range(k) if found.seen[i] and not (s and i == found.problem.coefficient)) for s in spins}
    hits = np.zeros(len(choice.effects) + 1)
    for _ in range(BOOTSTRAP):
        count = rng.multinomial(n, np.full(n, 1.0 / n)).astype(float)
        best = (-np.inf, (), False)
        for s in spins:
            q = scores[s]
            drawn = evidence.Scores(
                np.tensordot(count, q.ball_gram, 1), count @ q.ball_right, q.ball_gram, q.ball_right, q.base, q.always
            )
            gains = evidence.all_gains(drawn, ok[s])
            top = max(gains, key=lambda x: gains[x] - choice.threshold * len(x))
            best = max(best, (gains[top] - choice.threshold * len(top), top, s))
        for i, group in enumerate(choice.groups):
            hits[i] += bool(set(group) & set(best[1]))
        hits[-1] += best[2]
    return [float(h) / BOOTSTRAP for h in hits]


def _unseen(found: BallFindings, hits: HitFindings | None, without) -> tuple[list[str], list[str]]:
    """Effects that no ball log shows, and effects that these balls do not excite."""
    invisible = {
        n: why for n, why in INVISIBLE.items() if n not in without and not (hits is not None and n == "ball_latency")
    }
    hidden = [f"{name}: {why}" for name, why in invisible.items()]
    if found.problem.coefficient is not None and found.choice.spin:
        hidden.append("magnus_coefficient and spin: in flight only their product shows")
    out = {found.trial.effects[i].name for i in found.trial.left_out}
    excited = [
        e.name
        for i, e in enumerate(found.trial.effects)
        if not found.seen[i] and e.name not in invisible and e.name not in out
    ]
    if found.trial.spin == "none" and not found.choice.spin:
        excited = [name for name in excited if not BY_NAME[name].needs_spin]
    at_paddle = [
        e.name for e in EFFECTS if e.group == AT_THE_PADDLE and e.name not in without and e.name not in INVISIBLE
    ]
    return hidden, excited + (at_paddle if hits is None else list(hits.quiet))


def _undetermined(found: BallFindings) -> bool:
    """Another set of the same size explains as much, and differs by more than members of the groups."""
    choice = found.choice
    for subset, spun, gain in choice.runners_up:
        if len(subset) != len(choice.effects) or spun != choice.spin or choice.gain - gain > selection.TIE:
            continue
        strangers = [e for e in subset if not any(e in group for group in choice.groups)]
        if len(strangers) and len(set(choice.effects) - set(subset)) > 1:
            return True
    return False
