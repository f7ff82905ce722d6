"""Homing passes the gate by: it begins only where the arm is known to stand clear, and ends with any doubt of that."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.control.bridge import BridgeState
from robot_io.control.commissioning.homing import SLIP, prepare
from robot_io.control.interfaces import BridgeConfig
from robot_io.devices.egm.messages import encode_robot
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.config import RigParams
from robot_io.errors import RefusedError
from robot_io.safety.faults import Cause
from tests.support.lockstep_play import lockstep


def standing(**options):
    """A robot whose arm is on and whose axes are switched on and not homed."""
    rig = lockstep(params=RigParams(drive=DriveParams(homing_time=1.0)), **options)
    rig.arm.motors_on()
    rig.arm.start_rapid()
    rig.arm.start_egm()
    rig.run(0.1)
    rig.axes.enable()
    assert rig.run(1.0, lambda: rig.axes.state is not None and rig.axes.state.enabled)
    return rig


def prepared(rig):
    """The operator's request, as the control process carries it out."""
    prepare(rig.axes, lambda: rig.bridge.check_homing(rig.now))


def homing():
    """The same in the middle of its search, which takes 1 s."""
    rig = standing()
    prepared(rig)
    rig.run(0.3)
    assert all(emulator.drive.homing for emulator in rig.emulators) and rig.axes.homing
    return rig


def drag(rig, seconds, speed):
    """Somebody moves the arm's last but one joint, at a speed [rad/s]."""
    end = rig.now + seconds
    while rig.now < end:
        before = rig.now
        rig.step()
        rig.world.data.qpos[rig.world._q[6]] += speed * (rig.now - before)


def refused(rig, match):
    with pytest.raises(RefusedError, match=f"axes not homed: .*{match}"):
        prepared(rig)
    rig.run(0.2)
    assert not any(emulator.drive.homing for emulator in rig.emulators)


def test_a_place_of_the_arm_that_is_old_is_no_place():
    rig = standing()
    rig.arm_connected = False
    rig.run(1.0)
    refused(rig, "No EGM packet from the arm's controller for 1.0")
    rig.arm_connected = True
    rig.arm.start_egm()
    rig.run(0.2)
    prepared(rig)
    assert rig.run(2.0, lambda: rig.axes.homed)


def test_two_senders_leave_open_which_arm_it_is():
    rig = standing()
    place = rig.bridge.arm_session.feedback.position
    rival = encode_robot(1, 1, place, place, True, True, True)
    rig.bridge.arm_session.receive(rival, ("127.0.0.1", 6599), rig.now)
    refused(rig, "EGM packets come from ports")


def test_an_arm_that_is_not_ready_or_moves_is_none_to_home_beside():
    rig = standing()
    rig.arm.motors_off()
    rig.run(0.1)
    refused(rig, "motors are off")
    rig = standing()
    drag(rig, 0.1, 0.2)
    refused(rig, "the arm moves at 0.")


def test_axes_are_homed_without_a_fault_only():
    rig = standing()
    rig.bridge.gate.estop(True, rig.now)
    rig.run(0.1)
    refused(rig, "the state is fault; reset it first")
    rig.bridge.gate.estop(False, rig.now)
    rig.run(0.1)
    rig.bridge.reset(rig.now)
    prepared(rig)
    assert rig.run(2.0, lambda: rig.axes.homed)


@pytest.mark.parametrize(
    ("happens", "told"),
    [
        (lambda rig: rig.bridge.stop(rig.now), None),
        (lambda rig: setattr(rig, "arm_connected", False), "No EGM packet"),
        (lambda rig: rig.arm.motors_off(), "motors are off"),
        (lambda rig: drag(rig, 0.1, 0.2), "the arm moves at"),
        (lambda rig: drag(rig, 0.4, 1.5 * SLIP / 0.4), "the arm has left its place by 0.01"),
        (lambda rig: rig.bridge.gate.estop(True, rig.now), None),
    ],
    ids=["stop key", "silent arm", "arm off", "arm moves", "arm creeps", "emergency stop"],
)
def test_whatever_happens_meanwhile_stops_the_axes(happens, told, monkeypatch):
    rig, events = homing(), []
    monkeypatch.setattr(rig.bridge.recorder, "put", lambda *records: events.extend(records))
    happens(rig)
    rig.run(0.15)  # 50 ms of silence are allowed, a tick, a cycle, and the drives' dead time
    assert not any(emulator.drive.homing for emulator in rig.emulators) and not rig.axes.homing
    rig.run(1.5)
    assert not any(emulator.drive.homed for emulator in rig.emulators)
    texts = [event.text for event in events if getattr(event, "name", "") == "homing"]
    assert (len(texts) == 1 and told in texts[0]) if told else not texts


def test_homing_goes_on_undisturbed_otherwise():
    rig = homing()
    assert rig.run(1.5, lambda: rig.axes.problem(rig.now) is None) and rig.bridge.state is BridgeState.DISARMED


@pytest.mark.parametrize("axis", [0, 1])
def test_a_reference_that_a_drive_lost_is_found_again(axis):
    """By the operator's steps: prepare, reset, prepare, arm; the robot stands until it is armed."""
    rig = lockstep()
    rig.start()
    bridge, drive = rig.bridge, rig.emulators[axis].drive
    rig.emulators[axis].inject_fault(51)
    drive.homed = False
    rig.run(0.5)
    assert bridge.state is BridgeState.FAULT and bridge.gate.faults[0].cause is Cause.AXIS_LOST
    with pytest.raises(RefusedError, match="cannot reset while a cause is present: AXIS_LOST"):
        bridge.reset(rig.now)  # before its drive's fault is acknowledged
    place = rig.world.qpos
    with pytest.raises(RefusedError, match="reset it first"):
        prepared(rig)
    rig.run(0.5)
    bridge.reset(rig.now)
    assert bridge.state is BridgeState.DISARMED and not rig.axes.homed
    with pytest.raises(RefusedError, match="not armed: axes: .* not homed"):
        bridge.arm(rig.now)
    prepared(rig)
    assert rig.run(2.0, lambda: rig.axes.problem(rig.now) is None)
    rig.run(0.1)
    assert bridge.state is BridgeState.DISARMED and rig.axes.homed
    np.testing.assert_allclose(rig.world.qpos[2:], place[2:], rtol=0, atol=0.02)
    bridge.arm(rig.now)
    assert rig.run(5.0, lambda: bridge.at_home)


@pytest.mark.parametrize("reading", [-3.0, 0.0, 7.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_drive_that_restarts_with_a_coordinate_of_no_meaning_is_brought_back(axis, reading):
    """Far outside of the range it is no limit that keeps the fault, without which nothing is homed."""
    rig = lockstep()
    rig.start()
    rig.emulators[axis].power_cycle(reading)
    rig.run(0.5)
    assert rig.bridge.state is BridgeState.FAULT
    with pytest.raises(RefusedError, match="reset it first"):
        prepared(rig)
    rig.run(0.5)
    place = rig.world.qpos
    rig.bridge.reset(rig.now)
    rig.run(0.1)
    with pytest.raises(RefusedError, match="not armed: axes: .* not homed"):
        rig.bridge.arm(rig.now)
    prepared(rig)
    assert rig.run(2.0, lambda: rig.axes.problem(rig.now) is None)
    rig.run(0.1)
    np.testing.assert_allclose(rig.world.qpos, place, rtol=0, atol=0.02)
    assert not rig.bridge.gate.present
    rig.bridge.arm(rig.now)
    assert rig.run(5.0, lambda: rig.bridge.at_home)


def test_limits_count_again_once_the_axes_know_where_they_are():
    rig = lockstep()
    rig.start()
    rig.bridge.stop(rig.now)
    rig.run(0.5)
    rig.world.data.qpos[rig.world._q[0]] = 1.1  # pushed by hand
    rig.run(0.2)
    assert rig.axes.homed and Cause.LIMIT in rig.bridge.gate.present


def test_the_search_is_clear_beyond_the_range_as_far_as_switches_and_stops_are():
    """At the home pose an upper arm 5.5 cm beyond the end at the table stands in it."""
    rig = standing(config=BridgeConfig(overtravel=0.0))
    rig.bridge.check_homing(rig.now)
    geometry, pose = rig.bridge.gate.geometry, np.array(rig.bridge.gate.geometry.home, float)
    pose[1] = 0.555
    assert geometry.gaps(pose[:, None]).min() < 0.0
    refused(standing(config=BridgeConfig(overtravel=0.055)), "jog the arm")


def test_the_rig_finds_a_lost_reference_by_itself():
    rig = lockstep()
    rig.start()
    rig.emulators[0].inject_fault(51)
    rig.emulators[0].drive.homed = False
    rig.run(0.5)
    rig.recover()
    assert rig.axes.homed and rig.bridge.state is BridgeState.READY
