"""The reference tracker clients in Python and C, against the receiving side over a real UDP socket."""

from __future__ import annotations

import ctypes
import math
import select
import shutil
import socket
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from examples.tracker.tracker_client import Frame, datagram
from robot_io.devices.ball_datagram import BallSample, decode
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.devices.udp import UdpSocket

HOME = "127.0.0.1"
SOURCES = Path(__file__).resolve().parents[2] / "examples" / "tracker"
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
SECONDS, FRAMES = 1.2, 150  # the synthetic ball's second round begins at 1 s


def random_frames(count: int, seed: int) -> list[Frame]:
    """Frames from the whole range of every field, its ends included."""
    random = np.random.default_rng(seed)
    ends = [Frame(0, 0, -(2**63), (-10.0, 10.0, -0.0)), Frame(2**32 - 1, 2**16 - 1, 2**63 - 1, (5e-324, 1e-300, 0.1))]
    for _ in range(count):
        sequence, ball = int(random.integers(2**32)), int(random.integers(2**16))
        captured_ns = int(random.integers(-(2**63), 2**63 - 1))
        position = tuple(float(x) for x in random.uniform(-10.0, 10.0, 3)) if random.random() < 0.8 else None
        ends.append(Frame(sequence, ball, captured_ns, position))
    return ends


class CFrame(ctypes.Structure):
    """struct tracker_frame."""

    _fields_ = [
        ("sequence", ctypes.c_uint32),
        ("ball", ctypes.c_uint16),
        ("captured_ns", ctypes.c_int64),
        ("seen", ctypes.c_int),
        ("position", ctypes.c_double * 3),
    ]


def compiled(folder: Path, *options: str) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: there is no program cc on the PATH")
    output = folder / "tracker_client"
    command = [compiler, *WARNINGS, "-O2", *options, "-o", str(output), str(SOURCES / "tracker_client.c")]
    built = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert built.returncode == 0, built.stderr
    return output


@pytest.fixture(scope="module")
def c_datagram(tmp_path_factory):
    """tracker_datagram of the C client: Frame to bytes, None where it refuses."""
    library = ctypes.CDLL(str(compiled(tmp_path_factory.mktemp("library"), "-shared", "-fPIC")))

    def call(frame: Frame) -> bytes | None:
        out = (ctypes.c_uint8 * 48)()
        position = frame.position or (9.0, 9.0, 9.0)  # must not matter where no ball is seen
        seen = frame.position is not None
        c_frame = CFrame(frame.sequence, frame.ball, frame.captured_ns, seen, (ctypes.c_double * 3)(*position))
        code = library.tracker_datagram(ctypes.byref(c_frame), out)
        assert code == 0 or not any(out)
        return bytes(out) if code == 0 else None

    return call


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Command of each client's program, by language."""

    def command(language: str) -> list[str]:
        if language == "python":
            return [sys.executable, "-I", "-S", str(SOURCES / "tracker_client.py")]  # standard library only
        return [str(compiled(tmp_path_factory.mktemp("program")))]

    return command


def test_both_clients_send_the_same_bytes_and_the_bridge_reads_what_was_meant(c_datagram):
    for frame in random_frames(1000, seed=1):
        sent = datagram(frame)
        assert c_datagram(frame) == sent and len(sent) == 48
        sample = decode(sent)
        assert (sample.sequence, sample.ball, sample.captured) == (
            frame.sequence,
            frame.ball,
            frame.captured_ns / 10**9,
        )
        assert (sample.position is None) == (frame.position is None)
        if frame.position is not None:
            assert tuple(sample.position) == frame.position


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 10.000001, -1e300])
@pytest.mark.parametrize("axis", range(3))
def test_positions_that_the_bridge_would_refuse_are_not_sent(c_datagram, bad, axis):
    position = [0.0, 1.0, 0.3]
    position[axis] = bad
    frame = Frame(1, 1, 0, tuple(position))
    assert c_datagram(frame) is None
    with pytest.raises(ValueError, match="finite"):
        datagram(frame)
    body = struct.pack("<4sBBHIq3d", b"TTBL", 1, 1, 1, 1, 0, *position)  # one that is sent nevertheless
    assert refusal(body + struct.pack("<I", zlib.crc32(body))) == "position"


def refusal(bad: bytes) -> str:
    """Count under which the bridge refuses a datagram between two good ones, which it accepts."""
    tracker = Tracker(TrackerConfig())
    good = [datagram(Frame(n, 1, n * 8_000_000, (0.0, 1.0, 0.3))) for n in (0, 2)]
    results = [tracker.receive(each, HOME, 0.02) for each in (good[0], bad, good[1])]
    assert results[0] is not None and results[1] is None and results[2] is not None
    (reason,) = set(tracker.counts) - {"accepted", "lost"}
    return reason


@pytest.mark.realtime
@pytest.mark.parametrize("language", ["python", "c"])
def test_a_program_sends_its_ball_to_the_bridge_in_real_time(programs, language):
    command = programs(language)
    receiver = UdpSocket("127.0.0.1", 0, "tracker")
    tracker = Tracker(TrackerConfig(oldest=1.0))  # a busy machine may read late
    received: list[tuple[BallSample, float]] = []
    try:
        with socket.fromfd(receiver.fileno(), socket.AF_INET, socket.SOCK_DGRAM) as bound:
            port = bound.getsockname()[1]
        began = time.monotonic()
        client = subprocess.Popen([*command, HOME, str(port), str(SECONDS)], stdout=subprocess.PIPE, text=True)
        try:
            while len(received) < FRAMES and time.monotonic() < began + 20.0:
                select.select([receiver], [], [], 0.2)
                for packet, (source, sender) in receiver.drain():
                    now = time.monotonic()
                    sample = tracker.receive(packet, source, now, sender)
                    assert sample is not None, tracker.counts
                    received.append((sample, now))
            lines = client.communicate(timeout=10.0)[0].splitlines()
        finally:
            client.kill()
            client.wait()
    finally:
        receiver.close()
    assert client.returncode == 0 and len(lines) == FRAMES
    assert tracker.counts["accepted"] == FRAMES and tracker.counts["lost"] == 0
    for n, ((sample, now), line) in enumerate(zip(received, lines, strict=True)):
        sequence, ball, captured_ns, *position = line.split()
        assert (sample.sequence, sample.ball, sample.captured) == (int(sequence), int(ball), int(captured_ns) / 10**9)
        assert began <= sample.captured <= now
        assert (sample.sequence, sample.ball) == (n, 0 if n < 38 else 1 if n < 163 else 2)  # 0.3 s are 37.5 frames
        if n % 125 < 38:
            assert sample.position is None and position == ["none"]
        else:
            assert [float(x) for x in position] == list(sample.position)
    captured = np.array([sample.captured for sample, _ in received])
    assert np.median(np.diff(captured)) == pytest.approx(0.008, abs=0.001)
    assert captured[-1] - captured[0] == pytest.approx((FRAMES - 1) / 125, abs=0.1)
    flight = np.array([sample.position for sample, _ in received[38:88]])  # before the bounce: a parabola
    t = np.arange(38, 88) / 125
    assert np.polyfit(t, flight[:, 2], 2)[0] == pytest.approx(-9.81 / 2)
    np.testing.assert_allclose(np.diff(flight[:, 1]), -5.0 / 125)
    assert min(sample.position[2] for sample, _ in received[38:125]) >= 0.0195  # the ball stays above the table
