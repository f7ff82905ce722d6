"""The operator's one key, step by step."""

from __future__ import annotations

import pytest

from experiments.deploy.recovery import LONGEST, Recovery
from robot_io.control.messages import Arm, FaultReport, Prepare, Refused, Reset, Status
from robot_io.errors import RefusedError

FAULT = FaultReport("stale_arm", "nothing heard")


def status(state="fault", faults=(FAULT,), present=None, arm=None):
    return Status(0.0, state, False, False, faults, present or {}, arm, None, None, [])


def test_each_step_is_sent_once_and_when_nothing_stands_against_it():
    recovery, sent = Recovery(0.0), []
    for seen in (
        status(arm="silent", present={"stale_arm": "nothing heard"}),
        status(arm="silent", present={"stale_arm": "nothing heard"}),
        status(present={"stale_arm": "nothing heard"}),
        status(),
        status(),  # the reset is on its way
        status("disarmed", ()),
    ):
        sent.append(recovery.step(seen, 1.0))
    assert sent == [Prepare(), None, None, Reset(), None, Arm()] and recovery.done


def test_without_a_fault_nothing_is_reset():
    recovery = Recovery(0.0)
    assert [recovery.step(status("disarmed", ()), 1.0) for _ in range(2)] == [Prepare(), Arm()] and recovery.done


def test_axes_that_do_not_answer_yet_are_prepared_again():
    recovery = Recovery(0.0)
    assert recovery.step(status(), 1.0) == Prepare()
    assert not recovery.refused(Refused(Prepare(), RefusedError("one of them does not answer yet")))
    assert [recovery.step(status(), 1.0) for _ in range(2)] == [Prepare(), Reset()]
    assert recovery.refused(Refused(Reset(), RefusedError("cannot reset: it still moves")))


def test_what_is_missing_is_told_when_it_lasts():
    recovery = Recovery(0.0)
    recovery.step(status(), 0.0)
    with pytest.raises(TimeoutError, match="arm: silent; nothing heard"):
        recovery.step(status(arm="silent", present={"stale_arm": "nothing heard"}), LONGEST + 0.1)
