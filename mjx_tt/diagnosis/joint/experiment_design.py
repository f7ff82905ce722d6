"""Effects that a log cannot show, and the log that would."""

from __future__ import annotations

from collections.abc import Container, Sequence

from mjx_tt.diagnosis.joint.effects import BY_NAME, OBSERVATION_DELAY, members
from mjx_tt.diagnosis.joint.findings import JointFindings, Undecided
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.search import JointSearch


def unseen(log: JointLog, found: JointSearch | None, named: Container[str], allowed: Sequence[str]) -> JointFindings:
    """The allowed effects about which this log holds no evidence."""
    joint = log.record.joint
    why = "only the sum of action_delay and observation_delay shows in a log"
    delays = (Undecided(f"{joint}.observation_delay", why),) if "action_delay" in named else ()
    quiet = [e for e in allowed if e not in named and not _excited(log, found, e)]
    return JointFindings(
        not_identifiable=delays,
        not_excited=tuple(Undecided(f"{joint}.{m}", _why(log, e)) for e in quiet for m in members(e)),
        next_experiment=tuple(BY_NAME[e].reading_of(log) for e in quiet),
    )


def _excited(log: JointLog, found: JointSearch | None, name: str) -> bool:
    """True if the effect at the smallest size of interest would have been seen."""
    if found is None:
        return False
    value = BY_NAME[name].interest(log, log.base[name])
    change = log.simulate({**found.values, name: value}) - log.simulate(found.values)
    return found.visible(log, log.centred(change))


def _why(log: JointLog, name: str) -> str:
    if log.fastest == 0.0:
        return "the joint never moves"
    value, unit = BY_NAME[name].interest(log, log.base[name]), BY_NAME[name].unit_of(log)
    unit = "" if unit == "1" else f" {unit}"
    return f"{value:.3g}{unit} instead of {log.base[name]:.3g} would move the joint by too little to be seen"


def separating(log: JointLog, name: str, rivals: Sequence[str]) -> str:
    """Measurements that would tell an effect from its rivals, and one delay from the other."""
    texts = [BY_NAME[n].reading_of(log) for n in (name, *rivals)] if rivals else []
    return "; ".join([*texts, OBSERVATION_DELAY.reading] if name == "action_delay" else texts)
