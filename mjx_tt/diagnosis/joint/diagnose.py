"""Joint by joint: effects that are named, what they leave over, and what the log says nothing about."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from mjx_tt.diagnosis.joint import cross_validation, estimates
from mjx_tt.diagnosis.joint.effects import CATALOGUE, NAMES, members
from mjx_tt.diagnosis.joint.encoder_home import offset_at
from mjx_tt.diagnosis.joint.experiment_design import separating, unseen
from mjx_tt.diagnosis.joint.findings import RobotCause, RobotFindings, merge
from mjx_tt.diagnosis.joint.fit import Fitter
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.naming import Verdict, examine
from mjx_tt.diagnosis.joint.records import JointRecord
from robot_io.contract import JOINT_NAMES


def diagnose_robot(
    records: Sequence[JointRecord],
    nominal: Mapping[str, JointResponse],
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    without: Sequence[str] = (),
    home: Mapping[str, float] | None = None,
) -> RobotFindings:
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
    _check([record.joint for record in records], nominal, without, home)
    streams = np.random.default_rng(seed).spawn(len(records))
    found = []
    for i, (record, rng) in enumerate(zip(records, streams)):
        joint = record.joint
        gone = {effect for at, _, effect in (name.rpartition(".") for name in without) if at in ("", joint)}
        found.append(_of_joint(JointLog(record, nominal[joint]), gone, home.get(joint), rng))
        if progress is not None:
            progress(joint, i + 1, len(records))
    return merge(found)


def _check(joints: Sequence[str], nominal: Mapping, without: Sequence[str], home: Mapping) -> None:
    if not joints:
        raise ValueError("no record of a joint to diagnose")
    twice = sorted({name for name in joints if joints.count(name) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: more than one record; join the logs of one joint in order of time first")
    for joint in joints:
        if joint not in nominal:
            raise ValueError(f"no nominal response of {joint}; there are {', '.join(nominal)}")
    for name in without:
        joint, _, effect = name.rpartition(".")
        if effect not in NAMES or joint not in ("", *JOINT_NAMES):
            raise ValueError(
                f"no robot effect {name!r} to leave out; effects are {', '.join(NAMES)}, with or without a joint"
            )
    for name in home:
        if name not in joints:
            raise ValueError(f"home position of {name}, which has no record; there are {', '.join(joints)}")


def _of_joint(log: JointLog, gone: set[str], home: float | None, rng: np.random.Generator) -> RobotFindings:
    """Findings of one joint without the effects that are gone."""
    allowed = [e.name for e in CATALOGUE if not gone.intersection(members(e.name))]
    fitter = Fitter(log)
    verdict = examine(fitter, allowed)
    found = merge(
        [
            _causes(fitter, verdict),
            offset_at(home, log, verdict, "joint_offset" not in gone),
            unseen(log, verdict, allowed),
            _unexplained(log, verdict),
            _predictions(fitter, verdict, rng),
        ]
    )
    changes = {name: values[1] for cause in found.causes for name, values in cause.parameters.items()}
    return dataclasses.replace(found, responses={log.record.joint: dataclasses.replace(log.nominal, **changes)})


def _causes(fitter: Fitter, verdict: Verdict) -> RobotFindings:
    log, joint = fitter.log, fitter.log.record.joint
    intervals = estimates.intervals(fitter, verdict.fit, verdict.judge) if verdict.named else {}
    causes = []
    for effect, named in verdict.named.items():
        group = itertools.chain.from_iterable(map(members, (effect, *named.rivals)))
        causes.append(
            RobotCause(
                name=f"{joint}.{effect}",
                group=tuple(f"{joint}.{name}" for name in group),
                confidence=named.confidence,
                parameters=estimates.parameters(log, effect, verdict.fit.values[effect], intervals[effect]),
                effect=1e3 * named.movement,
                separating_measurement=separating(log, effect, named.rivals),
            )
        )
    experiments = (separating(log, effect, n.rivals) for effect, n in verdict.named.items() if n.rivals)
    return RobotFindings(causes=tuple(causes), next_experiment=tuple(experiments))


def _unexplained(log: JointLog, verdict: Verdict) -> RobotFindings:
    joint, left = log.record.joint, verdict.leftover
    if left is None:
        return RobotFindings()
    about = {"joint": joint, "block": f"{joint}: {left.block.name}", "where": left.where, "direction": left.direction}
    return RobotFindings(unexplained_by_joint=({**about, "size": 1e3 * left.size},))


def _predictions(fitter: Fitter, verdict: Verdict, rng: np.random.Generator) -> RobotFindings:
    """Of the named effects alone: without those of the fit that are not, they are fitted anew."""
    sigma, values = verdict.judge.sigma, {effect: verdict.fit.values[effect] for effect in verdict.named}
    if values and len(values) < len(verdict.fit.values):
        values = fitter.fit(values, sigma).values
    gain = cross_validation.held_out(fitter, values, sigma, rng)
    return RobotFindings(held_out=(gain,), residuals=(cross_validation.residuals(fitter.log, values),))
