"""Effects that a log cannot show, and the log that would."""

from __future__ import annotations

from collections.abc import Sequence

from mjx_tt.diagnosis.joint.effects import EFFECTS, members
from mjx_tt.diagnosis.joint.findings import RobotFindings, Undecided
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.naming import Verdict


def unseen(log: JointLog, verdict: Verdict, allowed: Sequence[str]) -> RobotFindings:
    """What of the allowed effects this log says nothing about."""
    joint = log.record.joint
    why = "only the sum of action_delay and observation_delay shows in a log"
    delays = (Undecided(f"{joint}.observation_delay", why),) if "action_delay" in verdict.named else ()
    quiet = [e for e in allowed if e not in verdict.named and not _excited(log, verdict, e)]
    return RobotFindings(
        not_identifiable=delays,
        not_excited=tuple(Undecided(f"{joint}.{m}", _why(log, e)) for e in quiet for m in members(e)),
        next_experiment=tuple(EFFECTS[e].experiment_for(log) for e in quiet),
    )


def _excited(log: JointLog, verdict: Verdict, name: str) -> bool:
    """Whether the effect at the smallest size of interest would have been seen."""
    if log.fastest == 0.0:
        return False
    value = EFFECTS[name].interest(log, log.base[name])
    change = log.simulate({**verdict.fit.values, name: value}) - log.simulate(verdict.fit.values)
    return verdict.judge.visible(log.centred(change))


def _why(log: JointLog, name: str) -> str:
    if log.fastest == 0.0:
        return "the joint never moves"
    value, unit = EFFECTS[name].interest(log, log.base[name]), EFFECTS[name].unit_of(log)
    unit = "" if unit == "1" else f" {unit}"
    return f"{value:.3g}{unit} instead of {log.base[name]:.3g} would move the joint by too little to be seen"


def separating(log: JointLog, name: str, rivals: Sequence[str]) -> str:
    """Measurements that would tell an effect from its rivals, and one delay from the other."""
    texts = [EFFECTS[n].experiment_for(log) for n in (name, *rivals)] if rivals else []
    if name == "action_delay":
        texts.append("stamp a command's arrival at the drive and a state's departure with one clock")
    return "; ".join(texts)
