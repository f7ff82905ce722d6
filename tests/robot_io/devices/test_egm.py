"""EGM at the computer's end: wire bytes worked out by hand, whom and what to believe, one answer per packet."""

from __future__ import annotations

import random
import struct
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from google.protobuf import descriptor_pb2

from robot_io.devices.egm import messages
from robot_io.devices.egm.messages import EgmError, decode_robot, decode_sensor, encode_robot, encode_sensor
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.udp import UdpSocket
from robot_io.errors import DeviceError
from tests.support.damaged_egm import damage

CONTROLLER = ("192.168.125.1", 50123)
DEGREES = np.array([90.0, -45.0, 180.0, 1.0, 0.5, 0.0])
# IEEE 754 doubles, little-endian, each behind the tag 09 (field 1, 64 bit): 6 x 9 = 54 = 0x36 bytes
JOINTS = bytes.fromhex(
    "09 00 00 00 00 00 80 56 40"  # 90
    "09 00 00 00 00 00 80 46 c0"  # -45
    "09 00 00 00 00 00 80 66 40"  # 180
    "09 00 00 00 00 00 00 f0 3f"  # 1
    "09 00 00 00 00 00 00 e0 3f"  # 0.5
    "09 00 00 00 00 00 00 00 00"  # 0
)
HEADER = bytes.fromhex("0a 08  08 80 01  10 ac 02  18")  # field 1, 8 bytes: seqno 128, tm 300, mtype (value follows)
DATA, CORRECTION = b"\x02", b"\x03"
# motors on, MCI running, not converged, RAPID running
STATES = bytes.fromhex("22 02 08 01  2a 02 08 03  30 00  42 02 08 02")
FEEDBACK = b"\x12\x38\x0a\x36" + JOINTS  # field 2: 56 bytes, within it joints: 54 bytes
PLANNED = b"\x1a\x38\x0a\x36" + JOINTS  # field 3 of EgmRobot
ROBOT = HEADER + DATA + FEEDBACK + PLANNED + STATES
SENSOR = HEADER + CORRECTION + b"\x12\x38\x0a\x36" + JOINTS + b"\x1a\x38\x0a\x36" + JOINTS  # planned 2, speedRef 3


STILL = np.zeros(6)


def packet(sequence, time=None, position=STILL, motors=True, egm=True, rapid=True):
    time_ms = sequence * 4 if time is None else round(time * 1000)
    return encode_robot(sequence, time_ms, position, position, motors, egm, rapid)


def connected(now=0.0, **config):
    """A session that has accepted packet 100 at ``now``."""
    session = EgmSession(EgmConfig(**config))
    assert session.receive(packet(100), CONTROLLER, now)
    return session


# Bytes on the wire


def test_robot_message_is_read_from_bytes_worked_out_by_hand():
    message = decode_robot(ROBOT)
    assert (message.sequence, message.time) == (128, 0.3)
    assert (message.motors_on, message.egm_running, message.rapid_running) == (True, True, True)
    radians = [np.pi / 2, -np.pi / 4, np.pi, np.pi / 180, np.pi / 360, 0]
    np.testing.assert_allclose(message.position, radians, rtol=1e-15)


def test_robot_message_is_written_as_those_bytes():
    radians = np.deg2rad(DEGREES)
    assert encode_robot(128, 300, radians, radians, True, True, True) == ROBOT


def test_sensor_message_is_read_and_written_as_bytes_worked_out_by_hand():
    radians = np.deg2rad(DEGREES)
    assert encode_sensor(128, 300, radians, radians) == SENSOR
    message = decode_sensor(SENSOR)
    assert message.sequence == 128
    np.testing.assert_array_equal(message.position, radians)
    np.testing.assert_array_equal(message.velocity, radians)


def test_packed_joints_are_read_too():
    packed = bytes([0x0A, 48]) + b"".join(struct.pack("<d", d) for d in DEGREES)  # one field of 48 bytes
    message = decode_robot(HEADER + DATA + bytes([0x12, 52, 0x0A, 50]) + packed + STATES)
    np.testing.assert_array_equal(message.position, np.deg2rad(DEGREES))


@pytest.mark.parametrize(
    ("states", "expected"),
    [
        ("22 02 08 02  2a 02 08 03  42 02 08 02", (False, True, True)),  # motors off
        ("22 02 08 00  2a 02 08 03  42 02 08 02", (False, True, True)),  # motors undefined
        ("22 02 08 01  2a 02 08 01  42 02 08 02", (True, False, True)),  # MCI error
        ("22 02 08 01  2a 02 08 02  42 02 08 02", (True, False, True)),  # MCI stopped
        ("22 02 08 01  2a 02 08 03  42 02 08 01", (True, True, False)),  # RAPID stopped
        ("22 02 08 01  2a 02 08 03  42 02 08 00", (True, True, True)),  # RAPID undefined: reported while it runs
    ],
)
def test_states(states, expected):
    message = decode_robot(HEADER + DATA + FEEDBACK + bytes.fromhex(states))
    assert (message.motors_on, message.egm_running, message.rapid_running) == expected


FIVE_JOINTS = b"\x12\x2f\x0a\x2d" + JOINTS[:45]
NAN_JOINTS = b"\x12\x38\x0a\x36" + b"\x09" + struct.pack("<d", np.nan) + JOINTS[9:]
HUGE_JOINTS = b"\x12\x38\x0a\x36" + b"\x09" + struct.pack("<d", np.inf) + JOINTS[9:]


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"", "incomplete"),  # a valid message to protobuf
        (FEEDBACK + STATES, "incomplete"),
        (HEADER + DATA + STATES, "incomplete"),
        (HEADER + DATA + b"\x12\x00" + STATES, "incomplete"),  # feedBack without joints
        (HEADER + DATA + FEEDBACK, "incomplete"),
        (HEADER + DATA + FEEDBACK + STATES[:10], "incomplete"),  # no RAPID state
        (HEADER + DATA + FEEDBACK + b"\x22\x02\x08\x09" + STATES[4:], "incomplete"),  # no such motor state
        (HEADER + DATA + FEEDBACK + b"\x22\x00" + STATES[4:], "incomplete"),  # a motor state message without its state
        (bytes.fromhex("0a 05 08 80 01 18 02") + FEEDBACK + STATES, "incomplete"),  # no time
        (HEADER + CORRECTION + FEEDBACK + STATES, "wrong_type"),
        (HEADER + DATA + FIVE_JOINTS + STATES, "joint_count"),
        (HEADER + DATA + FEEDBACK + FEEDBACK + STATES, "joint_count"),  # protobuf merges the two into twelve joints
        (HEADER + DATA + NAN_JOINTS + STATES, "not_finite"),
        (HEADER + DATA + HUGE_JOINTS + STATES, "not_finite"),
        (ROBOT[:-1], "malformed"),
        (b"\xff" * 40, "malformed"),
        (ROBOT + b"\x3a\xff\x0b" + bytes(1535), "oversized"),
    ],
)
def test_what_is_not_a_complete_robot_message_is_refused_by_name(datagram, reason):
    with pytest.raises(EgmError) as error:
        decode_robot(datagram)
    assert error.value.reason == reason
    session = EgmSession()
    assert not session.receive(datagram, CONTROLLER, 0.0)
    assert session.statistics.rejected == {reason: 1}
    assert session.feedback is None and session.endpoint is None
    assert session.reply(np.zeros(6), np.zeros(6), 0.0) is None


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"", "incomplete"),
        (SENSOR[:68], "incomplete"),  # no speeds: cut where planned ends
        (SENSOR[:10] + SENSOR[68:], "incomplete"),  # no positions
        (SENSOR[:68] + b"\x1a\x00", "incomplete"),  # speedRef without joints
        (HEADER + DATA + SENSOR[10:], "wrong_type"),
        (SENSOR[:-1], "malformed"),
    ],
)
def test_what_is_not_a_complete_sensor_message_is_refused_by_name(datagram, reason):
    with pytest.raises(EgmError) as error:
        decode_sensor(datagram)
    assert error.value.reason == reason


# Sequence and session


def test_feedback_of_a_packet():
    session = EgmSession(EgmConfig("192.168.125.1"))
    assert session.receive(ROBOT, CONTROLLER, 7.0)
    feedback = session.feedback
    assert (feedback.sequence, feedback.time, feedback.received) == (128, 0.3, 7.0)
    np.testing.assert_array_equal(feedback.position, np.deg2rad(DEGREES))
    assert session.endpoint == CONTROLLER and session.session_id == 1
    with pytest.raises(FrozenInstanceError):
        feedback.sequence = 1
    with pytest.raises(ValueError):
        feedback.position[0] = 1.0


def test_duplicates_and_overtaken_packets_are_refused_and_gaps_counted():
    session = connected()
    accepted = [session.receive(packet(n), CONTROLLER, 0.004) for n in (101, 101, 104, 102, 103, 105, 100)]
    assert accepted == [True, False, True, False, False, True, False]
    assert session.statistics.rejected == {"duplicate": 1, "out_of_order": 3}
    assert session.statistics.lost == 2  # 102 and 103 had not arrived when 104 did
    assert session.feedback.sequence == 105 and session.session_id == 1


def test_sequence_and_time_wrap_around():
    session, top = EgmSession(), 2**32
    for i, n in enumerate((top - 2, top - 1, 0, 2, 1)):
        datagram = encode_robot(n, n * 4, np.zeros(6), np.zeros(6), True, True, True)
        assert session.receive(datagram, CONTROLLER, i * 0.004) == (n != 1)
    assert session.session_id == 1 and session.statistics.lost == 1
    assert session.statistics.rejected == {"out_of_order": 1}


def test_a_time_that_stands_still_leaves_the_order_to_the_numbers():
    session = EgmSession()
    assert [session.receive(packet(n, time=0.0), CONTROLLER, 0.0) for n in (10, 11, 11, 9, 13)] == [1, 1, 0, 0, 1]
    assert session.session_id == 1 and session.statistics.lost == 1


@pytest.mark.parametrize(
    ("datagram", "now"),
    [
        (packet(0, time=0.404), 0.004),  # numbers begin anew, the controller's clock goes on
        (packet(101), 0.051),  # silent for longer than the timeout
        (packet(5000), 0.004),  # jump ahead
        (packet(101, time=2.0), 0.004),  # the controller's clock jumps
        (packet(0, time=4294966.0), 0.004),  # back by 1.7 s through zero: another clock, not an overtaken packet
        (packet(0, time=0.0), 1.5),  # the controller has been switched off and on
        (packet(101, motors=False), 0.004),
        (packet(101, egm=False), 0.004),
        (packet(101, rapid=False), 0.004),
    ],
)
def test_a_new_session_is_told_to_the_owner(datagram, now):
    session = connected()
    assert session.receive(datagram, CONTROLLER, now)
    assert session.session_id == 2 and session.statistics.lost == 0


def test_a_late_packet_of_the_session_before_is_refused():
    session = connected()
    assert session.receive(packet(0, time=0.410), CONTROLLER, 0.010)
    assert not session.receive(packet(101), CONTROLLER, 0.011)  # sequence 101 at 0.404 s of the controller's clock
    assert session.receive(packet(1, time=0.414), CONTROLLER, 0.014)
    assert session.session_id == 2


# Whom to trust


def test_strangers_are_refused_and_answered_by_nobody():
    session = EgmSession(EgmConfig("192.168.125.1"))
    assert not session.receive(ROBOT, ("192.168.125.66", 50123), 0.0)
    assert session.endpoint is None and session.reply(np.zeros(6), np.zeros(6), 0.0) is None
    assert session.receive(ROBOT, CONTROLLER, 0.0)
    assert not session.receive(packet(129), (CONTROLLER[0], 6666), 0.001)  # another program on the same machine
    assert session.statistics.rejected == {"stranger": 2} and session.endpoint == CONTROLLER


def test_the_first_valid_sender_is_kept_where_no_address_is_configured():
    session = EgmSession()
    assert not session.receive(b"", ("10.0.0.9", 1), 0.0)  # garbage teaches nothing
    assert session.receive(ROBOT, CONTROLLER, 0.0)
    assert not session.receive(packet(129), ("10.0.0.9", 1), 5.0)  # not even after a silence


def test_the_port_is_learned_again_after_a_silence():
    session, restarted = connected(), (CONTROLLER[0], 50999)
    assert not session.receive(packet(101), restarted, 0.050)
    assert session.receive(packet(101), restarted, 0.051)
    assert session.endpoint == restarted and session.session_id == 2


@pytest.mark.parametrize(
    "wrong", [{"controller_address": "robot"}, {"timeout": 0.004}, {"period": 0.0}, {"timeout": 2.0}]
)
def test_config_says_what_is_wrong(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        EgmConfig(**wrong)


# Answers


def test_each_accepted_packet_is_answered_once():
    session = EgmSession()
    assert session.reply(np.zeros(6), np.zeros(6), 0.0) is None
    for n in range(100, 105):  # a burst: only the newest is answered
        session.receive(packet(n), CONTROLLER, 0.0)
    radians = np.deg2rad(DEGREES)
    first = session.reply(radians, radians, 0.003)
    assert first == bytes.fromhex("0a 06  08 00  10 03  18 03") + SENSOR[10:]  # sequence 0, 3 ms
    assert session.reply(radians, radians, 0.003) is None
    session.receive(packet(105), CONTROLLER, 0.004)
    second = session.reply(radians, radians, 0.004)
    assert second == bytes.fromhex("0a 06  08 01  10 04  18 03") + SENSOR[10:]
    assert session.statistics.replies == 2


@pytest.mark.parametrize(
    "wrong", [np.full(6, np.nan), np.array([0, 0, np.inf, 0, 0, 0]), np.full(6, 1e308), np.zeros(5)]
)
def test_numbers_that_are_no_command_are_never_sent(wrong):
    session = connected()
    for position, velocity in ((wrong, np.zeros(6)), (np.zeros(6), wrong)):
        with pytest.raises(ValueError, match=r"non-finite|shape"):
            session.reply(position, velocity, 0.0)
    hold = decode_sensor(session.reply(np.ones(6), np.zeros(6), 0.0))  # the packet still waits for its answer
    np.testing.assert_allclose(hold.position, np.ones(6), rtol=1e-15)
    np.testing.assert_array_equal(hold.velocity, np.zeros(6))


def test_a_packet_that_waited_too_long_is_not_answered():
    session = connected()
    assert session.reply(np.zeros(6), np.zeros(6), 0.051) is None
    assert session.statistics.replies == 0


@pytest.mark.parametrize(
    ("state", "words"),
    [({"motors": False}, "motors are off"), ({"egm": False}, "EGM is not"), ({"rapid": False}, "RAPID")],
)
def test_problems_name_their_cause(state, words):
    session = EgmSession(EgmConfig("192.168.125.1"))
    session.receive(b"", CONTROLLER, 0.0)
    assert "No EGM packet has arrived" in session.problem(0.0) and "1 datagrams were refused" in session.problem(0.0)
    session.receive(packet(1), CONTROLLER, 0.0)
    assert session.problem(0.05) is None
    assert "for 0.060 s" in session.problem(0.06)
    session.receive(packet(2, **state), CONTROLLER, 0.004)
    assert words in session.problem(0.004)


# Mutations


def frame(i):
    """``ROBOT`` with sequence and time i in two bytes each, so that every frame is newer than the one before."""
    varint = bytes([0x80 | (i & 0x7F), i >> 7 & 0x7F])
    return b"\x0a\x08\x08" + varint + b"\x10" + varint + b"\x18\x02" + ROBOT[10:]


# Offsets of the measured and the planned joint positions
MEASURED, PLANNED_AT = ([start + 1 + 9 * i for i in range(6)] for start in (14, 72))
NUMBERS = {3, 4, 6, 7}  # sequence and time


def test_100000_mutated_datagrams():
    rng, session, now = random.Random(1), EgmSession(EgmConfig("192.168.125.1")), 0.0
    payload = {at + i for at in MEASURED + PLANNED_AT for i in range(8)}
    plain = [i for i in range(len(ROBOT)) if i not in payload | NUMBERS]
    expected = np.deg2rad(DEGREES)
    for i in range(100_000):
        now += 2.0  # so long that order does not hide what the codec would let through
        kind, source = i % 8, ("192.168.125.2", CONTROLLER[1]) if i % 8 == 3 else CONTROLLER
        data = damage(rng, kind, frame(i % 16384), MEASURED, plain, (np.nan, np.inf, -np.inf))
        taken = session.receive(data, source, now)
        if taken:
            assert kind >= 4 and session.endpoint == CONTROLLER
            assert session.feedback.position.shape == (6,) and np.isfinite(session.feedback.position).all()
            if kind in (4, 5):
                np.testing.assert_array_equal(session.feedback.position, expected)
        elif kind < 4:
            assert session.reply(expected, expected, now) is None
    statistics = session.statistics
    assert statistics.received == 100_000 == statistics.accepted + statistics.rejected.total()
    assert statistics.rejected["stranger"] == 12_500
    reasons = ("malformed", "incomplete", "not_finite", "joint_count", "wrong_type")
    assert min(statistics.rejected[reason] for reason in reasons) > 10
    assert session.receive(ROBOT, CONTROLLER, now + 2)  # and it still works


# Sockets and another implementation


def test_only_the_newest_of_what_is_queued_is_answered():
    ours, controller, stranger = (UdpSocket("127.0.0.1", 0, "arm") for _ in range(3))
    with ours, controller, stranger:
        session = EgmSession(EgmConfig("127.0.0.1"))

        def drain():
            return any([session.receive(*packet, 0.0) for packet in ours.drain()])

        assert ours.fileno() >= 0 and not drain()
        for n in range(20):
            assert controller.send(packet(n), ours.address)
        stranger.send(packet(20), ours.address)
        assert drain()
        assert session.feedback.sequence == 19 and session.endpoint == controller.address
        assert session.statistics.rejected == {"stranger": 1}
        assert ours.send(session.reply(np.zeros(6), np.zeros(6), 0.0), session.endpoint)
        assert session.reply(np.zeros(6), np.zeros(6), 0.0) is None


def test_sockets_that_cannot_be_opened_say_what_to_do():
    with UdpSocket("127.0.0.1", 0, "arm") as first:
        with pytest.raises(DeviceError, match="cannot listen on .* in use.* end the program .* arm.port"):
            UdpSocket(*first.address, "arm")
    with pytest.raises(DeviceError, match="another of this computer's addresses"):
        UdpSocket("192.0.2.1", 0, "arm")  # reserved for documentation
    with pytest.raises(DeviceError, match="port"):
        UdpSocket("127.0.0.1", 70000, "arm")


def test_sending_into_nowhere_is_counted():
    with UdpSocket("127.0.0.1", 0, "arm") as ours:
        assert not ours.send(b"x" * 100_000, ("127.0.0.1", 9))  # larger than any UDP datagram
        assert ours.network_errors == 1


def test_another_library_reads_what_we_send():
    egm_pb2 = pytest.importorskip("ABBRobotEGM._egm_protobuf.egm_pb2")
    robot = egm_pb2.EgmRobot()
    robot.header.seqno, robot.header.tm, robot.header.mtype = 7, 28, egm_pb2.EgmHeader.MSGTYPE_DATA
    robot.feedBack.joints.joints.extend(DEGREES)
    robot.motorState.state = egm_pb2.EgmMotorState.MOTORS_ON
    robot.mciState.state = egm_pb2.EgmMCIState.MCI_RUNNING
    robot.rapidExecState.state = egm_pb2.EgmRapidCtrlExecState.RAPID_RUNNING
    robot.RAPIDfromRobot.dnum.extend([1.0, 2.0])
    session = EgmSession()
    assert session.receive(robot.SerializeToString(), CONTROLLER, 12.3) and session.problem(12.3) is None
    np.testing.assert_array_equal(session.feedback.position, np.deg2rad(DEGREES))
    velocity = np.array([4.0, -3.0, 2.0, -1.0, 0.5, 0.0])
    sensor = egm_pb2.EgmSensor.FromString(session.reply(session.feedback.position, velocity, 12.345))
    assert (sensor.header.seqno, sensor.header.tm) == (0, 12345)
    assert sensor.header.mtype == egm_pb2.EgmHeader.MSGTYPE_CORRECTION
    np.testing.assert_array_equal(sensor.planned.joints.joints, DEGREES)
    np.testing.assert_allclose(sensor.speedRef.joints.joints, velocity * 180 / np.pi, rtol=1e-15)


def test_the_schema_is_that_of_another_library():
    egm_pb2 = pytest.importorskip("ABBRobotEGM._egm_protobuf.egm_pb2")

    def schema(descriptor):
        proto = descriptor_pb2.DescriptorProto()
        descriptor.CopyToProto(proto)
        fields = {(f.name, f.number, f.label, f.type, f.type_name) for f in proto.field}
        return fields, {(e.name, v.name, v.number) for e in proto.enum_type for v in e.value}

    for name, theirs in egm_pb2.DESCRIPTOR.message_types_by_name.items():
        if name != "EgmExternalJoints":  # which no message uses
            assert schema(messages.message_class(name).DESCRIPTOR) == schema(theirs), name


def test_two_senders_at_the_controllers_address_are_a_problem_and_a_named_port_settles_it():
    """Whichever came first: the wrong one may be it."""
    other = CONTROLLER[0], 6666
    session = EgmSession(EgmConfig(CONTROLLER[0]))
    assert session.receive(packet(100), other, 0.0)
    assert session.problem(0.0) is None
    assert not session.receive(packet(100), CONTROLLER, 0.001)
    assert f"ports 6666 and {CONTROLLER[1]}" in session.problem(0.002)
    assert "arm.controller_port" in session.problem(0.002)
    for n in range(300):
        assert session.receive(packet(101 + n), other, 0.004 + 0.004 * n)
    assert session.problem(1.2) is None  # over, a second after the last
    assert not session.receive(b"\0", CONTROLLER, 1.2) and session.problem(1.2) is None  # garbage is no sender
    session = EgmSession(EgmConfig(CONTROLLER[0], CONTROLLER[1]))
    assert not session.receive(packet(100), other, 0.0)
    assert session.receive(packet(100), CONTROLLER, 0.001) and session.problem(0.001) is None
    assert not session.receive(packet(101), other, 1.0)  # not even after a silence
