"""Zero of a joint's encoder, which shows only against a home position known in absolute terms."""

from __future__ import annotations

import math

import numpy as np

from mjx_tt.diagnosis.joint.effects import JOINT_OFFSET
from mjx_tt.diagnosis.joint.findings import JointFinding, JointFindings, Undecided
from mjx_tt.diagnosis.joint.fit import INTERVAL, scale
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.search import FLOOR, JointSearch
from mjx_tt.diagnosis.verdict import Cause, Estimate


def offset_at(home: float | None, log: JointLog, found: JointSearch | None, allowed: bool) -> JointFindings:
    """Cause joint_offset; unexplained where it is not allowed; named as undecided where the log cannot show it.

    home: true position [rad], [m] in which the joint rests before its first motion, None when it is not known.
    """
    joint, nominal = log.record.joint, log.nominal.joint_offset
    name = f"{joint}.joint_offset"
    if home is None:
        why = "a constant offset needs a position known in absolute terms: home"
        return JointFindings(not_identifiable=(Undecided(name, why),))
    measured = _measured(home, log, found)
    if measured is None:
        return JointFindings(
            not_excited=(Undecided(name, "the log has no rest before the first motion"),),
            next_experiment=(JOINT_OFFSET.reading.format(joint=joint),),
        )
    offset, half = measured
    size = abs(offset - nominal)
    if size < max(FLOOR, 3.0 * half):
        return JointFindings()
    if not allowed:
        direction = "+" if offset > nominal else "-"
        where = f"position {home:.3g} {log.unit}"
        left = JointFinding(joint, "position at home", where, direction, 1e3 * size)
        return JointFindings(unexplained_by_joint=(left,))
    estimate = Estimate(nominal, offset, offset - half, offset + half, log.unit)
    return JointFindings(causes=(Cause(name, (name,), 1.0, {name: estimate}, 1e3 * size, ""),))


def _measured(home: float, log: JointLog, found: JointSearch | None) -> tuple[float, float] | None:
    """Offset of the measured home position and half of its 90 % interval; None without a rest before any motion."""
    record = log.record
    moving = np.flatnonzero(record.command_velocity != 0.0)
    begin = record.command_time[moving[0]] if moving.size else math.inf
    values, sigma, temper = ({}, 0.0, 1.0) if found is None else (found.values, found.sigma, found.model.temper)
    delay = values.get("action_delay", log.base["action_delay"])
    rest = record.state_position[record.state_time < begin + 0.8 * delay]
    if rest.size < 5:
        return None
    middle = float(np.median(rest))
    noise = max(scale(rest - middle), sigma)
    # A median's error is 1.25 times a mean's.
    return middle - home, INTERVAL * 1.25 * noise * math.sqrt(min(temper / rest.size, 1.0))
