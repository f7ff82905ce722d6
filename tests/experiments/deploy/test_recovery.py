"""The operator's one key, step by step."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from experiments.deploy.recovery import LONGEST, Controls, Recovery
from robot_io.control.messages import Arm, Discard, FaultReport, Prepare, Refused, Reset, Status
from robot_io.errors import RefusedError

FAULT = FaultReport("stale_arm", "nothing heard")
SILENT = {"present": {"stale_arm": "nothing heard"}, "arm": "silent"}
UNPLUGGED = {"present": {"axis_lost": "x is lost"}, "axes": "x is lost"}
UNHOMED = {"axes": "x is not homed", "preparable": True}


def status(state="fault", faults=None, present=None, arm=None, axes=None, preparable=False, tracker=None, ramping=None):
    faults = (FAULT,) * (state == "fault") if faults is None else faults
    return Status(
        0.0, state, False, False, faults, present or {}, arm, axes, tracker, [], preparable=preparable, ramping=ramping
    )


def steps(recovery, *statuses):
    """Requests for each status; ``done`` ends it."""
    return [None if recovery.done else recovery.step(seen, 1.0) for seen in statuses]


def test_where_nothing_is_missing_each_step_is_sent_once_up_to_arming():
    recovery = Recovery(0.0, status())
    sent = steps(recovery, status(), status(), status(), status("disarmed"))
    assert sent == [Prepare(), Reset(), None, Arm()] and recovery.done and not recovery.message


def test_a_lost_reference_is_found_after_the_reset():
    """In a fault nothing is homed: Prepare is asked for again."""
    lost = {"present": {"axis_lost": "x is not homed"}} | UNHOMED
    recovery = Recovery(0.0, status(**lost))
    assert steps(recovery, status(**lost)) == [Prepare()]
    assert not recovery.refused(Refused(Prepare(), RefusedError("axes not homed: the state is fault")))
    sent = steps(
        recovery,
        status(**UNHOMED),
        status("disarmed", **UNHOMED),
        status("disarmed", **UNHOMED),
        status("disarmed"),
    )
    assert sent == [Reset(), Prepare(), None, Arm()]


@pytest.mark.parametrize(
    "mended",
    [
        SILENT,
        {"present": {"estop": "the emergency stop is pressed"}},
        UNPLUGGED,
        {"ramping": "EGM has just begun"},
        {"tracker": "silent"},
        {"present": {"limit": "joint_1 is out of its range"}},
    ],
    ids=["arm", "emergency stop", "cable", "arm just switched on", "tracker", "place"],
)
@pytest.mark.parametrize("at_the_key", [True, False])
def test_nothing_moves_because_somebody_else_mends_something(mended, at_the_key):
    """Neither homed nor armed, whenever that was missing; the operator is asked for the next key."""
    missing = status(**mended)
    recovery = Recovery(0.0, missing if at_the_key else status())
    assert steps(recovery, missing) == [Prepare()]
    assert set(steps(recovery, *[missing] * 9)) <= {None, Reset()}
    sent = steps(recovery, status(), status(), status("disarmed"), status("disarmed"))
    assert not {Arm(), Prepare()} & set(sent)
    assert recovery.done and recovery.message == "all is well: press a to arm"


def test_what_still_has_to_be_homed_then_is_told():
    recovery = Recovery(0.0, status(**UNPLUGGED))
    sent = steps(recovery, status(**UNPLUGGED), status(**UNHOMED), status("disarmed", **UNHOMED))
    assert sent == [Prepare(), Reset(), None]
    assert recovery.message == "reset, not armed: axes: x is not homed"


def test_a_key_that_comes_before_any_status_arms_nothing():
    recovery = Recovery(0.0, None)
    assert steps(recovery, status(), status(), status("disarmed")) == [Prepare(), Reset(), None] and recovery.done


def test_without_a_fault_nothing_is_reset():
    recovery = Recovery(0.0, status("disarmed"))
    assert steps(recovery, status("disarmed"), status("disarmed")) == [Prepare(), Arm()] and recovery.done
    recovery = Recovery(0.0, status("disarmed", tracker="silent"))
    assert steps(recovery, status("disarmed", tracker="silent")) == [Prepare()]
    assert recovery.done and recovery.message == "not armed: tracker: silent"


@pytest.mark.parametrize("state", ["ready", "active"])
def test_a_robot_that_is_armed_is_left_alone(state):
    """A fault seconds later would be reset unseen."""
    recovery = Recovery(0.0, status(state))
    assert steps(recovery, status(state)) == [None] and recovery.done and "nothing to recover" in recovery.message


def test_a_second_fault_is_not_reset():
    recovery = Recovery(0.0, status())
    assert steps(recovery, status(), status(), status(), status()) == [Prepare(), Reset(), None, None]
    with pytest.raises(TimeoutError):
        recovery.step(status(), LONGEST + 0.1)


def test_a_search_may_take_its_time_and_twenty_seconds_begin_after_it():
    recovery, searching = Recovery(0.0, status(**UNHOMED)), replace(status("disarmed", **UNHOMED), homing=True)
    assert recovery.step(status(**UNHOMED), 1.0) == Prepare() and recovery.step(status(**UNHOMED), 2.0) == Reset()
    recovery.step(status("disarmed", **UNHOMED), 2.1)
    for now in range(3, 61):
        assert recovery.step(searching, float(now)) is None
    assert recovery.step(status("disarmed"), 60.0 + LONGEST - 0.1) == Arm()


def test_axes_that_do_not_answer_yet_are_prepared_again():
    recovery = Recovery(0.0, status(**UNPLUGGED))
    assert steps(recovery, status(**UNPLUGGED), status(**UNPLUGGED)) == [Prepare(), None]
    assert not recovery.refused(Refused(Prepare(), RefusedError("one of them does not answer yet")))
    assert steps(recovery, status(**UNPLUGGED), status()) == [Prepare(), Reset()]
    assert recovery.refused(Refused(Reset(), RefusedError("cannot reset: it still moves")))


def test_the_emulated_rig_waits_and_goes_on_by_itself():
    recovery = Recovery(0.0, status(**SILENT), emulated=True)
    sent = steps(recovery, status(**SILENT), status(**SILENT), status(), status(), status("disarmed"))
    assert sent == [Prepare(), None, Reset(), None, Arm()] and recovery.done and not recovery.message
    recovery = Recovery(0.0, None, emulated=True)
    assert steps(recovery, status("disarmed", **UNPLUGGED))[0] == Prepare()
    recovery.refused(Refused(Prepare(), RefusedError("one of them does not answer yet")))
    sent = steps(recovery, status("disarmed", **UNPLUGGED), status("disarmed", **UNHOMED), status("disarmed"))
    assert sent == [Prepare(), None, Arm()]


def test_what_is_missing_is_told_when_it_lasts():
    recovery = Recovery(0.0, status(**SILENT))
    recovery.step(status(**SILENT), 0.0)
    with pytest.raises(TimeoutError, match="arm: silent; nothing heard"):
        recovery.step(status(**SILENT), LONGEST + 0.1)


def test_what_passes_by_itself_is_waited_for():
    """EGM that has begun anew ramps commands in for some seconds, after an emergency stop for instance."""
    stop = {"present": {"estop": "the emergency stop is pressed"}, "arm": "motors off"}
    recovery = Recovery(0.0, status(**stop))
    ramps = replace(status("disarmed"), ramping="EGM has just begun")
    sent = steps(recovery, status(**stop), status(), ramps, ramps)
    assert sent == [Prepare(), Reset(), None, None] and not recovery.done
    assert recovery.step(status("disarmed"), 1.0) is None and recovery.message == "all is well: press a to arm"


def test_the_key_begins_it_and_the_next_key_or_a_refusal_ends_it():
    sent, said, keys = [], [], ["c", "d", "c", None]
    session, view = (
        SimpleNamespace(status=status(), send=sent.append),
        SimpleNamespace(say=said.append, take=said.append),
    )
    controls = Controls(session, SimpleNamespace(pressed=lambda: keys.pop(0)), view, emulated=False)
    assert controls.pressed() == "c" and not sent
    controls.take(status())
    controls.take(Refused(Prepare(), RefusedError("an axis does not answer yet")))
    controls.take(status())
    assert sent == [Prepare(), Reset()]
    assert controls.pressed() == "d"
    controls.take(status("disarmed"))
    assert sent[2:] == [Discard()]
    assert controls.pressed() == "c" and controls.pressed() is None
    for message in (status(), status(), status("disarmed"), status("disarmed")):
        controls.take(message)
    assert sent[3:] == [Prepare(), Reset(), Arm()]
