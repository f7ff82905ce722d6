"""The linear axes: registers by hand, links over real sockets, following a stream, and everything that stops them."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from json import loads

import numpy as np
import pytest

from robot_io.devices.festo import (
    AxesConfig,
    AxesThread,
    Axis,
    AxisCommand,
    AxisLost,
    CmmtProfile,
    FestoAxes,
    FhppProfile,
    ModbusLink,
)
from robot_io.devices.festo.axis import Channel
from robot_io.devices.festo.profile import AxisStatus
from robot_io.emulator.axes import AxisEmulator
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.axis_registers import AxisUnits
from robot_io.emulator.axis_server import AxisServer
from tests.support.axes_lockstep import CYCLE, PROFILES, STEP, LockStep, Stream
from tests.support.paths import ROOT

A = 15.0  # [m/s^2]
EDCON_PYTHON = "MJX_TT_FESTO_EDCON_PYTHON"


# Where an axis without commands is held


def test_a_swinging_axis_settles_where_it_is_held():
    """A drive that swings to and fro about its target, seen 0.08 s late: damped, it must come to rest."""
    channel, place, velocity, seen = Channel(Axis("x", None, CmmtProfile(), -1.0, 1.0)), 0.02, 0.0, []
    width, damping = 2.0 * np.pi * 4.5, 0.04
    furthest = []
    for step in range(8000):
        now, target = step * 1e-3, channel.held or 0.0
        velocity += 1e-3 * (width**2 * (target - place) - 2.0 * damping * width * velocity)
        place += 1e-3 * velocity
        seen.append(place)
        furthest.append(abs(velocity))
        if step % 13 == 0:
            channel.answered(AxisStatus(True, True, False, 0, 0, False, True, seen[max(step - 80, 0)], 0.0), now, 2.0)
            channel.hold(now)
    assert channel.held is not None and max(furthest[-500:]) < 3e-3  # [m/s]; it swung by 0.5 m/s


def test_an_axis_that_was_pushed_away_is_held_where_it_stands_then():
    channel = Channel(Axis("x", None, CmmtProfile(), -1.0, 1.0))
    held = []
    for step in range(150):
        now = step * 0.0133
        place = 0.1 if now < 0.6 else min(0.1 + 0.5 * (now - 0.6), 0.15)
        channel.answered(AxisStatus(True, True, False, 0, 0, False, True, place, 0.0), now, 2.0)
        channel.hold(now)
        held.append(channel.held)
    assert held[10] == 0.1 and held[-1] == 0.15
    channel.release()
    channel.hold(now + 5.0)  # after a silence nothing says that it stands
    assert channel.held is None


# Registers, worked out by hand from the bits' names


@pytest.mark.parametrize(
    ("command", "start"),
    [
        # STW1: no coast stop, no quick stop, enable operation, no intermediate stop, control by PLC
        (AxisCommand(), [0x042E, 0x9100, 0x4000, 0, 0x4000, 0, 0, 0, 0, 0, 0]),
        (AxisCommand(enable=True), [0x042F, 0x9100, 0x4000, 0, 0x4000, 0, 0, 0, 0, 0, 0]),
        (AxisCommand(acknowledge=True), [0x04AE, 0x9100, 0x4000, 0, 0x4000, 0, 0, 0, 0, 0, 0]),
        # homing: start, and the task is not rejected
        (AxisCommand(enable=True, home=True), [0x0C3F, 0x9100, 0x4000, 0, 0x4000, 0, 0, 0, 0, 0, 0]),
        # -0.25 m = -250000 um = 0xFFFC2F70; 1.5 m/s = 1500 mm/s = 0x5DC; 7.5 m/s^2 = 50 % = 0x2000
        (
            AxisCommand(enable=True, move=True, position=-0.25, speed=1.5, acceleration=7.5),
            [0x047F, 0x9100, 0x4000, 0, 0x4000, 0x2F70, 0xFFFC, 0x05DC, 0, 0x2000, 0x2000],
        ),
    ],
)
def test_output_registers_of_telegram_111(command, start):
    assert CmmtProfile().encode(command) == start + [0] * 17


def states(status):
    return status.ready, status.enabled, status.fault, status.homed, status.homing


def test_input_registers_of_telegram_111():
    # Operating, homed; -250000 um; -0.5 of 0x40000000, so -1 m/s of 2 m/s; warning 12.
    words = [0x2F37, 0x8000, 0, 0, 0, 0x2F70, 0xFFFC, 0x0000, 0xE000, 0, 12]
    status = CmmtProfile().decode(words + [0] * 17)
    assert status.position == pytest.approx(-0.25, abs=1e-12) and status.velocity == pytest.approx(-1.0, abs=1e-12)
    assert states(status) == (True, True, False, True, False)
    assert (status.fault_code, status.warning_code) == (0, 12)
    # Fault, inhibited; homing active; fault 126.
    status = CmmtProfile().decode([0x0248, 0x0800, 0, 0, 0, 0, 0, 0, 0, 126, 0] + [0] * 17)
    assert states(status) == (False, False, True, False, True)
    assert status.fault_code == 126 and "following error" in CmmtProfile().fault_text(126)
    assert CmmtProfile().fault_text(999).startswith("999: look")


@pytest.mark.parametrize(
    ("command", "registers"),
    [
        # CCON: STOP, BRAKE, LOCK, OPM1 = 0x66; CPOS: CLEAR while halted = 0x40
        (AxisCommand(), [0x6640, 0, 0, 0]),
        (AxisCommand(enable=True), [0x6740, 0, 0, 0]),
        (AxisCommand(acknowledge=True), [0x6E40, 0, 0, 0]),
        (AxisCommand(enable=True, home=True), [0x6705, 0, 0, 0]),
        # HALT, and START when odd; 1.5 m/s = 75 % of 2 m/s; -0.25 m = -25000 of 10 um = 0xFFFF9E58
        (AxisCommand(enable=True, move=True, position=-0.25, speed=1.5, sequence=1), [0x6703, 75, 0xFFFF, 0x9E58]),
        (AxisCommand(enable=True, move=True, position=-0.25, speed=1.5, sequence=2), [0x6701, 75, 0xFFFF, 0x9E58]),
    ],
)
def test_output_registers_of_fhpp(command, registers):
    assert FhppProfile().encode(command) == registers


def test_continuous_setpoints_of_fhpp():
    move = dict(enable=True, move=True, position=0.25, speed=2.0)
    # CDIR: CONT 0x08, CONTT 0x10 when odd; 100 %; 25000 = 0x61A8
    assert FhppProfile(continuous=True).encode(AxisCommand(**move, sequence=1)) == [0x6703, 0x1864, 0, 0x61A8]
    assert FhppProfile(continuous=True).encode(AxisCommand(**move, sequence=2)) == [0x6703, 0x0864, 0, 0x61A8]


def test_input_registers_of_fhpp():
    # SCON: enabled, open, load voltage, OPM1 = 0x53; SPOS: halt off, moving, referenced = 0x91; -50 % = 0xCE
    status = FhppProfile().decode([0x5391, 0x00CE, 0xFFFF, 0x9E58])
    assert status.position == pytest.approx(-0.25, abs=1e-12) and status.velocity == pytest.approx(-1.0, abs=1e-12)
    assert states(status) == (True, True, False, True, False)
    status = FhppProfile().decode([0x1800, 0, 0, 0])  # load voltage, fault
    assert states(status) == (False, False, True, False, False)
    assert not FhppProfile().decode([0x3000, 0, 0, 0]).ready  # the set-up tool has control


@pytest.mark.parametrize("profile", [CmmtProfile(), FhppProfile()])
def test_numbers_that_do_not_fit(profile):
    for command in (dict(position=30_000.0), dict(speed=-0.1), dict(speed=3e6), dict(position=float("nan"))):
        with pytest.raises(ValueError, match="does not fit"):
            profile.encode(AxisCommand(**command))
    with pytest.raises(ValueError, match="5 registers arrived"):
        profile.decode([0] * 5)
    with pytest.raises(ValueError, match="position_unit"):
        type(profile)(position_unit=0.0)


# Links over real sockets


def test_modbus_link_both_ways_of_asking():
    emulator = AxisEmulator("cmmt")
    with AxisServer(emulator) as server:
        for combined in (True, False):
            link = ModbusLink("127.0.0.1", server.port, timeout=1.0, combined=combined)
            image = CmmtProfile().encode(AxisCommand(position=0.1 + combined))
            assert link.exchange(0, image, 0, 28) == image
            assert link.exchange(400, [100, 0], 400, 2) == [100, 0]
            link.close()
            time.sleep(0.05)  # the server has one place only


def test_modbus_link_says_what_is_wrong():
    emulator = AxisEmulator("cmmt")
    image = CmmtProfile().encode(AxisCommand())
    with AxisServer(emulator) as server:
        wrong_id = ModbusLink("127.0.0.1", server.port, timeout=1.0, device_id=9)
        with pytest.raises(AxisLost, match="device id 9: it refused"):
            wrong_id.exchange(0, image, 100, 28)
        time.sleep(0.05)
        bad_address = ModbusLink("127.0.0.1", server.port, timeout=1.0)
        with pytest.raises(AxisLost, match="registers 0 and 300: illegal data address"):
            bad_address.exchange(0, image, 300, 2)
        time.sleep(0.05)
        good = ModbusLink("127.0.0.1", server.port, timeout=0.2)
        good.exchange(0, image, 100, 28)
        emulator.disconnect()
        with pytest.raises(AxisLost, match="no sound answer within 0.2 s: .* is the cable in?"):
            good.exchange(0, image, 100, 28)
    with pytest.raises(AxisLost, match="not connected"):  # and does not try again at once
        bad_address.exchange(0, image, 100, 28)
    with pytest.raises(AxisLost, match="no connection"):
        ModbusLink("127.0.0.1", server.port).exchange(0, image, 100, 28)
    with pytest.raises(ValueError, match="0..255"):
        ModbusLink("127.0.0.1", device_id=256)
    with pytest.raises(ValueError, match="lost"):
        ModbusLink("127.0.0.1", timeout=0.0)


def test_modbus_link_survives_any_answer():
    """Silence, noise and damaged answers are an axis that is lost, and nothing else."""
    random = np.random.default_rng(2)
    good = bytes.fromhex("000100000007 01 17 04 1234 5678")
    answers = [b"", good[:5], good[:9], good[:6] + b"\x02" + good[7:], good[:7] + b"\x03" + good[8:]]
    answers += [good[:1] + b"\x02" + good[2:], good[:8] + b"\x02" + good[9:11], good[:5] + b"\x04" + good[6:]]
    for _ in range(100):
        data = bytearray(good)
        for place in random.integers(8 * 9, size=random.integers(1, 4)):
            data[place // 8] ^= 1 << place % 8
        answers += [bytes(data), random.bytes(random.integers(1, 60))]
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            for data in [good, *answers]:
                connection, _ = server.accept()
                with connection:
                    connection.recv(256)
                    connection.sendall(data)
                    if data == b"":
                        connection.recv(1)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        links = [ModbusLink("127.0.0.1", server.getsockname()[1], timeout=0.02) for _ in [good, *answers]]
        assert links[0].exchange(0, [1], 0, 2) == [0x1234, 0x5678]
        links[0].close()
        for link, data in zip(links[1:], answers, strict=True):
            try:
                registers = link.exchange(0, [1], 0, 2)
            except AxisLost:
                continue
            link.close()
            # What Modbus TCP cannot tell from a good answer: flips in the data, in a transaction number of 0.
            assert len(registers) == 2, data
        thread.join(timeout=5.0)


# Following


@pytest.mark.parametrize("profile", PROFILES)
def test_follows_a_stream_of_velocities(profile):
    """Within a bound from the delays' spread and the registers' resolution.

    A change of the velocity acts 64.5 ms after its command give or take delta: half a bus cycle (one and a half where
    START marks targets), and 6.7 ms for ramps shorter than a whole period's. So at an acceleration a the speed is off
    by at most a delta, plus q for the rounding of its register; the correction's loop holds the position to
    (a delta + q) / k, its impulse response being positive; within one 13.3 ms period another a 13.3 ms delta.
    """
    delta = 0.0067 + (0.012 if profile == "fhpp" else 0.004)
    q = 0.0005 if profile == "cmmt" else 0.01
    omega, amplitude = 2 * np.pi * 0.5, np.array([0.3, -0.15])
    peak = np.abs(amplitude) * omega**2
    bound = (peak * delta + q) / AxesConfig().gain + peak * delta / 75
    rig = LockStep(profile).start()
    began = rig.now
    stream = Stream(rig, lambda t: amplitude * omega * np.sin(omega * t))
    rig.run(6.0, stream)
    assert rig.axes.problem(rig.now) is None and rig.axes.stale_commands == 0
    trace, given = rig.trace[rig.trace[:, 0] >= began], stream.trace
    wanted = np.stack([np.interp(trace[:, 0] - 0.0645, given[:, 0], given[:, 1 + i]) for i in (0, 1)], axis=1)
    deviation = np.abs(trace[:, 1:3] - wanted).max(axis=0)
    assert (deviation < bound).all(), (deviation, bound)
    assert (np.ptp(trace[:, 1:3], axis=0) > 1.9 * np.abs(amplitude)).all()
    assert np.abs(np.diff(trace[:, 3:5], axis=0)).max() < 0.001 * 1.5 * A


@pytest.mark.parametrize("profile", PROFILES)
def test_an_offset_decays_without_overshoot(profile):
    """With the time constant 1 / gain of the correction, a third of a second, and hardly slower for the delay."""
    rig = LockStep(profile, start=(-0.5, 0.0)).start()
    stream = Stream(rig, lambda t: (0.2, 0.0))
    stream.reference = stream.reference + [0.04, 0.0]
    rig.run(2.5, stream)
    trace, given = rig.trace, stream.trace
    trace = trace[trace[:, 0] > given[0, 0] + 0.0645]
    offset = np.interp(trace[:, 0] - 0.0645, given[:, 0], given[:, 1]) - trace[:, 1]
    resolution = (0.01 if profile != "cmmt" else 0.0005) / AxesConfig().gain + 0.001
    t = trace[:, 0] - trace[0, 0]
    assert offset.min() > -resolution
    assert (offset < 0.043 * np.exp(-3.0 * (t - 0.1)) + resolution).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_full_speed_to_standstill(profile):
    """2 m/s with 15 m/s^2 up and down, as the limiter gives it at its limits; ends on the very position."""
    rig = LockStep(profile, start=(-0.8, 0.3)).start()
    stream = Stream(rig, lambda t: np.array([1.0, -0.3]) * np.clip(min(15 * t, 15 * (0.8 - t)), 0.0, 2.0))
    rig.run(1.6, stream)
    assert rig.axes.problem(rig.now) is None
    assert np.abs(rig.velocity).max() < 1e-3
    np.testing.assert_allclose(rig.position, stream.trace[-1, 1:3], atol=1e-4)
    assert rig.trace[:, 1].max() < stream.trace[-1, 1] + 0.02  # hardly beyond
    np.testing.assert_allclose(rig.axes.state.position, rig.position, atol=1e-4)


@pytest.mark.parametrize("profile", PROFILES)
def test_targets_stay_within_the_axis(profile):
    rig = LockStep(profile, start=(0.8, 0.0)).start()
    stream = Stream(rig, lambda t: (min(15 * t, 1.0) if t < 0.26 else 0.0, 0.0))  # an unlimited stop, at the end
    rig.run(0.6, stream)
    assert 0.95 < rig.trace[:, 1].max() < 1.0 + 1e-3


def test_axes_may_count_the_other_way_round():
    rig = LockStep(start=(0.2, -0.1))
    axes = [Axis("x", rig.emulators[0], CmmtProfile(), -1.0, 1.0, zero=0.5, direction=-1)]
    axes += [Axis("y", rig.emulators[1], CmmtProfile(), -0.5, 0.5)]
    rig.axes = FestoAxes(axes)
    rig.start()
    np.testing.assert_allclose(rig.axes.state.position, [0.3, -0.1], atol=1e-6)  # 0.5 - 0.2
    stream = Stream(rig, lambda t: (0.2 * (t < 0.5), 0.0))
    stream.reference = np.array([0.3, -0.1])
    rig.run(0.4, stream)
    moving_velocity = rig.axes.state.velocity
    rig.run(0.6, stream)
    assert rig.axes.problem(rig.now) is None
    assert moving_velocity[0] == pytest.approx(0.2, abs=0.01)
    assert rig.position[0] == pytest.approx(0.5 - stream.trace[-1, 1], abs=1e-4)
    assert stream.trace[-1, 1] == pytest.approx(0.4, abs=0.005)


# What stops them


def steady(t):
    return min(15.0 * t, 0.5), 0.0


def moving(profile="cmmt", **keywords):
    """A rig whose axis x moves at 0.5 m/s, and its stream."""
    rig = LockStep(profile, start=(-0.6, 0.0), **keywords).start()
    stream = Stream(rig, steady)
    rig.run(0.4, stream)
    assert rig.velocity[0] == pytest.approx(0.5, abs=0.02)
    return rig, stream


def longest_stop(speed=0.5):
    """Way from the last command until rest: dead time, one cycle, smoothing and a step, then braking."""
    return speed * (0.050 + 2 * CYCLE + 0.008) + speed**2 / (2 * A) + 0.003


@pytest.mark.parametrize("profile", PROFILES)
def test_a_lost_axis_stops_both(profile):
    rig, stream = moving(profile)
    before = rig.position[0]
    rig.emulators[1].disconnect()
    rig.run(0.3, stream)
    assert rig.axes.fault.cause == "axis_lost"
    assert "y is lost" in rig.axes.problem(rig.now) and "disconnected" in rig.axes.problem(rig.now)
    assert abs(rig.velocity[0]) < 0.002 and rig.position[0] - before < longest_stop()
    assert (rig.axes.commanded == 0).all()
    assert rig.emulators[0].drive.operating  # holds its position
    # y's own node guard has switched it off; plugged in again, nothing moves before acknowledging and enabling.
    rig.emulators[1].reconnect()
    rig.run(0.2, stream)
    assert abs(rig.velocity[0]) < 1e-3 and rig.axes.fault.cause == "axis_lost"
    rig.axes.acknowledge()
    rig.run(0.5)
    assert "switched off" in rig.axes.problem(rig.now)
    rig.axes.enable()
    rig.run(0.3)
    assert rig.axes.problem(rig.now) is None
    rig.run(0.4, Stream(rig, steady))
    assert rig.velocity[0] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("lost", [0, 1])
def test_losing_either_axis_stops_the_other_in_the_same_cycle(lost):
    rig = LockStep(start=(-0.6, -0.4)).start()
    stream = Stream(rig, lambda t: np.full(2, min(15.0 * t, 0.5)))
    rig.run(0.4, stream)
    other = rig.emulators[1 - lost]
    rig.emulators[lost].disconnect()
    stream(rig.now)
    rig.axes.cycle(rig.now)
    assert not other.bank.outputs[0] & 0x0040  # no task any more


@pytest.mark.parametrize("profile", PROFILES)
def test_a_fault_stops_both_and_stays_until_acknowledged(profile):
    rig, stream = moving(profile)
    before = rig.position[0]
    rig.emulators[1].inject_fault(51)
    rig.run(0.3, stream)
    problem = rig.axes.problem(rig.now)
    assert rig.axes.fault.cause == "drive_fault" and not rig.axes.preparable(rig.now)
    assert ("51: power unit too hot" if profile == "cmmt" else "diagnostic memory") in problem
    assert abs(rig.velocity[0]) < 0.002 and rig.position[0] - before < longest_stop()
    for request in (rig.axes.enable, rig.axes.home):  # not before it is acknowledged
        request()
        rig.run(0.2, stream)
        assert rig.axes.problem(rig.now) == problem and not rig.emulators[1].drive.operating
    rig.axes.acknowledge()
    rig.run(0.3)
    assert rig.axes.fault is None
    assert "x and y are switched off" in rig.axes.problem(rig.now)
    rig.axes.enable()
    rig.run(0.3)
    assert rig.axes.problem(rig.now) is None  # still homed


def test_acknowledging_while_the_drive_still_brakes():
    """The drive ignores that edge; it gets another one."""
    rig = LockStep(start=(-0.8, 0.0)).start()
    stream = Stream(rig, lambda t: (min(15.0 * t, 1.8), 0.0))
    rig.run(0.4, stream)
    rig.emulators[0].drive.params = DriveParams(acceleration=3.0)  # brakes for half a second
    rig.emulators[0].inject_fault(51)
    rig.run(0.02, stream)
    assert rig.axes.fault.cause == "drive_fault"
    rig.axes.acknowledge()
    rig.run(0.9)
    assert rig.axes.fault is None and rig.emulators[0].drive.fault_code == 0


def test_a_fault_that_does_not_go_away():
    rig, _ = moving()

    def again(now):
        rig.emulators[0].inject_fault(30)

    rig.run(0.3, again)
    rig.axes.acknowledge()
    rig.run(1.5, again)
    assert rig.axes.fault.cause == "acknowledge_timeout"
    assert "x: 30: overvoltage" in rig.axes.problem(rig.now)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_stream_that_breaks_off_stops_both_and_may_go_on(profile):
    rig, _ = moving(profile)
    before = rig.position[0]
    rig.run(0.35)
    timeout = AxesConfig().command_timeout
    assert rig.axes.stale_commands == 1 and rig.axes.fault is None
    assert abs(rig.velocity[0]) < 0.002 and rig.position[0] - before < longest_stop() + 0.5 * timeout
    rig.run(0.4, Stream(rig, steady))
    assert rig.velocity[0] == pytest.approx(0.5, abs=0.02) and rig.axes.problem(rig.now) is None


def test_a_stream_that_breaks_off_for_a_moment_at_full_speed_goes_on():
    """The axes brake meanwhile; what was commanded before is still on its way and no following error."""
    rig = LockStep(start=(-0.9, 0.0)).start()
    stream = Stream(rig, lambda t: (min(15.0 * t, 1.8), 0.0))
    silent = rig.now + 0.3
    rig.run(0.6, lambda now: None if silent < now < silent + 0.045 else stream(now))
    assert rig.axes.stale_commands == 1 and rig.axes.problem(rig.now) is None
    assert rig.velocity[0] > 1.5


@pytest.mark.parametrize("profile", PROFILES)
def test_when_the_computer_dies_the_drives_stop_by_themselves(profile):
    rig, stream = moving(profile)
    rig.cycling = False
    before = stream.trace[-1, 1]
    rig.run(0.6)
    cfg = AxesConfig()
    assert abs(rig.velocity[0]) < 1e-3
    # The last target: one policy period, the lead and the braking distance ahead of the last command.
    assert rig.position[0] - before < 0.5 * (1 / 75 + cfg.lead) + 0.5**2 / (2 * A) + 0.01
    assert not any(e.drive.operating for e in rig.emulators)  # node guard
    age = rig.now - rig.axes.state.received
    assert f"state is {age:.3f} s old" in rig.axes.problem(rig.now)


def test_commands_that_do_not_start_where_the_axis_is():
    rig = LockStep().start()
    before = rig.position.copy()
    rig.run(0.1, lambda now: rig.axes.command((0.5, -0.1), (0.0, 0.0), now))
    assert rig.axes.fault.cause == "following_error" and "x is 0.300 m from" in rig.axes.problem(rig.now)
    rig.run(0.2)
    np.testing.assert_allclose(rig.position, before, atol=1e-5)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("holds_measured", [False, True])
@pytest.mark.parametrize("end", ["fault", "stop", "silence"])
def test_a_blocked_axis_is_neither_pushed_nor_jumps_when_it_is_free(profile, holds_measured, end):
    """Whatever ended the commands and wherever its drive leaves the set-point of a dropped task."""
    rig, stream = moving(profile, params=DriveParams(following_error=1.0, holds_measured=holds_measured))
    wall = rig.position[0]

    def against_the_wall(seconds, each=None):
        for _ in range(round(seconds / STEP)):
            rig.run(STEP, each)
            if rig.position[0] > wall:
                rig.position[0], rig.velocity[0] = wall, 0.0

    against_the_wall(1.0 if end == "fault" else 0.15, stream)
    assert (rig.axes.fault is not None) == (end == "fault")
    assert end != "fault" or rig.axes.fault.cause == "following_error"
    if end == "stop":
        rig.axes.stop()
    against_the_wall(1.0)
    assert rig.emulators[0].drive.operating and rig.emulators[0].drive.x - wall < 0.002
    assert abs(rig.emulators[0].drive.set_point()) < 0.04
    free = len(rig.log)
    rig.run(1.0)
    assert np.abs(rig.trace[free:, 1] - wall).max() < 0.002
    rig.position[0] -= 0.05  # somebody moves it
    rig.run(1.5)
    assert np.abs(rig.velocity[0]) < 1e-3


@pytest.mark.parametrize("profile", PROFILES)
def test_a_blocked_axis_that_shakes_is_not_pushed_either(profile):
    """Somebody holds it: it never stands."""
    rig, stream = moving(profile, params=DriveParams(following_error=1.0))
    wall = rig.position[0]

    def held(seconds, each=None):
        for _ in range(round(seconds / STEP)):
            rig.run(STEP, each)
            place = wall - 0.003 * (1.0 + np.sin(30.0 * rig.now))
            if rig.position[0] > place:
                rig.position[0], rig.velocity[0] = place, 0.0

    held(0.6, stream)
    assert rig.axes.fault.cause == "following_error"
    held(1.5)
    ahead = []
    for _ in range(50):
        held(0.01)
        ahead.append(rig.emulators[0].drive.x - rig.position[0])
    assert rig.emulators[0].drive.operating and max(ahead) < 0.012


def test_an_axis_that_is_kept_from_its_place_at_rest_is_a_fault():
    """A stiff drive would push there for as long as the robot rests, by less than ``max_error``."""
    rig, _ = moving(params=DriveParams(following_error=1.0))
    stream = Stream(rig, lambda t: (0.5 * (t < 0.1), 0.0))
    wall = rig.position[0] + 0.02
    for _ in range(1000):
        rig.run(STEP, stream)
        if rig.position[0] > wall:
            rig.position[0], rig.velocity[0] = wall, 0.0
    assert rig.axes.fault.cause == "following_error" and "allowed are 0.01 m" in rig.axes.fault.sentence
    free = len(rig.log)
    rig.run(1.0)
    assert np.abs(rig.trace[free:, 1] - wall).max() < 0.002


def test_an_axis_whose_position_jumped_is_not_led_there():
    """By 0.3 m between two answers: what is measured then is not where it is."""
    rig, stream = moving(params=DriveParams(following_error=1.0))
    link = rig.axes._channels[0].axis.link
    exchange = link.exchange

    def false(*arguments):
        registers = exchange(*arguments)
        count = (registers[5] + (registers[6] << 16) + 300_000) % 2**32
        return [*registers[:5], count & 0xFFFF, count >> 16, *registers[7:]]

    link.exchange = false
    rig.run(1.0, stream)
    assert rig.axes.fault.cause == "following_error" and abs(rig.velocity[0]) < 1e-3
    stopped = rig.position[0]
    rig.run(1.0)
    assert rig.position[0] == pytest.approx(stopped, abs=1e-4)


def test_a_drive_that_something_else_switches_off():
    rig, stream = moving()
    rig.emulators[0].drive.request_power(False, True)
    rig.run(0.05, stream)
    assert rig.axes.fault.cause == "switched_off" and "x has switched off" in rig.axes.problem(rig.now)
    rig.run(0.5, stream)
    assert not rig.emulators[0].drive.operating and abs(rig.velocity[0]) < 1e-3


def test_stop_and_disable():
    rig, stream = moving()
    rig.axes.stop()
    stop = rig.now
    rig.run(0.3, lambda now: rig.axes.command((0.0, 0.0), (0.5, 0.0), stop))  # commands from before count no more
    assert abs(rig.velocity[0]) < 0.002 and rig.axes.problem(rig.now) is None and rig.axes.standing
    rig.run(0.3, Stream(rig, steady))
    assert rig.velocity[0] > 0.4 and not rig.axes.standing
    rig.axes.disable()
    rig.run(0.3, stream)
    assert not any(e.drive.operating for e in rig.emulators) and abs(rig.velocity[0]) < 1e-3
    assert "switched off: enable" in rig.axes.problem(rig.now)


def test_problems_before_the_first_motion():
    rig = LockStep(config=AxesConfig(homing_timeout=0.5, enable_timeout=0.5))
    command = lambda now: rig.axes.command((0.2, -0.1), (0.0, 0.0), now)  # noqa: E731
    assert rig.axes.state is None and "not answered yet" in rig.axes.problem(0.0) and not rig.axes.preparable(0.0)
    rig.run(0.1, command)
    assert "x and y are switched off" in rig.axes.problem(rig.now) and rig.axes.preparable(rig.now)
    rig.axes.enable()
    rig.run(0.2, command)
    assert "x and y are not homed" in rig.axes.problem(rig.now)
    rig.axes.home()
    rig.run(0.2, command)
    assert "being homed" in rig.axes.problem(rig.now)
    rig.run(0.5, command)  # homing takes 1 s
    assert rig.axes.fault.cause == "homing_timeout"
    rig = LockStep(config=AxesConfig(enable_timeout=0.5))
    for emulator in rig.emulators:
        emulator.drive.params = DriveParams(switch_on_time=10.0)
    rig.axes.enable()
    rig.run(0.7)
    assert rig.axes.fault.cause == "enable_timeout" and "load voltage" in rig.axes.problem(rig.now)


class NoGuard(AxisEmulator):
    """A drive that answers the node guard with what was written, and does not take it."""

    def exchange(self, write_address, values, read_address, count):
        return values if write_address == 400 else super().exchange(write_address, values, read_address, count)


class SwappedGuard(AxisEmulator):
    """The words of a drive's node guard come high word first."""

    def exchange(self, write_address, values, read_address, count):
        values = values[::-1] if write_address == 400 else values
        answer = super().exchange(write_address, values, read_address, count)
        return answer[::-1] if read_address == 400 else answer


class NoUnit(AxisEmulator):
    """A drive that does not tell one of its units."""

    def __init__(self, *arguments, **keywords):
        super().__init__(*arguments, **keywords)
        self.bank._parameters.pop((12346, 0))


@pytest.mark.parametrize(
    ("options", "cause", "says"),
    [
        (dict(kind=NoGuard, node_guard=1.0), "node_guard", "[100, 0] as [1000, 0]"),
        (dict(kind=SwappedGuard, node_guard=1.0), "node_guard", "are its words swapped"),
        (dict(kind=NoUnit), "units", "does not tell parameter 12346"),
        (dict(base_acceleration=7.5), "units", "base_acceleration is 7.5 (parameter 12346), robot.yaml has 15"),
        (dict(base_velocity=1.0), "units", "base_velocity is 1 (parameter 12345), robot.yaml has 2"),
        (dict(position=1e-5), "units", "position_unit is 1e-05 (parameter 11724), robot.yaml has 1e-06"),
        (dict(velocity=1e-4), "units", "velocity_unit is 0.0001 (parameter 11725), robot.yaml has 0.001"),
    ],
)
def test_a_drive_that_would_not_stop_by_itself_or_counts_otherwise_gets_no_power(options, cause, says):
    """The operator's whole request at once, again and again: acknowledge, enable, home."""
    units = None if "kind" in options else AxisUnits(**{"position": 1e-6, **options})
    rig = LockStep(**(options if "kind" in options else {"units": units}))
    rig.run(0.2)
    for _ in range(3):
        assert rig.axes.fault.cause == cause and says in rig.axes.problem(rig.now)
        for request in (rig.axes.acknowledge, rig.axes.enable, rig.axes.home):
            request()
        rig.run(0.5)
        for emulator in rig.emulators:
            assert not emulator.bank.outputs[0] & 0x0801  # ON, START_HOMING
            assert not emulator.drive.operating and not emulator.drive.homing and not emulator.drive.homed
            assert options.get("node_guard") in (None, emulator.bank.node_guard)


def test_the_node_guard_of_robot_yaml_is_the_drives():
    assert LockStep(node_guard=5.0).start().emulators[0].bank.node_guard == AxesConfig().node_guard


def homing(profile="cmmt"):
    """Both axes in their search, which takes a second."""
    rig = LockStep(profile)
    rig.run(0.05)
    rig.axes.enable()
    rig.run(0.3)
    rig.axes.home()
    rig.run(0.2)
    assert rig.axes.homing and all(emulator.drive.homing for emulator in rig.emulators)
    return rig


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("gone", [0, 1])
@pytest.mark.parametrize("how", ["lost", "fault"])
def test_an_axis_that_is_gone_ends_the_other_ones_homing(profile, gone, how):
    """In the same cycle, and for good: acknowledging the fault does not go on with it."""
    rig = homing(profile)
    other = rig.emulators[1 - gone]
    if how == "lost":
        rig.emulators[gone].disconnect()
    else:
        rig.emulators[gone].inject_fault(51)
    before = other.images
    rig.axes.cycle(rig.now)
    assert other.images > before and not rig.axes.homing
    assert not other.bank.outputs[0] & (0x0800 if profile == "cmmt" else 0x0004)  # START_HOMING, HOM
    rig.run(0.1)
    assert not other.drive.homing and other.drive.operating  # it holds
    rig.emulators[gone].reconnect()
    rig.run(1.5)
    rig.axes.acknowledge()
    rig.run(0.5)
    assert rig.axes.fault is None and not rig.axes.homing and not other.drive.homed
    rig.axes.enable()
    rig.axes.home()
    rig.run(2.0)
    assert rig.axes.problem(rig.now) is None


@pytest.mark.parametrize("profile", PROFILES)
def test_a_stop_ends_homing(profile):
    rig = homing(profile)
    rig.axes.stop()
    rig.run(0.1)
    assert not rig.axes.homing and not any(emulator.drive.homing for emulator in rig.emulators)
    rig.run(1.5)
    assert "not homed" in rig.axes.problem(rig.now) and rig.axes.preparable(rig.now)


def test_a_drive_gets_no_power_while_a_fault_is_latched():
    """A fault of its own that goes away later, by itself or by somebody's hand, does not switch it on."""
    rig = LockStep()
    rig.run(0.05)
    rig.axes.enable()
    rig.emulators[0].disconnect()
    rig.run(0.1)
    assert rig.axes.fault.cause == "axis_lost" and not rig.emulators[1].drive.operating
    rig.emulators[0].reconnect()
    rig.run(0.5)
    assert not any(emulator.drive.operating for emulator in rig.emulators)


def test_commands_are_checked():
    axes = LockStep().axes
    for position, velocity in [((0, np.nan), (0, 0)), ((0, 0), (np.inf, 0)), ((0, 0, 0), (0, 0)), ((0, 0), 0.0)]:
        with pytest.raises(ValueError, match="2 finite numbers"):
            axes.command(position, velocity, 0.0)
    link = AxisEmulator()
    with pytest.raises(ValueError, match="below upper"):
        Axis("x", link, CmmtProfile(), 1.0, -1.0)
    with pytest.raises(ValueError, match="direction"):
        Axis("x", link, CmmtProfile(), -1.0, 1.0, direction=0)
    with pytest.raises(ValueError, match="no axes given"):
        FestoAxes([])
    with pytest.raises(ValueError, match="overshoots"):
        AxesConfig(gain=10.0)
    with pytest.raises(ValueError, match="positive"):
        AxesConfig(speed=float("nan"))


# In real time


class RealTime:
    """Two served emulators whose ideal plants move in a thread."""

    def __init__(self, profile="cmmt"):
        kind, self.codec = PROFILES[profile]
        self.emulators = [AxisEmulator(kind) for _ in range(2)]
        self.position, self.velocity = np.zeros(2), np.zeros(2)
        self.step(time.monotonic(), 0.0)
        self.servers = [AxisServer(e) for e in self.emulators]
        self.finish = threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)

    def step(self, now, dt):
        self.position = self.position + self.velocity * dt
        self.velocity = np.array(
            [e.step(now, x, v) for e, x, v in zip(self.emulators, self.position, self.velocity, strict=True)]
        )

    def run(self):
        last = time.monotonic()
        while not self.finish.wait(0.001):
            now = time.monotonic()
            self.step(now, now - last)
            last = now

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *exc_info):
        self.finish.set()
        self.thread.join()
        for server in self.servers:
            server.close()

    def axes(self):
        # Generous times: what is tested is the order of things, on a machine that may be busy.
        config = AxesConfig(node_guard=1.0, command_timeout=0.5, state_timeout=0.5)
        links = [ModbusLink("127.0.0.1", s.port, timeout=0.5) for s in self.servers]
        return AxesThread([Axis(n, link, self.codec, -1.0, 1.0) for n, link in zip("xy", links, strict=True)], config)


def wait_for(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


@pytest.mark.realtime
@pytest.mark.parametrize("profile", ["cmmt", "fhpp"])
def test_over_tcp_in_real_time(profile):
    with RealTime(profile) as rig:
        with rig.axes() as thread:
            wait_for(lambda: thread.state is not None)
            thread.enable()
            wait_for(lambda: thread.state.enabled)
            thread.home()
            wait_for(lambda: thread.problem(time.monotonic()) is None)
            began = time.monotonic()
            while (t := time.monotonic() - began) < 0.5:
                thread.command((0.2 * t, -0.1 * t), (0.2, -0.1), began + t)
                time.sleep(1 / 75)
            assert thread.problem(time.monotonic()) is None and thread.cycles > 50
            moving_at = rig.position.copy()
        # Left in mid-motion: it has stopped and switched off in order, no drive had to do that itself.
        assert 0.02 < moving_at[0] < 0.12 and moving_at[1] == pytest.approx(-0.5 * moving_at[0], abs=0.03)
        wait_for(lambda: not any(e.drive.operating for e in rig.emulators))
        assert not any(e.drive.fault_code for e in rig.emulators)
        assert "not running" in thread.problem(time.monotonic())


@pytest.mark.realtime
@pytest.mark.parametrize("broken", [0, 1])
def test_thread_stops_the_axes_when_it_breaks(broken):
    """An error that nobody thought of, in one axis's exchange: the other is stopped and switched off."""
    with RealTime() as rig:
        with rig.axes() as thread:
            thread.enable()
            wait_for(lambda: thread.state is not None and thread.state.enabled)

            def exchange(*arguments):
                raise ZeroDivisionError("unforeseen")

            thread._channels[broken].axis.link.exchange = exchange
            wait_for(lambda: "broke off (ZeroDivisionError: unforeseen)" in (thread.problem(time.monotonic()) or ""))
            wait_for(lambda: not rig.emulators[1 - broken].drive.operating, seconds=0.9)  # before its node guard
            assert "restart the program" in thread.problem(time.monotonic())


@pytest.mark.realtime
def test_festos_own_client_runs_the_emulator():
    """festo-edcon pins another pymodbus, so it lives in an environment of its own."""
    python = os.environ.get(EDCON_PYTHON)
    if not python:
        pytest.skip(f"{EDCON_PYTHON} does not name a Python that has festo-edcon==1.0.3")
    with RealTime() as rig:
        rig.position[0] = 0.05
        script = ROOT / "tests" / "support" / "festo_client.py"
        command = [python, str(script), "127.0.0.1", str(rig.servers[0].port)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
            for line in client.stdout:
                if line == "fault\n":
                    rig.emulators[0].inject_fault(20)
                else:
                    told = loads(line)
            assert client.wait(60) == 0, client.stderr.read()
        assert all(
            told[k] is True
            for k in ("acknowledged", "enabled", "homed", "moved", "back", "stopped", "updated", "disabled")
        )
        assert told["device"] == "RIG-AXIS"
        assert told["units"] == [-6, -3, 2.0, 15.0, 15.0]  # powers of ten of m and m/s; m/s, m/s^2
        assert told["start"] == pytest.approx(50_000, abs=100)  # [um]
        assert told["position"] == pytest.approx(150_000, abs=100)
        assert told["velocity"] == pytest.approx(-1.0, abs=0.6)  # [m/s], somewhere on its ramp
        assert -250_000 < told["between"] < 150_000
        wanted = {"present": True, "code": 20, "refused": True, "acknowledged": True, "enabled": True, "moved": True}
        assert told["fault"] == wanted
        assert told["final"] == pytest.approx(150_000, abs=100)
        assert not rig.emulators[0].drive.operating and rig.emulators[0].drive.fault_code == 0
