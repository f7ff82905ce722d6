"""Diagnosis joint by joint: effects that are named, what they do not explain, and what the log cannot show."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mjx_tt.diagnosis.joint import cross_validation, selection
from mjx_tt.diagnosis.joint.coupling import coupling
from mjx_tt.diagnosis.joint.effects import EFFECTS, NAMES, members
from mjx_tt.diagnosis.joint.encoder_home import offset_at
from mjx_tt.diagnosis.joint.experiment_design import separating, unseen
from mjx_tt.diagnosis.joint.findings import JointFinding, JointFindings, merge
from mjx_tt.diagnosis.joint.fit import Fitter, estimates, intervals
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.log import JointLog, JointRecord
from mjx_tt.diagnosis.joint.selection import Choice
from mjx_tt.diagnosis.verdict import Cause, Experiment, Expressed, HeldOut, Part, Unexplained


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
    fitter = Fitter(log)
    choice = selection.choose(fitter, allowed)
    found = merge(
        [
            _causes(fitter, choice),
            offset_at(home, log, choice, "joint_offset" not in gone),
            unseen(log, choice, allowed),
            _unexplained(log, choice),
            _predictions(fitter, choice, rng),
        ]
    )
    changes = {p.removeprefix(f"{joint}."): e.estimate for cause in found.causes for p, e in cause.parameters.items()}
    return dataclasses.replace(found, responses={joint: dataclasses.replace(log.nominal, **changes)})


def _causes(fitter: Fitter, choice: Choice) -> JointFindings:
    log, joint = fitter.log, fitter.log.record.joint
    ends = intervals(fitter, choice.fit, choice.judge) if choice.named else {}
    causes = []
    for effect, named in choice.named.items():
        group = itertools.chain.from_iterable(map(members, (effect, *named.rivals)))
        fitted = estimates(log, effect, choice.fit.values[effect], ends[effect])
        causes.append(
            Cause(
                name=f"{joint}.{effect}",
                group=tuple(f"{joint}.{name}" for name in group),
                confidence=named.confidence,
                parameters={f"{joint}.{name}": estimate for name, estimate in fitted.items()},
                effect_mm=1e3 * named.movement,
                separating_measurement=separating(log, effect, named.rivals),
            )
        )
    experiments = (separating(log, effect, n.rivals) for effect, n in choice.named.items() if n.rivals)
    return JointFindings(causes=tuple(causes), next_experiment=tuple(experiments))


def _unexplained(log: JointLog, choice: Choice) -> JointFindings:
    joint, left = log.record.joint, choice.unexplained
    if left is None:
        return JointFindings()
    block = f"{joint}: {left.block.name}"
    return JointFindings(
        unexplained_by_joint=(JointFinding(joint, block, left.where, left.direction, 1e3 * left.size),)
    )


def _predictions(fitter: Fitter, choice: Choice, rng: np.random.Generator) -> JointFindings:
    """Predictions by the named effects alone: beside others that the fit holds, they are fitted anew."""
    sigma, values = choice.judge.sigma, {effect: choice.fit.values[effect] for effect in choice.named}
    if values and len(values) < len(choice.fit.values):
        values = fitter.fit(values, sigma).values
    gain = cross_validation.held_out(fitter, values, sigma, rng)
    return JointFindings(held_out=(gain,), residuals=(cross_validation.residuals(fitter.log, values),))


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
    size = f"{left.size:.2f} mrad or mm"
    return Part(named, unexplained=Unexplained(f"{left.joint}: {left.block}", left.where, left.direction, size))


def _drive_values(cause: Cause) -> dict[str, float]:
    """Parameters of SimModel's drives; their delays are extra to the drawn latency."""
    return {
        f"drives.{path}": e.estimate - e.nominal if path.endswith("_delay") else e.estimate
        for path, e in cause.parameters.items()
    }
