"""The bridge with the whole emulated robot in lock-step: states, faults and their causes, how fast it comes to rest."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.contract import N_JOINTS
from robot_io.control.bridge import BridgeState
from robot_io.emulator.config import RigParams
from robot_io.emulator.network import NetworkFaults
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS
from robot_io.safety.faults import Cause
from tests.support.lockstep_play import Hold, Swing, Wild, lockstep, playing

REST = 0.05  # [rad/s] of every arm joint
STILL = 0.02  # [m/s] of the carriage


def power_on(rig, arm=True, axes=True):
    if arm:
        rig.arm.motors_on()
        rig.arm.start_rapid()
        rig.arm.start_egm()
    rig.run(0.1)
    if axes:
        rig.axes.enable()
        rig.run(1.0, lambda: rig.axes.state is not None and rig.axes.state.enabled)
        rig.axes.home()
        rig.run(1.0, lambda: rig.axes.problem(rig.now) is None)
        rig.run(2.0, lambda: rig.bridge.arm_session.ramping(rig.now) is None)
    rig.run(0.1)


def test_nothing_moves_before_the_bridge_is_armed():
    rig = lockstep(Swing(1.0))
    power_on(rig)
    rig.throwing = True
    start = rig.world.qpos
    rig.run(1.0)
    assert rig.thrower.thrown == 1 and rig.bridge.state is BridgeState.DISARMED and rig.bridge.play.episode is None
    np.testing.assert_allclose(rig.world.qpos, start, rtol=0, atol=1e-5)
    np.testing.assert_allclose(start, rig.world.home, rtol=0, atol=1e-4)  # drives without a position controller


def test_arming_is_refused_with_the_reason():
    def refused(rig, match):
        with pytest.raises(RefusedError, match=match):
            rig.bridge.arm(rig.now)
        assert rig.bridge.state is BridgeState.DISARMED

    rig = lockstep()
    power_on(rig, arm=False)
    refused(rig, "not armed: arm: The arm's motors are off")
    rig.arm.motors_on()
    rig.run(0.1)
    refused(rig, "RAPID program is stopped")
    rig.arm.start_rapid()
    rig.run(0.1)
    refused(rig, "EGM is not running")
    rig = lockstep()
    refused(rig, "arm: No EGM packet has arrived")
    power_on(rig, axes=False)
    refused(rig, "arm: EGM has just begun, and ramps commands in: wait 1.[0-5] s")
    rig.run(1.5)
    refused(rig, "axes: .*switched off: enable the axes")
    rig.axes.enable()
    rig.run(0.2)
    refused(rig, "axes: .*not homed")
    rig = lockstep()
    rig.cameras.drop_out(1e9)
    power_on(rig)
    refused(rig, "tracker: silent")
    rig.cameras.drop_out(0.0)
    rig.run(0.1)
    policy, rig.bridge._policy = rig.bridge._policy, None
    refused(rig, "no policy is loaded")
    rig.bridge._policy = policy
    rig.bridge.gate.estop(True, rig.now)
    with pytest.raises(RefusedError, match="the state is fault"):
        rig.bridge.arm(rig.now)
    with pytest.raises(RefusedError, match="ESTOP"):
        rig.bridge.reset(rig.now)
    rig.bridge.gate.estop(False, rig.now)
    rig.bridge.reset(rig.now)
    rig.bridge.arm(rig.now)
    assert rig.bridge.state is BridgeState.READY


def watch(rig, seconds=0.5):
    """Runs; the times after which the arm's drives, the arm and the carriage do not move any more."""
    begin, last = rig.now, [0.0, 0.0, 0.0]
    rig.throwing = False
    while rig.now - begin < seconds:
        rig.step()
        speed = np.abs(rig.world.qvel)
        told = np.abs(rig._setpoint[2:]).max() > REST
        for i, moves in enumerate((told, (speed[2:] > REST).any(), (speed[:2] > STILL).any())):
            if moves:
                last[i] = rig.now - begin
    return last


def lose_axis(rig):
    rig.emulators[0].disconnect()


def break_drive(rig):
    rig.emulators[1].inject_fault(20)


def die(rig):
    rig.bridge_alive = False


def switch_off(rig):
    rig.arm.motors_off()


def go_silent(rig):
    rig.cameras.drop_out(1e9)


def press(rig):
    rig.bridge.gate.estop(True, rig.now)


def mend_axes(rig):
    for emulator in rig.emulators:
        emulator.reconnect()
    rig.run(0.1)
    rig.axes.acknowledge()
    rig.run(0.3)
    rig.axes.enable()
    rig.run(0.3)
    rig.axes.home()
    rig.run(0.5)


def mend_arm(rig):
    rig.arm.motors_on()
    rig.arm.start_rapid()
    rig.arm.start_egm()
    rig.run(0.1)


# What happens, its cause, how it is mended, and after what time [s] it is noticed, by the arm's controller itself or by
# the bridge, whose commands come to the drives behind the dead time.
EVENTS = {
    "dead client": (die, None, None, 0.060, "arm"),
    "arm's emergency stop": (switch_off, Cause.ARM_NOT_READY, mend_arm, 0.0, "arm"),
    "lost axis": (lose_axis, Cause.AXIS_LOST, mend_axes, 0.035, "bridge"),
    "drive fault": (break_drive, Cause.AXIS_LOST, mend_axes, 0.035, "bridge"),
    "emergency stop": (press, Cause.ESTOP, lambda rig: rig.bridge.gate.estop(False, rig.now), 0.0, "bridge"),
    "silent tracker": (go_silent, Cause.STALE_TRACKER, lambda rig: rig.cameras.drop_out(0.0), 0.035, "bridge"),
}


@pytest.mark.parametrize("name", EVENTS)
def test_every_fault_stops_the_robot_is_latched_and_can_be_mended(name):
    event, cause, mend, noticed, by = EVENTS[name]
    rig = playing(Swing(0.3))
    rig.run(0.35)
    bridge = rig.bridge
    assert bridge.state is BridgeState.ACTIVE and np.abs(rig.world.qvel[2:]).max() > 1.0
    braking = (np.abs(rig.world.qvel[2:]) / LIMITS.acceleration[2:]).max()
    event(rig)
    begin = rig.now
    times = watch(rig)
    if name == "silent tracker":  # the last frames were still on their way
        times = [t - (bridge.tracker.received - begin) for t in times]
    print(name, [f"{1000 * t:.0f} ms" for t in times])
    arm = rig.params.arm
    told = noticed + arm.cycle + braking
    if by == "bridge":  # at its tick; and the low-pass needs four time constants
        told += 1 / 75 + arm.dead_time + arm.cycle + 4 / (2 * np.pi * arm.low_pass)
    # The arm still moves a little as long as the carriage under it brakes, and swings at its stiff drive.
    assert times[0] < told and times[1] < told + 0.13
    if cause is None:  # the arm's own communication timeout and the drives' node guard
        assert "no message" in rig.arm.cause
        return
    assert bridge.state is BridgeState.FAULT and bridge.gate.faults[0].cause is cause, bridge.gate.faults
    place = rig.world.qpos
    rig.run(0.2)
    np.testing.assert_allclose(rig.world.qpos, place, rtol=0, atol=0.02)  # it holds
    with pytest.raises(RefusedError, match="the state is fault"):
        bridge.arm(rig.now)
    if name != "silent tracker":  # which is only missed while a ball is in play
        with pytest.raises(RefusedError, match="cannot reset while a cause is present"):
            bridge.reset(rig.now)
    assert bridge.state is BridgeState.FAULT
    mend(rig)
    rig.run(0.1)
    assert np.abs(rig.world.qpos - place)[2:].max() < 0.02  # also when the arm's controller is started again
    bridge.reset(rig.now)
    assert bridge.state is BridgeState.DISARMED
    if name == "arm's emergency stop":
        with pytest.raises(RefusedError, match="EGM has just begun"):
            bridge.arm(rig.now)
        rig.run(1.5)
    bridge.arm(rig.now)
    assert rig.run(5.0, lambda: bridge.at_home)
    faulty = rig.summaries.popleft()
    assert faulty.fault == cause.value
    bridge.set_policy(Hold())
    assert [s.fault for s in rig.play(1)] == [None]


def test_states_and_the_operators_commands_in_each():
    rig = lockstep()
    power_on(rig)
    bridge = rig.bridge
    bridge.stop(rig.now)
    bridge.discard(rig.now)
    assert bridge.state is BridgeState.DISARMED
    with pytest.raises(RefusedError, match="nothing to reset: the state is disarmed"):
        bridge.reset(rig.now)
    bridge.arm(rig.now)
    for command in (bridge.arm, bridge.reset):
        with pytest.raises(RefusedError, match="the state is ready"):
            command(rig.now)
    bridge.set_policy(Swing(0.2))
    assert rig.run(5.0, lambda: bridge.at_home)
    rig.throwing = True
    assert rig.run(3.0, lambda: bridge.state is BridgeState.ACTIVE)
    assert bridge.discard(rig.now) == 0  # it can be about no ball that anybody has seen
    rig.run(0.42)
    for command in (bridge.arm, bridge.reset, bridge.set_policy):
        with pytest.raises(RefusedError):
            command(rig.now)
    assert bridge.discard(rig.now) == 1
    bridge.stop(rig.now)
    assert bridge.state is BridgeState.STOPPING
    for command in (bridge.arm, bridge.reset):
        with pytest.raises(RefusedError, match="the state is stopping"):
            command(rig.now)
    assert rig.run(0.5, lambda: bridge.state is BridgeState.DISARMED)
    rig.throwing = False
    rig.run(0.5)
    assert np.abs(rig.world.qvel).max() < REST
    summary = rig.summaries.popleft()
    assert summary.discarded and summary.fault == "stopped"
    bridge.arm(rig.now)
    assert rig.run(5.0, lambda: bridge.at_home)
    bridge.paused = True
    rig.throwing = True
    assert not rig.run(1.0, lambda: bridge.state is BridgeState.ACTIVE)


class Broken(Hold):
    def __init__(self, answer):
        self.answer = answer

    def step(self, observation):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.mark.parametrize(
    "answer, cause",
    [
        (np.full(N_JOINTS, np.nan), Cause.NON_FINITE_COMMAND),
        (np.array([0, 0, np.inf, 0, 0, 0, 0, 0]), Cause.NON_FINITE_COMMAND),
        (np.zeros(7), Cause.MALFORMED_COMMAND),
        (None, Cause.MALFORMED_COMMAND),
        (ZeroDivisionError("no"), Cause.MALFORMED_COMMAND),
    ],
)
def test_a_broken_policy_is_a_fault(answer, cause):
    rig = lockstep(Broken(answer))
    rig.start()
    rig.throwing = True
    assert rig.run(3.0, lambda: rig.bridge.state is BridgeState.FAULT)
    rig.throwing = False
    assert rig.bridge.gate.faults[0].cause is cause
    rig.run(0.2)
    rig.bridge.reset(rig.now)
    assert rig.bridge.state is BridgeState.DISARMED and np.abs(rig.world.qvel).max() < REST


def test_a_ball_out_of_sight_is_over_and_no_fault():
    rig = playing(Swing(0.1))
    rig.run(0.2)
    rig.world.park()  # the cameras go on, but see nothing
    rig.throwing = False
    rig.run(0.4)
    assert rig.bridge.state is BridgeState.READY and [s.outcome for s in rig.summaries] == ["missed"]


def test_a_bad_network_neither_stops_play_for_good_nor_breaks_a_limit():
    bad = NetworkFaults(loss=0.2, duplication=0.2, reordering=0.2, hold=0.006)
    params = RigParams(pause=0.05, arm_network=bad, tracker_network=bad)
    rig = lockstep(Wild(), params=params)
    rig.start()
    rig.throwing, found, gate = True, [], rig.bridge.gate
    reference, last = gate.reference, np.zeros(N_JOINTS)
    lower, upper = np.array(LIMITS.lower), np.array(LIMITS.upper)
    # A reply that is lost while the arm brakes adds to its way; its controller switches off beyond this.
    tolerance = rig.params.arm.position_tolerance
    limit, step = np.array(LIMITS.velocity) * (1 + 1e-9), np.array(LIMITS.acceleration) / 75 * (1 + 1e-9)
    ticks = rig.bridge.counts.ticks
    for _ in range(1500):
        rig.step()
        if rig.bridge.counts.ticks != ticks:
            ticks, velocity = rig.bridge.counts.ticks, gate.velocity
            assert (np.abs(velocity) <= limit).all() and (np.abs(velocity - last) <= step).all()
            reference, last = gate.reference, velocity
            assert ((reference >= lower) & (reference <= upper)).all()
        assert ((rig.world.qpos >= lower - tolerance) & (rig.world.qpos <= upper + tolerance)).all()
        found += [rig.summaries.popleft() for _ in range(len(rig.summaries))]
        if rig.bridge.state is BridgeState.FAULT:
            break
    statistics, counts = rig.bridge.arm_session.statistics, rig.bridge.tracker.counts
    assert statistics.rejected["out_of_order"] > 10 and counts["out of order"] + counts["duplicate"] > 10
    if rig.bridge.state is BridgeState.FAULT:
        watch(rig)
        assert np.abs(rig.world.qvel).max() < REST
    else:
        assert found
    assert rig.world.collisions == 0


def test_equal_seeds_give_equal_play():
    def played():
        rig = lockstep(Wild(3))
        rig.start()
        return rig.play(2), rig.world.qpos.tobytes()

    assert played() == played()


def test_the_axes_are_homed_only_with_the_arm_out_of_the_way():
    """Over the table their search would end in it, wherever they start."""
    rig = lockstep()
    with pytest.raises(RefusedError, match="the arm's position is not known"):
        rig.bridge.check_homing(rig.now)
    power_on(rig, axes=False)
    rig.bridge.check_homing(rig.now)
    home = rig.bridge.arm_session.feedback.position
    for joint, value in ((1, 1.4), (2, 0.9), (4, -1.5)):
        stretched = home.copy()
        stretched[joint] = value
        rig.bridge.feedback.arm.clear()
        for age in (2e-3, 1e-3, 0.0):  # it has been there for a while
            rig.bridge.feedback.arm.add(rig.now - age, stretched)
        if rig.bridge._geometry.gaps(np.array([[0.0, 0.5, *stretched]]).T).min() < 0.0:
            with pytest.raises(RefusedError, match="axes not homed: .* jog the arm to its home pose"):
                rig.bridge.check_homing(rig.now)
            break
    else:
        raise AssertionError("none of these poses meets the table")
    rig = lockstep()
    rig.start()
    with pytest.raises(RefusedError, match="the state is ready; stop the robot first"):
        rig.bridge.check_homing(rig.now)
