"""Captures of EGM over real sockets, written by scapy, read and played to the emulated controller."""

from __future__ import annotations

import socket

import numpy as np
import pytest
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import Raw
from scapy.utils import PcapNgWriter, PcapWriter

from experiments.commands.log import log
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.emulator.arm import ArmController, ArmParams
from robot_io.emulator.capture import read, replay

BEGAN, CYCLE = 1.7e9, 0.004
PARAMS = ArmParams(ramp_in=0.0, comm_timeout=0.1)


@pytest.fixture(scope="module")
def session():
    """Two seconds of an emulated arm that swings all joints: (time, from, to, datagram) on the wire, and its places."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
        each.settimeout(5.0)
    (controller, computer), (here, there) = sockets, [each.getsockname() for each in sockets]
    arm, bridge = ArmController(there, PARAMS), EgmSession(EgmConfig())
    arm.motors_on()
    arm.start_rapid()
    arm.start_egm()
    wire, q, velocity = [], np.array([0.1, 0.2, -0.3, 0.4, 0.5, -0.6]), np.zeros(6)
    for n in range(500):
        now = BEGAN + CYCLE * n
        velocity, datagram = arm.step(now, q, velocity)
        controller.sendto(datagram, there)
        got, source = computer.recvfrom(2000)
        wire.append((now, source, there, got))
        assert bridge.receive(got, source, now)
        phase = 4.0 * CYCLE * n
        computer.sendto(bridge.reply(0.3 * np.sin(phase) * np.ones(6), 1.2 * np.cos(phase) * np.ones(6), now), source)
        got, source = controller.recvfrom(2000)
        wire.append((now + 0.0005, source, here, got))
        arm.receive(got, source, now + 0.0005)
        q = q + velocity * CYCLE
    for each in sockets:
        each.close()
    return wire


def written(path, wire, writer):
    with writer(str(path)) as file:
        for now, source, to, payload in wire:
            packet = Ether() / IP(src=source[0], dst=to[0]) / UDP(sport=source[1], dport=to[1]) / Raw(payload)
            packet.time = now
            file.write(packet)
    return path


@pytest.mark.parametrize("writer", [PcapWriter, PcapNgWriter])
def test_a_captured_session_replayed_on_the_same_controller_goes_where_it_went(session, tmp_path, writer):
    wire = [*session[:100], (session[100][0], *session[100][1:3], b"no EGM"), *session[100:]]
    capture = read(written(tmp_path / "arm.pcap", wire, writer))
    assert len(capture.feedback) == len(capture.replies) == 500 and capture.skipped == 1 and not capture.lost
    went = capture.positions
    assert np.ptp(went, axis=0).min() > 0.3
    np.testing.assert_allclose(replay(capture, PARAMS), went, rtol=0, atol=1e-5)  # of a time stamp's microsecond
    other = replay(capture, ArmParams(ramp_in=0.0, comm_timeout=0.1, dead_time=0.095))
    assert np.abs(other - went).max() > 0.02


def test_the_command_says_how_the_controller_differs_from_the_emulated_one(session, tmp_path, capsys):
    path = written(tmp_path / "arm.pcap", [row for i, row in enumerate(session) if i not in (20, 22)], PcapWriter)
    assert log("replay", path, out=tmp_path / "arm.csv") == 0
    text = capsys.readouterr().out
    assert "498 packets of the controller, 2 lost" in text and "every 4.0 ms" in text
    table = np.loadtxt(tmp_path / "arm.csv", delimiter=",", skiprows=1)
    assert table.shape == (498, 13)
    np.testing.assert_allclose(table[:, 1:7], read(path).positions, rtol=0, atol=1e-9)


def test_what_is_no_capture_of_an_arm_is_refused(session, tmp_path):
    path = tmp_path / "other.pcap"
    path.write_bytes(b"text")
    with pytest.raises(ValueError, match="expected a capture"):
        read(path)
    written(path, session[1::2], PcapWriter)
    with pytest.raises(ValueError, match="expected an arm's EGM feedback, got 0 other packets"):
        read(path)
