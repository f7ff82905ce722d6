"""The zero of a joint's encoder, which shows only against a home position known in absolute terms."""

from __future__ import annotations

import math

import numpy as np

from mjx_tt.diagnosis.joint.estimates import INTERVAL
from mjx_tt.diagnosis.joint.findings import RobotCause, RobotFindings, Undecided
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.naming import MOST_CONFIDENT, Verdict
from mjx_tt.diagnosis.joint.robust import scale
from mjx_tt.diagnosis.joint.scores import FLOOR


def offset_at(home: float | None, log: JointLog, verdict: Verdict, allowed: bool) -> RobotFindings:
    """joint_offset as a cause; as unexplained where it is not allowed; what is missing where the log lacks it.

    home: true position [rad], [m] in which the joint rests before its first motion, None when it is not known.
    """
    joint, nominal = log.record.joint, log.nominal.joint_offset
    name = f"{joint}.joint_offset"
    if home is None:
        why = "a constant offset needs a position known in absolute terms: home"
        return RobotFindings(not_identifiable=(Undecided(name, why),))
    measured = _measured(home, log, verdict)
    if measured is None:
        return RobotFindings(
            not_excited=(Undecided(name, "the log has no rest before the first motion"),),
            next_experiment=(f"hold {joint} still at its home position before it moves",),
        )
    offset, half = measured
    size = abs(offset - nominal)
    if size < max(FLOOR, 3.0 * half):
        return RobotFindings()
    if not allowed:
        left = {
            "joint": joint,
            "block": f"{joint}: position at home",
            "where": f"position {home:.3g} {log.unit}",
            "direction": "+" if offset > nominal else "-",
            "size": 1e3 * size,
        }
        return RobotFindings(unexplained_by_joint=(left,))
    parameters = {"joint_offset": (nominal, offset, offset - half, offset + half, log.unit)}
    return RobotFindings(causes=(RobotCause(name, (name,), MOST_CONFIDENT, parameters, 1e3 * size, ""),))


def _measured(home: float, log: JointLog, verdict: Verdict) -> tuple[float, float] | None:
    """Offset of the measured home position and half of its 90 % interval; None without a rest before any motion."""
    record = log.record
    moving = np.flatnonzero(record.command_velocity != 0.0)
    begin = record.command_time[moving[0]] if moving.size else math.inf
    delay = verdict.fit.values.get("action_delay", log.base["action_delay"])
    rest = record.state_position[record.state_time < begin + 0.8 * delay]
    if rest.size < 5:
        return None
    middle = float(np.median(rest))
    noise = max(scale(rest - middle), verdict.judge.sigma)
    # A median's error is 1.25 times a mean's.
    return middle - home, INTERVAL * 1.25 * noise * math.sqrt(min(verdict.judge.inflation / rest.size, 1.0))
