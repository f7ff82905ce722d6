"""The emulated linear axes: motion against closed forms, states, delays, the Modbus server over real sockets."""

from __future__ import annotations

import math
import socket
import struct

import numpy as np
import pytest

from robot_io.contract import PAPER
from robot_io.devices.festo import AxisCommand, AxisLost, CmmtProfile, FhppProfile, ModbusLink
from robot_io.emulator.axes import AxisEmulator
from robot_io.emulator.axis_drive import DriveParams, Power
from robot_io.emulator.axis_motion import advance, brake
from robot_io.emulator.axis_server import AxisServer
from robot_io.emulator.config import RigParams, drives_of
from robot_io.emulator.hidden import HiddenErrors
from tests.support.axes_lockstep import PROFILES, LockStep, Stream

A, V = 15.0, 2.0  # [m/s^2], [m/s]


@pytest.mark.parametrize(
    ("way", "speed", "peak", "duration"),
    [
        (0.15, V, 1.5, 0.2),  # triangle: peak sqrt(a d), time 2 sqrt(d / a)
        (-0.15, V, -1.5, 0.2),
        (1.0, V, 2.0, 1.0 / 2.0 + 2.0 / 15.0),  # trapezoid: d / v + v / a
        (-0.5, 0.5, -0.5, 1.0 + 0.5 / 15.0),
    ],
)
def test_trapezoid_from_rest(way, speed, peak, duration):
    x, v = advance(0.0, 0.0, way, speed, A, duration / 2)
    assert v == pytest.approx(peak, abs=1e-9) and x == pytest.approx(way / 2, abs=1e-9)
    x, v = advance(0.0, 0.0, way, speed, A, duration - 1e-3)
    assert x == pytest.approx(way - math.copysign(0.5 * A * 1e-6, way), abs=1e-9)  # mirrored start
    assert advance(0.0, 0.0, way, speed, A, duration + 1e-9) == (way, 0.0)


def test_trapezoid_from_motion():
    # Away from the target at 1.5 m/s: back at rest after 0.1 s and 0.075 m, then a triangle over the rest.
    assert advance(0.0, -1.5, 0.15, V, A, 0.1) == (pytest.approx(-0.075), pytest.approx(0.0, abs=1e-9))
    total = 0.1 + 2 * math.sqrt(0.225 / A)
    assert advance(0.0, -1.5, 0.15, V, A, total + 1e-9) == (0.15, 0.0)
    # Too fast to stop before the target: brakes, having overshot by v^2 / 2a - d, and comes back.
    assert advance(0.0, 1.5, 0.05, V, A, 0.1)[0] == pytest.approx(0.075)
    assert advance(0.0, 1.5, 0.05, V, A, 0.1 + 2 * math.sqrt(0.025 / A) + 1e-9) == (0.05, 0.0)
    # Faster than the speed allows now: slows down first.
    assert advance(0.0, 2.0, 1.0, 0.5, A, 0.1) == (pytest.approx(0.125), pytest.approx(0.5))
    assert advance(0.2, 0.0, 0.7, 0.0, A, 1.0) == (0.2, 0.0)
    assert brake(0.0, -1.5, A, 0.05) == (pytest.approx(-0.05625), pytest.approx(-0.75))
    assert brake(0.0, -1.5, A, 1.0) == (pytest.approx(-0.075), 0.0)


def test_trapezoid_is_exact_whatever_the_step():
    """Many steps end where one does, within speed and acceleration, for any state and target."""
    random = np.random.default_rng(0)
    for x0, v0, target, duration in zip(
        *random.uniform([[-1], [-2], [-1], [0]], [[1], [2], [1], [2]], (4, 500)), strict=True
    ):
        speed, count = random.choice([0.01, 0.3, 1.0, 2.0]), int(random.integers(2, 40))
        x, v, dt = x0, v0, duration / count
        for _ in range(count):
            before, v_before = x, v
            x, v = advance(x, v, target, speed, A, dt)
            assert abs(v - v_before) <= A * dt + 1e-9
            assert abs(v) <= max(abs(v_before), speed) + 1e-9
            assert abs(x - before) <= max(abs(v), abs(v_before), speed) * dt + 1e-9
        once = advance(x0, v0, target, speed, A, duration)
        assert (x, v) == (pytest.approx(once[0], abs=1e-8), pytest.approx(once[1], abs=1e-5))


class Bench:
    """One emulator, an ideal plant and its registers, written by hand."""

    def __init__(self, profile="cmmt", start=0.3, **parameters):
        kind, self.codec = PROFILES[profile]
        self.emulator = AxisEmulator(kind, **{"dead_time": 0.0, "feedback_delay": 0.0, **parameters})
        self.now, self.x, self.v, self.sequence = 0.0, start, 0.0, 0
        self.xs: list[float] = []
        self.run(0.0)

    def write(self, **command):
        self.sequence += 1
        image = self.codec.encode(AxisCommand(sequence=self.sequence, **command))
        codec = self.codec
        return codec.decode(self.emulator.exchange(codec.write_address, image, codec.read_address, codec.read_count))

    def run(self, seconds, **command):
        """Steps of 1 ms; with a command it is written every 8 ms."""
        status = None
        for i in range(round(seconds / 0.001) + 1):
            if command and i % 8 == 0:
                status = self.write(**command)
            self.v = self.emulator.step(self.now, self.x, self.v)
            self.xs.append(self.x)
            self.x, self.now = self.x + self.v * 0.001, self.now + 0.001
        return status

    def operate(self, home=True):
        self.run(0.02, acknowledge=False)
        self.run(0.1, enable=True)
        if home:
            self.run(1.1, enable=True, home=True)
        assert self.emulator.drive.operating and self.emulator.drive.homed == home
        return self


MOVE = dict(enable=True, move=True, speed=1.0, acceleration=A)


@pytest.mark.parametrize("profile", PROFILES)
class TestDrive:
    def test_positions_in_the_time_of_the_trapezoid(self, profile):
        bench = Bench(profile, params=DriveParams(smoothing=0.0)).operate()
        begin = len(bench.xs)
        bench.run(0.9, **MOVE, position=-0.4)
        xs = np.array(bench.xs[begin:])
        duration = np.flatnonzero(np.abs(xs + 0.4) > 1e-3)[-1] * 0.001
        exact = 0.7 / 1.0 + 1.0 / A - math.sqrt(2 * 1e-3 / A)  # less the last millimetre
        assert duration == pytest.approx(exact, abs=0.010)  # profiles that mark targets by an edge wait a cycle
        assert bench.x == pytest.approx(-0.4, abs=1e-4) and xs.min() > -0.4005

    def test_homing_takes_its_time_and_gives_the_position_its_meaning(self, profile):
        bench = Bench(profile).operate(home=False)
        assert bench.write(enable=True).position == pytest.approx(0.0)  # from where it was switched on
        bench.run(0.5, **MOVE, position=0.1)
        assert bench.x == pytest.approx(0.3)  # absolute positions mean nothing yet
        status = bench.run(0.9, enable=True, home=True)
        assert status.homing and not status.homed
        status = bench.run(0.3, enable=True, home=True)
        assert status.homed and not status.homing and status.position == pytest.approx(0.3, abs=1e-5)

    def test_homing_that_is_broken_off_does_not_count(self, profile):
        bench = Bench(profile).operate(home=False)
        bench.run(0.5, enable=True, home=True)
        status = bench.run(1.0, enable=True)
        assert not status.homed and not status.homing

    def test_fault_stops_and_stays_until_acknowledged(self, profile):
        bench = Bench(profile, params=DriveParams(smoothing=0.0)).operate()
        bench.run(0.3, **MOVE, position=-0.4)
        assert bench.v == pytest.approx(-1.0, abs=0.01)
        bench.emulator.inject_fault(51)
        before = bench.x
        status = bench.run(0.3, **MOVE, position=-0.4)
        assert status.fault and not status.enabled and bench.v == 0.0
        assert bench.x - before == pytest.approx(-1.0 / (2 * A), abs=0.002)
        status = bench.run(0.1, enable=True)
        assert status.fault and not status.enabled
        assert status.fault_code == (51 if profile == "cmmt" else 0)
        status = bench.run(0.1, enable=True, acknowledge=True)
        assert not status.fault and not status.enabled  # an ON that was there before does not count
        bench.run(0.02, acknowledge=False)
        assert bench.run(0.1, enable=True).enabled

    def test_the_cause_of_a_fault_has_to_end_before_the_acknowledgement(self, profile):
        bench = Bench(profile).operate()
        bench.run(0.3, **MOVE, position=-0.4)
        bench.emulator.inject_fault(51)
        bench.run(0.01, acknowledge=True)  # still braking
        assert bench.run(0.2, acknowledge=True).fault
        bench.run(0.02, acknowledge=False)
        assert not bench.run(0.02, acknowledge=True).fault

    def test_node_guard_stops_a_drive_that_nobody_talks_to(self, profile):
        bench = Bench(profile, node_guard=0.1).operate()
        bench.run(0.3, **MOVE, position=-0.9)
        bench.run(0.08)  # less than the guard
        assert bench.run(0.2, **MOVE, position=-0.9).enabled
        before = bench.x
        bench.run(0.4)
        assert bench.v == 0.0 and bench.emulator.drive.power is Power.INHIBITED
        assert bench.x - before == pytest.approx(-1.0 * 0.1 - 1.0 / (2 * A), abs=0.015)
        assert bench.emulator.drive.fault_code == (391 if profile == "cmmt" else 0x47)

    def test_node_guard_leaves_a_drive_alone_that_is_off(self, profile):
        bench = Bench(profile, node_guard=0.1)
        bench.run(0.02, acknowledge=False)
        bench.run(1.0)
        assert not bench.write().fault

    def test_stop_and_switching_off_brake(self, profile):
        for command, enabled in ((dict(enable=True), True), (dict(enable=False), False)):
            bench = Bench(profile, params=DriveParams(smoothing=0.0)).operate()
            bench.run(0.3, **MOVE, position=-0.4)
            before = bench.x
            status = bench.run(0.2, **command)
            assert abs(bench.v) < 0.002 and status.enabled == enabled and not status.fault
            assert bench.x - before == pytest.approx(-1.0 / (2 * A), abs=0.002)
            assert bench.run(0.3, **command).enabled == enabled and abs(bench.v) < 1e-5  # the task is gone

    def test_an_axis_that_is_blocked_faults(self, profile):
        bench = Bench(profile).operate()
        for i in range(400):
            if i % 8 == 0:
                status = bench.write(**MOVE, position=-0.9)
            bench.emulator.step(bench.now, bench.x, 0.0)
            bench.now += 0.001
        assert status.fault and bench.emulator.drive.fault_code == 126

    def test_targets_are_taken_after_the_dead_time_and_states_are_as_old_as_they_should_be(self, profile):
        bench = Bench(profile, params=DriveParams(smoothing=0.0), dead_time=0.050, feedback_delay=0.033).operate()
        begin, time = len(bench.xs), bench.now
        while bench.now < time + 0.3:
            bench.run(0.0, **MOVE, position=-0.4)
        xs = np.array(bench.xs[begin:])
        first = np.flatnonzero(xs != xs[0])[0]
        assert 0.050 <= first * 0.001 <= 0.053
        now = (len(bench.xs) - 1) * 0.001
        exact = np.interp(now - 0.033, np.arange(len(bench.xs)) * 0.001, bench.xs)
        status = bench.write(**MOVE, position=-0.4)
        assert status.position == pytest.approx(exact, abs=2e-5)
        assert status.velocity == pytest.approx(-1.0, abs=0.02)


@pytest.mark.parametrize("profile", ["cmmt", "fhpp continuous"])
def test_latency_of_a_velocity_change(profile):
    """64.5 ms from the command to the middle of the change, averaged over where in the bus cycle the command falls."""
    latencies = []
    for offset in np.linspace(0.0005, 0.0075, 8):
        rig = LockStep(profile, start=(-0.8, 0.0)).start()
        stream = Stream(rig, lambda t: (0.4 if t < 0.5 else 0.6, 0.0), offset=offset)
        rig.run(0.75, stream)
        given = stream.trace[np.flatnonzero(stream.trace[:, 3] > 0.5)[0], 0]
        trace = rig.trace[rig.trace[:, 0] >= given + 0.03]
        times, v = trace[:, 0], trace[:, 3]
        i = np.flatnonzero((v[:-1] < 0.5) & (v[1:] >= 0.5))[0]
        latencies.append(times[i] + 0.001 * (0.5 - v[i]) / (v[i + 1] - v[i]) - given)
    assert np.mean(latencies) == pytest.approx(0.0645, abs=0.001)
    assert np.ptp(latencies) < 0.008  # a cycle of the bus


# Golden status words: PROFIdrive's states S1 (inhibited), S2 (ready), S4 (operating) and a fault.


def test_status_words_of_telegram_111():
    bench = Bench("cmmt")
    words = bench.emulator.read(100, 28)
    # Following error fine (8), control requested (9), target reached (10), stopped (13), inhibited (6).
    assert words[:5] == [0x2740, 0, 0, 0, 0]
    bench.run(0.01, acknowledge=False)
    # Ready to switch on (0), no coast stop (4), no quick stop (5) instead of inhibited.
    assert bench.emulator.read(100, 1) == [0x2731]
    bench.operate()
    # Ready to operate (1), operation enabled (2), home set (11); MDI active (15).
    assert bench.emulator.read(100, 2) == [0x2F37, 0x8000]
    bench.run(0.1, **MOVE, position=-0.4)
    # A task (12), neither at its target (10) nor stopped (13).
    assert bench.emulator.read(100, 1) == [0x1B37]
    bench.run(1.5, **MOVE, position=-0.4)
    assert bench.emulator.read(105, 2) == [0xFFFF & -400_000, 0xFFFF & (-400_000 >> 16)]
    bench.emulator.inject_fault(51)
    bench.run(0.01)
    words = bench.emulator.read(100, 11)
    assert words[0] & 0x4F == 0x48 and words[9] == 51  # fault (3), inhibited (6)


def test_registers_that_there_are():
    cmmt, fhpp = AxisEmulator("cmmt"), AxisEmulator("fhpp")
    cmmt.exchange(400, [123, 0], 400, 2)
    assert cmmt.bank.node_guard == 0.123
    cmmt.exchange(400, [0x86A0, 1], 400, 2)
    assert cmmt.bank.node_guard == 100.0
    zeros = [0] * 28
    for write, values, read, count in [
        (0, zeros[:10], 100, 28),  # less than the telegram
        (1, zeros[:11], 100, 28),
        (0, zeros + [0], 100, 28),
        (100, zeros, 100, 28),  # inputs
        (0, zeros, 100, 29),
        (0, zeros, 300, 1),
        (0, zeros, 100, 0),
        (0, [65536] + zeros[1:], 100, 28),
    ]:
        with pytest.raises(AxisLost, match="illegal data address"):
            cmmt.exchange(write, values, read, count)
    for write, values, read, count in [
        (0, zeros[:3], 0, 4),
        (0, zeros[:5], 0, 4),
        (0, zeros[:4], 0, 5),
        (400, [1], 0, 4),
    ]:
        with pytest.raises(AxisLost, match="illegal data address"):
            fhpp.exchange(write, values, read, count)
    assert cmmt.images == fhpp.images == 0
    with pytest.raises(ValueError, match="available are cmmt, fhpp"):
        AxisEmulator("cia402")


@pytest.mark.parametrize(("profile", "unit"), [("cmmt", 1e-6), ("fhpp", 1e-5)])
def test_a_hidden_base_velocity_leaves_the_unit_of_positions(profile, unit):
    params = RigParams(axis_profile=profile, hidden=HiddenErrors(base_velocity=1.5))
    assert {(drive.bank.units.position, drive.bank.units.base_velocity) for drive in drives_of(params, PAPER)} == {
        (unit, 1.5)
    }


# Over real sockets


@pytest.fixture
def served():
    emulator = AxisEmulator("cmmt")
    emulator.step(0.0, 0.3, 0.0)
    with AxisServer(emulator) as server:
        yield emulator, server


IMAGE = CmmtProfile().encode(AxisCommand(enable=True, move=True, position=0.1, speed=1.0, acceleration=5.0))


def frame(function, body, unit=1, transaction=1, protocol=0):
    return struct.pack(">HHHBB", transaction, protocol, len(body) + 2, unit, function) + body


def read_write(image=IMAGE, read=(100, 28), write=0):
    count = len(image)
    return struct.pack(f">HHHHB{count}H", *read, write, count, 2 * count, *image)


def ask(server, request, parts=1):
    with socket.create_connection(("127.0.0.1", server.port), timeout=2.0) as connection:
        size = -(-len(request) // parts)
        for i in range(parts):
            connection.sendall(request[i * size : (i + 1) * size])
        return connection.recv(512)


def test_read_write_multiple_registers_byte_for_byte(served):
    emulator, server = served
    answer = ask(server, frame(0x17, read_write(), transaction=0x1234), parts=3)
    assert answer[:9] == bytes.fromhex("12340000003b011738")  # 59 bytes: unit, 0x17, 56, 28 registers
    assert struct.unpack(">28H", answer[9:]) == tuple(emulator.read(100, 28))
    assert emulator.images == 1 and emulator.bank.outputs == IMAGE


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (frame(0x17, read_write(read=(300, 1))), "9702"),
        (frame(0x17, read_write(write=1)), "9702"),
        (frame(0x17, read_write(IMAGE[:10])), "9702"),
        (frame(0x10, struct.pack(">HHB4H", 100, 4, 8, 1, 2, 3, 4)), "9002"),
        (frame(0x06, struct.pack(">HH", 0, 0x047F)), "8602"),
        (frame(0x05, struct.pack(">HH", 0, 0xFF00)), "8501"),
        (frame(0x0F, struct.pack(">HHBH", 0, 16, 2, 0x7F04)), "8f01"),
        (frame(0x16, struct.pack(">HHH", 0, 0, 0x047F)), "9601"),
        (frame(0x17, read_write(), unit=2), "9704"),
        (frame(0x17, read_write(), unit=0), "9704"),
    ],
)
def test_requests_that_are_refused(served, request_, answer):
    emulator, server = served
    assert ask(server, request_)[7:].hex() == answer
    assert emulator.images == 0


def test_a_second_client_is_refused(served):
    emulator, server = served
    profile = CmmtProfile()
    request = (0, profile.encode(AxisCommand()), 100, 28)
    first, second = ModbusLink("127.0.0.1", server.port, timeout=0.5), ModbusLink("127.0.0.1", server.port, timeout=0.5)
    first.exchange(*request)
    with pytest.raises(AxisLost):
        second.exchange(*request)
    first.exchange(*request)  # undisturbed
    assert emulator.images == 2
    first.close()
    assert ask(server, frame(0x03, struct.pack(">HH", 100, 1)))[7:9] == b"\x03\x02"  # free again


def test_a_pulled_cable_is_silence(served):
    """No answer, no end of the connection, nothing done: until it is plugged in, when old connections are gone."""
    emulator, server = served
    request = frame(0x17, read_write())
    with socket.create_connection(("127.0.0.1", server.port), timeout=2.0) as connection:
        connection.sendall(request)
        assert connection.recv(100) and emulator.images == 1
        emulator.disconnect()
        connection.settimeout(0.3)
        connection.sendall(request)
        with pytest.raises(TimeoutError):
            connection.recv(100)
        with socket.create_connection(("127.0.0.1", server.port), timeout=0.3) as another:
            another.sendall(request)
            with pytest.raises(TimeoutError):
                another.recv(100)
            assert emulator.images == 1
            emulator.reconnect()
            for old in (connection, another):
                try:
                    assert old.recv(100) == b""
                except ConnectionResetError:
                    pass
    assert ask(server, request)[7] == 0x17 and emulator.images == 2


def test_a_port_in_use(served):
    with pytest.raises(OSError, match=f"port {served[1].port}"):
        AxisServer(AxisEmulator("cmmt"), port=served[1].port)
    with pytest.raises(ValueError, match="every id"):
        AxisServer(AxisEmulator("cmmt"), device_id=0)


def is_sound(data):
    """True where the bytes begin with a request that may command the axis; by the Modbus specification, strictly."""
    if len(data) < 8:
        return False
    _, protocol, length, unit, function = struct.unpack(">HHHBB", data[:8])
    body = data[8 : 6 + length]
    if protocol != 0 or unit != 1 or length + 6 > len(data):
        return False
    if function == 0x17 and len(body) >= 9:
        read, read_count, write, count, size = struct.unpack(">HHHHB", body[:9])
        if not any(
            low <= read and read + read_count <= high for low, high in ((0, 28), (100, 128), (400, 402), (500, 574))
        ):
            return False
        return read_count > 0 and write == 0 and 11 <= count <= 28 and size == 2 * count == len(body) - 9
    if function == 0x10 and len(body) >= 5:
        write, count, size = struct.unpack(">HHB", body[:5])
        return write == 0 and 11 <= count <= 28 and size == 2 * count == len(body) - 5
    return False


def mutants(count):
    random = np.random.default_rng(1)
    originals = [
        (frame(0x17, read_write()), 17),
        (frame(0x10, struct.pack(">HHB28H", 0, 28, 56, *IMAGE)), 13),
    ]
    found = 0
    while found < count:
        original, header = originals[random.integers(2)]
        data, kind = bytearray(original), random.integers(6)
        if kind < 3:  # flipped bits in the header, where each means something
            for place in random.integers(8 * header, size=random.integers(1, 4)):
                data[place // 8] ^= 1 << place % 8
        elif kind == 3:
            del data[random.integers(1, len(data)) :]
        elif kind == 4:
            place = random.integers(header)
            data[place : place + random.integers(0, 2)] = random.bytes(random.integers(0, 3))
        else:
            data = bytearray(random.bytes(random.integers(1, 300)))
        if not is_sound(bytes(data)):
            found += 1
            yield bytes(data)


def test_damaged_requests_neither_command_nor_crash(served):
    emulator, server = served
    assert is_sound(frame(0x17, read_write())) and not is_sound(frame(0x17, read_write(), unit=2))
    for data in mutants(3000):
        try:
            with socket.create_connection(("127.0.0.1", server.port), timeout=2.0) as connection:
                connection.sendall(data)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(512):
                    pass
        except ConnectionError:
            pass
    assert server.refused < 300  # the others were taken and read
    assert emulator.images == 0 and emulator.bank.node_guard == 1.0
    link = ModbusLink("127.0.0.1", server.port, timeout=1.0)
    link.exchange(0, IMAGE, 100, 28)
    assert emulator.images == 1 and emulator.bank.outputs == IMAGE


def test_fhpp_over_tcp():
    emulator = AxisEmulator("fhpp")
    emulator.step(0.0, 0.3, 0.0)
    with AxisServer(emulator, device_id=255) as server:
        profile = FhppProfile()
        link = ModbusLink("127.0.0.1", server.port, timeout=1.0, device_id=255)
        status = profile.decode(link.exchange(0, profile.encode(AxisCommand()), 0, 4))
        assert status.ready and not status.enabled and emulator.images == 1
        link.close()
