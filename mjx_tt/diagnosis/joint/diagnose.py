"""Diagnosis joint by joint: effects that are named, what they do not explain, and what the log cannot show."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container, Mapping, Sequence

import numpy as np

from mjx_tt.diagnosis.inclusion import LEAST_LEFT_SHARE
from mjx_tt.diagnosis.joint import cross_validation
from mjx_tt.diagnosis.joint.coupling import coupling
from mjx_tt.diagnosis.joint.effects import BY_NAME, EFFECTS, NAMES, members
from mjx_tt.diagnosis.joint.encoder_home import offset_at
from mjx_tt.diagnosis.joint.experiment_design import separating, unseen
from mjx_tt.diagnosis.joint.findings import JointFinding, JointFindings, merge
from mjx_tt.diagnosis.joint.fit import SMALLEST_NOISE, estimates, fit, intervals, rms
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.log import JointLog, JointRecord
from mjx_tt.diagnosis.joint.search import FLOOR, JointSearch, search
from mjx_tt.diagnosis.verdict import Cause, Experiment, Expressed, HeldOut, Part, Unexplained

SURE = 0.5  # share of half logs that a name must survive


def diagnose_joints(
    records: Sequence[JointRecord],
    nominal: Mapping[str, JointResponse],
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    without: Sequence[str] = (),
    home: Mapping[str, float] | None = None,
) -> JointFindings:
    """Names what the nominal responses of the joints get wrong.

    records: one for each joint.
    nominal: what the simulation believes, for each joint of the records.
    seed: of the bootstrap intervals.
    progress: called with joint, number of joints done and number of joints.
    without: effects left out of the catalogue, "lag" for all joints or "joint_2.lag".
    home: true position [rad], [m] in which a joint rests before its first motion; without it a constant offset of the
        measured position cannot be told from the start.
    Raises ValueError for no record, a joint twice, a joint without a nominal response, and names in without or home
    that do not exist.
    """
    home = home or {}
    _check(records, nominal, without, home)
    streams = np.random.default_rng(seed).spawn(len(records))
    found: dict[str, JointFindings] = {}
    beside = coupling(records, nominal) if any(n.servo for n in nominal.values()) else {}

    def diagnose(record: JointRecord, rng: np.random.Generator) -> None:
        joint = record.joint
        gone = {effect for at, _, effect in (name.rpartition(".") for name in without) if at in ("", joint)}
        found[joint] = _of_joint(JointLog(record, nominal[joint], beside.get(joint)), gone, home.get(joint), rng)

    for i, (record, rng) in enumerate(zip(records, streams, strict=True)):
        diagnose(record, rng)
        if progress is not None:
            progress(record.joint, i + 1, len(records))
    responses = merge(tuple(found.values())).responses
    if beside and any(part.causes for part in found.values()):
        # What was named moves the servos otherwise: once more with the robot that has it.
        beside = coupling(records, {**nominal, **responses})
        for record, rng in zip(records, streams, strict=True):
            if found[record.joint].causes or found[record.joint].unexplained:
                diagnose(record, rng)
    return merge(tuple(found.values()))


def _check(records: Sequence[JointRecord], nominal: Mapping, without: Sequence[str], home: Mapping) -> None:
    if not records:
        raise ValueError("no record of a joint to diagnose")
    joints, known = [record.joint for record in records], records[0].robot.contract.joints
    twice = sorted({name for name in joints if joints.count(name) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: more than one record; join the logs of one joint in order of time first")
    for joint in joints:
        if joint not in nominal:
            raise ValueError(f"no nominal response of {joint}; there are {', '.join(nominal)}")
    for name in without:
        joint, _, effect = name.rpartition(".")
        if effect not in NAMES or joint not in ("", *known):
            raise ValueError(
                f"no robot effect {name!r} to leave out; effects are {', '.join(NAMES)}, with or without a joint"
            )
    for name in home:
        if name not in joints:
            raise ValueError(f"home position of {name}, which has no record; there are {', '.join(joints)}")


def _of_joint(log: JointLog, gone: set[str], home: float | None, rng: np.random.Generator) -> JointFindings:
    """Findings of one joint without the effects that are gone."""
    joint, allowed = log.record.joint, [e.name for e in EFFECTS if not gone.intersection(members(e.name))]
    found = search(log, allowed) if log.fastest > 0.0 else None
    named = {} if found is None else _named(log, found, rng)
    told = merge(
        [
            JointFindings() if found is None else _causes(log, found, named),
            offset_at(home, log, found, "joint_offset" not in gone),
            unseen(log, found, named, allowed),
            _predictions(log, found, named, rng),
        ]
    )
    changes = {p.removeprefix(f"{joint}."): e.estimate for cause in told.causes for p, e in cause.parameters.items()}
    return dataclasses.replace(told, responses={joint: dataclasses.replace(log.nominal, **changes)})


def _named(log: JointLog, found: JointSearch, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Of the chosen effects those of a size that matters, that most halves of the log show, and that explain more than
    all leave, for which they could stand: each one's movement [rad], [m] rms, and its confidence."""
    confidence = found.model.confidence(found.picked.causes, rng)
    moved = {}
    for name, value in found.values.items():
        rest = {n: v for n, v in found.values.items() if n != name}
        movement = rms(log.centred(log.simulate(found.values) - log.simulate(rest)))
        sure = confidence[found.names.index(name)]
        if sure <= SURE or found.share(name) <= found.left_share:
            continue
        if movement >= FLOOR and abs(value - log.base[name]) >= BY_NAME[name].smallest:
            moved[name] = movement, sure
    return moved


def _causes(log: JointLog, found: JointSearch, named: Mapping[str, tuple[float, float]]) -> JointFindings:
    joint, chosen = log.record.joint, found.picked.causes
    ends = intervals(log, found.values, found.sigma, found.model.temper, found.others) if named else {}
    causes, experiments = [], []
    for effect, (movement, confidence) in named.items():
        k = found.names.index(effect)
        rivals = [found.names[i] for i in found.model.group(chosen, k)[1:]]
        fitted = estimates(log, effect, found.values[effect], ends[effect])
        measurement = separating(log, effect, rivals)
        causes.append(
            Cause(
                name=f"{joint}.{effect}",
                group=tuple(f"{joint}.{name}" for e in (effect, *rivals) for name in members(e)),
                confidence=confidence,
                parameters={f"{joint}.{name}": estimate for name, estimate in fitted.items()},
                effect_mm=1e3 * movement,
                separating_measurement=measurement,
                share=found.share(effect),
            )
        )
        experiments += [measurement] if rivals else []
    open_: tuple[JointFinding, ...] = ()
    if found.left > FLOOR and found.left_share > LEAST_LEFT_SHARE:
        open_ = (JointFinding(joint, *found.pattern, 1e3 * found.left),)
    return JointFindings(causes=tuple(causes), next_experiment=tuple(experiments), unexplained_by_joint=open_)


def _predictions(
    log: JointLog, found: JointSearch | None, named: Container[str], rng: np.random.Generator
) -> JointFindings:
    """Predictions by the named effects alone: beside others that the fit holds, they are fitted anew."""
    sigma = SMALLEST_NOISE if found is None else found.sigma
    values = {} if found is None else {name: value for name, value in found.values.items() if name in named}
    if found is not None and 0 < len(values) < len(found.values):
        values = fit(log, values, sigma)
    gain = cross_validation.held_out(log, values, sigma, rng)
    return JointFindings(held_out=(gain,), residuals=(cross_validation.residuals(log, values),))


def parts(found: JointFindings) -> tuple[Part, ...]:
    """The joints' parts of the verdict: one for all together, and one for each that has a cause or something open.

    What one joint leaves unexplained says nothing against another's causes. Those that leave most come first.
    """
    held_out = None
    if found.held_out:
        means = (1e3 * np.mean([getattr(g, n) for g in found.held_out]) for n in ("before", "after", "low", "high"))
        metric = "rms of joint positions on windows not used, mean over joints [mrad], [mm]"
        held_out = HeldOut(metric, *map(float, means))
    together = Part(
        held_out=held_out,
        not_identifiable=tuple(f"{u.name}: {u.why}" for u in found.not_identifiable),
        not_excited=tuple(f"{u.name}: {u.why}" for u in found.not_excited),
        next_experiment=tuple(Experiment(text, (), 0.0) for text in found.next_experiment),
    )
    open_ = {u.joint: u for u in found.unexplained_by_joint}
    every = dict.fromkeys([*open_, *(cause.name.partition(".")[0] for cause in found.causes)])
    return together, *(_part_of(joint, found, open_.get(joint)) for joint in every)


def _part_of(joint: str, found: JointFindings, left: JointFinding | None) -> Part:
    named = tuple(Expressed(c, _drive_values(c)) for c in found.causes if c.name.partition(".")[0] == joint)
    if left is None:
        return Part(named)
    open_ = Unexplained(f"{joint}: {left.block}", left.where, left.direction, f"{left.size:.2f} mrad or mm")
    return Part(named, unexplained=open_, adopted=any(g.low > 0.0 for g in found.held_out if g.joint == joint))


def _drive_values(cause: Cause) -> dict[str, float]:
    """Parameters of SimModel's drives; their delays are extra to the drawn latency."""
    return {
        f"drives.{path}": e.estimate - e.nominal if path.endswith("_delay") else e.estimate
        for path, e in cause.parameters.items()
    }
