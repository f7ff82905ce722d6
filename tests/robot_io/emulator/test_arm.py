"""The emulated arm controller: cycle by cycle against closed forms, as other programs see it, when things die."""

from __future__ import annotations

import heapq
import random
import socket
import struct

import numpy as np
import pytest

from robot_io.devices.egm.messages import decode_robot, encode_sensor
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.emulator.arm import ArmController, ArmParams, ArmStateError
from tests.support.damaged_egm import damage

CLIENT, CONTROLLER = ("192.168.125.20", 6510), ("192.168.125.1", 50123)
CYCLE = 0.004
ZERO = np.zeros(6)
MAX_SPEED = np.deg2rad([250.0, 250.0, 250.0, 420.0, 590.0, 600.0])  # IRB 120T
BARE = {
    "dead_time": 0.0,
    "pos_corr_gain": 0.0,
    "low_pass": 1000.0,
}  # speed of the message before, to 1e-11


class Rig:
    """A controller with ideal drives: joints move exactly at the velocity that it returns."""

    def __init__(self, position=ZERO, start=True, client=CLIENT, **params):
        self.arm = ArmController(client, ArmParams(**{"ramp_in": 0.0} | params))
        self.position, self.velocity = np.array(position, float), np.zeros(6)
        self.cycles, self.messages = 0, 0
        self.datagram: bytes | None = None
        if start:
            self.start()

    def start(self):
        self.arm.switch_on()

    @property
    def now(self):
        """Time of the latest cycle."""
        return self.cycles * CYCLE

    def step(self, cycles=1):
        for _ in range(cycles):
            self.cycles += 1
            self.velocity, self.datagram = self.arm.step(self.now, self.position, self.velocity)
            self.position = self.position + self.velocity * CYCLE
        return self.velocity

    def command(self, velocity, position=None, source=CLIENT):
        self.messages += 1
        target = self.position if position is None else position
        return self.arm.receive(encode_sensor(self.messages, 0, target, np.broadcast_to(velocity, 6)), source, self.now)

    def state(self):
        message = decode_robot(self.datagram)
        return message.motors_on, message.rapid_running, message.egm_running


# Feedback


def test_commands_grow_to_their_full_effect_while_egm_ramps_in():
    rig, seen = Rig(ramp_in=1.0, **BARE), []
    for _ in range(300):
        rig.command(0.5)
        seen.append(rig.step()[0])
    times = CYCLE * np.arange(1, 301)
    np.testing.assert_allclose(seen, 0.5 * np.clip(times - CYCLE, 0.0, 1.0), atol=0.003)


def test_no_commanded_speed_exceeds_the_deviation_that_rapid_allows():
    rig = Rig(max_speed_deviation=0.3, **BARE)
    rig.command(np.array([0.2, 0.3, 0.4, -0.2, -0.3, -1.0]))
    rig.step(2)
    np.testing.assert_allclose(rig.velocity, [0.2, 0.3, 0.3, -0.2, -0.3, -0.3], atol=1e-9)


def test_feedback_is_delayed_and_interpolated():
    rig = Rig(feedback_delay=0.029, **BARE)
    acceleration = np.array([1.0, 2.0, -1.0, 0.5, 0.0, 3.0])

    def truth(n):
        return acceleration * (n * CYCLE) ** 2

    for n in range(1, 101):
        _, datagram = rig.arm.step(n * CYCLE, truth(n), ZERO)
        message = decode_robot(datagram)
        assert message.sequence == n - 1 and message.time == pytest.approx(0.004 * n)
        # 29 ms are 7.25 cycles: a quarter of the way from the 7th cycle back to the 8th,
        # and before the first cycle the arm is taken to have stood where it was found.
        expected = 0.75 * truth(n - 7) + 0.25 * truth(n - 8) if n > 8 else truth(1)
        np.testing.assert_allclose(message.position, expected, atol=1e-12)


def test_states_are_reported_and_a_new_start_begins_a_new_session():
    rig, session = Rig(start=False), EgmSession(EgmConfig(CONTROLLER[0]))

    def report():
        rig.step()
        assert session.receive(rig.datagram, CONTROLLER, rig.now)
        return rig.state(), session.session_id, session.problem(rig.now)

    assert report()[:2] == ((False, False, False), 1)
    rig.arm.motors_on()
    assert report()[:2] == ((True, False, False), 2)
    rig.arm.start_rapid()
    assert report()[:2] == ((True, True, False), 3)
    rig.arm.start_egm()
    assert report() == ((True, True, True), 4, None)
    assert report() == ((True, True, True), 4, None)
    rig.arm.motors_off()
    state, session_id, problem = report()
    assert (state, session_id) == ((False, False, False), 5) and "motors are off" in problem
    rig.start()
    assert report() == ((True, True, True), 6, None)
    assert session.feedback.sequence == 0  # numbers begin anew, so the order is told by the controller's clock


def test_without_streaming_feedback_comes_only_while_egm_runs():
    rig = Rig(start=False, stream_always=False)
    rig.step()
    assert rig.datagram is None
    rig.start()
    rig.step()
    assert rig.state() == (True, True, True)


# Messages and the path of the references


def test_one_queued_message_is_taken_per_cycle():
    rig = Rig(**BARE)
    rig.step()
    for speed in (0.1, 0.2, 0.3):
        assert rig.command(speed)
    assert [round(rig.step()[0], 9) for _ in range(6)] == [0.0, 0.1, 0.2, 0.3, 0.3, 0.3]  # and the last one stays


def test_a_full_queue_drops_what_comes_later():
    rig = Rig(queue_length=2, **BARE)
    assert [rig.command(s) for s in (0.1, 0.2, 0.3)] == [True, True, False]
    assert rig.arm.rejected == {"queue_full": 1}


@pytest.mark.parametrize("dead_time", [0.055, 0.012, 0.0])
def test_dead_time_and_low_pass_are_those_of_the_closed_form(dead_time):
    rig = Rig(dead_time=dead_time, pos_corr_gain=0.0)
    rig.step()
    rig.command(1.0)
    taken = rig.now + CYCLE  # by the next cycle
    for _ in range(60):
        velocity, t = rig.step(), rig.now - taken - dead_time
        expected = 1 - np.exp(-2 * np.pi * 20.0 * t) if t > 0 else 0.0
        np.testing.assert_allclose(velocity, np.full(6, expected), atol=1e-9)
        rig.command(1.0)


def test_position_correction_is_an_exponential_approach():
    gain, target = 5.0, np.array([0.2, -0.1, 0.1, 0.3, -0.3, 0.5])
    rig = Rig(dead_time=0.0, pos_corr_gain=gain)
    for n in range(1, 101):
        rig.command(0.0, target)
        rig.step()
        np.testing.assert_allclose(rig.position, target * (1 - (1 - gain * CYCLE) ** n), atol=1e-12)


def test_the_last_velocity_is_kept_until_the_timeout():
    rig = Rig(comm_timeout=1.0, **BARE)
    rig.command(0.5)
    rig.step()
    np.testing.assert_allclose(rig.step(249), np.full(6, 0.5), atol=1e-9)
    assert rig.state() == (True, True, True)
    assert abs(rig.step(2)[0]) < 0.5
    assert rig.state() == (True, True, False)
    assert rig.arm.cause == "EGM stopped: no message for 1.000 s"
    rig.step(5)
    np.testing.assert_array_equal(rig.velocity, ZERO)


def test_without_a_first_message_egm_stops_too():
    rig = Rig(comm_timeout=0.1)
    rig.step(26)
    rig.step()
    assert rig.state() == (True, True, False)


def test_a_dead_client_and_a_short_timeout_stop_the_arm_within_150_ms():
    """All joints at the 120T's full speed, the client dies after a reply. Only the controller can stop the arm."""
    direction = np.array([1, -1, 1, -1, 1, -1])
    start = -direction * np.array([0.8, 0.8, 0.3, 1.2, 1.0, 2.0])
    rig = Rig(start, comm_timeout=0.05)
    target = start.copy()
    for n in range(55):  # 120 ms of acceleration to full speed, and kept until it has passed the dead time
        speed = direction * MAX_SPEED * min(1.0, n / 30)
        target = target + speed * CYCLE
        assert rig.command(speed, target)
        rig.step()
    died, full = rig.now - CYCLE, rig.position  # its last message was sent after the cycle before
    np.testing.assert_allclose(np.abs(rig.velocity), MAX_SPEED, rtol=0.03)
    while rig.velocity.any():
        rig.step()
        assert rig.now - died < 0.150
    assert rig.arm.cause == "EGM stopped: no message for 0.052 s"
    assert rig.arm.motors_are_on and (np.abs(rig.position - full) < MAX_SPEED * 0.11).all()


# Stops and supervision


def test_an_emergency_stop_brakes_at_the_set_deceleration_and_rests():
    rig = Rig(**BARE, stop_deceleration=(20.0,) * 6)
    rig.command(1.0)
    rig.step(2)
    rig.arm.motors_off()
    assert "emergency stop" in rig.arm.cause
    speeds = [rig.step()[0] for _ in range(15)]
    np.testing.assert_allclose(speeds, np.maximum(1.0 - 0.08 * np.arange(1, 16), 0.0), atol=1e-9)
    assert rig.state() == (False, False, False)
    assert not rig.command(1.0) and rig.arm.rejected == {"not_running": 1}
    np.testing.assert_array_equal(rig.step(10), ZERO)


@pytest.mark.parametrize("stop", ["stop_egm", "stop_rapid"])
def test_other_stops_keep_the_motors_on(stop):
    rig = Rig(**BARE)
    rig.command(0.1)
    assert rig.step(2).all()
    getattr(rig.arm, stop)()
    np.testing.assert_array_equal(rig.step(3), ZERO)
    assert rig.state() == (True, stop == "stop_egm", False)


def test_the_operator_must_follow_the_order():
    rig = Rig(start=False, **BARE)
    with pytest.raises(ArmStateError, match="motors_on"):
        rig.arm.start_rapid()
    rig.arm.motors_on()
    with pytest.raises(ArmStateError, match="start_rapid"):
        rig.arm.start_egm()
    rig.arm.start_rapid()
    rig.arm.start_egm()
    for _ in range(10):
        rig.command(1.0)
    rig.step(2)
    rig.arm.stop_egm()
    with pytest.raises(ArmStateError, match="brakes"):
        rig.arm.start_egm()
    rig.step(10)
    rig.arm.start_egm()
    np.testing.assert_array_equal(rig.step(20), ZERO)  # nothing is left of the session before


def test_supervision_switches_the_motors_off():
    rig = Rig(np.deg2rad([164, 0, 0, 0, 0, 0]), **BARE)
    for _ in range(40):
        rig.command(1.0, ZERO)
        rig.step()
    assert rig.state() == (False, False, False)
    assert "arm joint 1 is at" in rig.arm.cause and rig.position[0] < np.deg2rad(168)
    rig = Rig()
    rig.step()
    rig.arm.step(1.0, ZERO, 1.2 * MAX_SPEED)
    assert not rig.arm.motors_are_on and "arm joint 1 moves at 5.236 rad/s" in rig.arm.cause


@pytest.mark.parametrize(("speed", "position"), [(5.0, ZERO), (0.0, np.full(6, 3.0)), (1e300, ZERO)])
def test_a_reference_beyond_the_arm_ends_egm(speed, position):
    rig = Rig(**BARE)
    rig.command(0.1)
    assert rig.step(2).all()
    assert not rig.command(speed, position)
    np.testing.assert_array_equal(rig.step(3), ZERO)
    assert rig.state() == (True, True, False) and "joint 1 out of range" in rig.arm.cause


def test_what_cannot_be_is_refused():
    rig = Rig()
    rig.step()
    for state in ((np.full(6, np.nan), ZERO), (ZERO, np.full(6, np.inf)), (np.zeros(5), ZERO)):
        with pytest.raises(ValueError):
            rig.arm.step(1.0, *state)
    with pytest.raises(ValueError, match="advance"):
        rig.arm.step(rig.now, ZERO, ZERO)
    for wrong in ({"comm_timeout": 0.0}, {"dead_time": -1.0}, {"max_speed": (1.0,)}, {"stop_deceleration": (0.0,) * 6}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            ArmParams(**wrong)


# Whom it listens to


def joint_bytes(values):
    return b"\x0a\x36" + b"".join(b"\x09" + struct.pack("<d", v) for v in values)


COMMAND_SPEED = np.array([10.0, -20.0, 30.0, -40.0, 50.0, -60.0])  # [deg/s]
COMMAND = (  # an EgmSensor by hand: header (sequence 5, correction), planned, speedRef
    b"\x0a\x04\x08\x05\x18\x03"
    + b"\x12\x38"
    + joint_bytes([1.0, -2.0, 3.0, -4.0, 5.0, -6.0])
    + b"\x1a\x38"
    + joint_bytes(COMMAND_SPEED)
)
NUMBERS = [at for start in (10, 68) for at in range(start + 1, start + 54, 9)]  # offsets of its joints


def test_the_command_by_hand_is_taken():
    rig = Rig(**BARE)
    assert rig.arm.receive(COMMAND, CLIENT, 0.0)
    np.testing.assert_allclose(rig.step(2), np.deg2rad(COMMAND_SPEED), rtol=1e-9)


@pytest.mark.parametrize("source", [(CLIENT[0], 6511), ("192.168.125.21", CLIENT[1]), CONTROLLER])
def test_only_the_endpoint_it_sends_to_is_obeyed(source):
    rig = Rig(**BARE)
    assert not rig.command(1.0, source=source)
    np.testing.assert_array_equal(rig.step(2), ZERO)
    assert rig.arm.rejected == {"stranger": 1}


def test_100000_mutated_datagrams_move_nothing_that_they_must_not():
    rng, rig = random.Random(2), Rig(comm_timeout=10.0, **BARE)
    plain = [i for i in range(len(COMMAND)) if not any(at <= i < at + 8 for at in NUMBERS)]
    speed, taken_by_kind, restarts = np.deg2rad(COMMAND_SPEED), [0] * 8, 0
    for i in range(100_000):
        kind = i % 8
        source = (CLIENT[0], rng.randrange(1024, 6510)) if kind == 3 else CLIENT
        data = damage(rng, kind, COMMAND, NUMBERS, plain, (np.nan, np.inf, -np.inf, 1e300, -1e4))
        if rig.arm.receive(data, source, 0.0):
            taken_by_kind[kind] += 1
            rig.position = ZERO
            rig.step(2)
            assert (np.abs(rig.velocity) <= MAX_SPEED).all()  # False for NaN too
            if kind in (4, 5):
                assert np.abs(rig.velocity - speed).max() < 1e-9
        elif not rig.arm.egm_is_running:
            assert "out of range" in rig.arm.cause
            rig.position = ZERO
            while rig.velocity.any():
                rig.step()
            rig.arm.start_egm()
            restarts += 1
    assert taken_by_kind[:4] == [0, 0, 0, 0] and restarts > 100
    rejected = rig.arm.rejected
    assert rejected.total() + sum(taken_by_kind) == 100_000 and rejected["stranger"] == 12_500
    assert min(rejected[r] for r in ("malformed", "incomplete", "not_finite", "joint_count", "wrong_type")) > 10


# Both ends together


def test_another_library_drives_the_arm_over_udp():
    egm = pytest.importorskip("ABBRobotEGM").EGM
    with egm(port=0) as client, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        wire.settimeout(2.0)
        rig = Rig(client=("127.0.0.1", client.socket.getsockname()[1]), feedback_delay=0.0)
        velocity = np.array([20.0, -15.0, 10.0, 30.0, -25.0, 40.0])  # [deg/s]
        for n in range(250):
            rig.step()
            wire.sendto(rig.datagram, rig.arm.client)
            received, state = client.receive_from_robot(timeout=2.0)
            assert received and state.motors_on and state.rapid_running and state.header.seqno == n
            assert client.send_to_robot(velocity * n * CYCLE, speed_ref=velocity)
            assert rig.arm.receive(*wire.recvfrom(2048), rig.now)
        # A ramp is followed with the dead time, the low-pass and the cycle between an answer and the next reading. The
        # position correction (1/s) has had 1 s to make up for what the speed reference missed at the start.
        lag = (velocity * 249 * CYCLE - state.joint_angles) / velocity
        np.testing.assert_allclose(lag, lag[0], atol=1e-9)
        assert 0.055 < lag[0] < 0.055 + 0.008 + 2 * CYCLE


class LossyLink:
    """Datagrams on their way: 20 % are lost, 20 % doubled, and delays of up to three cycles put them out of order."""

    def __init__(self, rng):
        self.rng, self.heap, self.count, self.cut = rng, [], 0, False

    def send(self, datagram, now):
        copies = 0 if self.cut or self.rng.random() < 0.2 else 1 + (self.rng.random() < 0.2)
        for _ in range(copies):
            self.count += 1
            heapq.heappush(self.heap, (now + self.rng.uniform(0.0002, 0.012), self.count, datagram))

    def arrived(self, now):
        while self.heap and self.heap[0][0] <= now:
            yield heapq.heappop(self.heap)


@pytest.mark.parametrize("seed", range(5))
def test_over_a_bad_network_the_arm_follows_and_without_one_it_stops(seed):
    rng = random.Random(seed)
    there, back = LossyLink(rng), LossyLink(rng)
    rig, session = Rig(comm_timeout=0.1), EgmSession(EgmConfig(CONTROLLER[0], timeout=0.1))
    amplitude, omega, numbers, errors = np.linspace(0.2, 0.6, 6), 2 * np.pi * 0.5, [], []

    def trajectory(t):
        return amplitude * (1 - np.cos(omega * t)), amplitude * omega * np.sin(omega * t)

    def run(cycles):
        for _ in range(cycles):
            rig.step()
            there.send(rig.datagram, rig.now)
            for tick in range(4):
                now = rig.now + tick * 0.001
                for _, _, datagram in there.arrived(now):
                    if session.receive(datagram, CONTROLLER, now):
                        numbers.append(session.feedback.sequence)
                        back.send(session.reply(*trajectory(now), now), now)
                for _, _, datagram in back.arrived(now):
                    rig.arm.receive(datagram, CLIENT, now)
            errors.append(rig.position - trajectory(rig.now - 0.055 - 0.008 - 0.016)[0])

    run(1000)
    statistics = session.statistics
    assert session.session_id == 1 and session.problem(rig.now) is None and rig.arm.cause is None
    assert numbers == sorted(set(numbers)) and len(numbers) == statistics.accepted == statistics.replies
    assert statistics.accepted + statistics.lost == numbers[-1] - numbers[0] + 1
    assert statistics.received == statistics.accepted + statistics.rejected.total()
    assert set(statistics.rejected) == {"duplicate", "out_of_order"}
    assert np.abs(errors[100:]).max() < 0.03  # of strokes up to 1.2 rad at up to 1.9 rad/s

    back.cut = True  # the answers no longer arrive: the controller stops and says so
    run(60)
    np.testing.assert_array_equal(rig.velocity, ZERO)
    assert "no message" in rig.arm.cause and "EGM is not running" in session.problem(rig.now)
    assert session.session_id == 2

    there.cut = True  # nothing arrives at all
    run(60)
    assert "No EGM packet" in session.problem(rig.now)
    there.cut = back.cut = False
    rig.arm.start_egm()
    run(10)
    assert session.session_id == 3 and session.problem(rig.now) is None
