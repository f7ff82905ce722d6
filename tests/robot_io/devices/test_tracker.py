"""The tracker's datagrams and what is believed of them."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from robot_io.calibrated import Calibration, TrackerCalibration
from robot_io.devices.ball_datagram import SIZE, BallSample, decode, encode
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.emulator.network import Network, NetworkFaults
from robot_io.emulator.tracker import TrackerEmulator, TrackerParams

HOME = "127.0.0.1"
# Frame 0x01020304 of ball 7, captured at 1.5 s, at (0.5, -1.25, 0.25) m, written down byte by byte.
GOLDEN = bytes.fromhex("5454424c0101070004030201002f685900000000000000000000e03f000000000000f4bf000000000000d03f")


def crc32(data: bytes) -> int:
    """CRC-32 bit by bit: reflected polynomial EDB88320, start and end inverted."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def golden() -> bytes:
    return GOLDEN + crc32(GOLDEN).to_bytes(4, "little")


def frame(sequence, captured, ball=1, position=(0.0, 1.0, 0.3)) -> bytes:
    return encode(BallSample(sequence, ball, captured, None if position is None else np.array(position)))


def resealed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def test_golden_bytes():
    sample = decode(golden())
    assert (sample.sequence, sample.ball, sample.captured) == (0x01020304, 7, 1.5)
    np.testing.assert_array_equal(sample.position, [0.5, -1.25, 0.25])
    assert encode(sample) == golden() and len(golden()) == SIZE == 48
    empty = bytes.fromhex("5454424c0100070004030201002f685900000000") + bytes(24)
    assert decode(empty + crc32(empty).to_bytes(4, "little")).position is None
    assert encode(BallSample(0x01020304, 7, 1.5, None)) == empty + crc32(empty).to_bytes(4, "little")


def moving(velocity=(0.25, -4.0, 1.0), spread=1.0) -> BallSample:
    covariance = np.diag([1e-6, 1e-6, 4e-6, 0.0625, 0.0625, 0.25]) * spread
    covariance[0, 3] = covariance[3, 0] = 1e-4
    return BallSample(5, 7, 1.5, np.array([0.5, -1.25, 0.25]), np.array(velocity), covariance)


def test_golden_bytes_of_the_second_version():
    body = bytes.fromhex("5454424c0201070005000000002f685900000000") + GOLDEN[20:]
    body += struct.pack("<3d", 0.25, -4.0, 1.0)
    rows = [[1e-6, 0, 0, 1e-4, 0, 0], [1e-6, 0, 0, 0, 0], [4e-6, 0, 0, 0], [0.0625, 0, 0], [0.0625, 0], [0.25]]
    body += struct.pack("<21f", *(number for row in rows for number in row))
    datagram = body + crc32(body).to_bytes(4, "little")
    assert encode(moving()) == datagram and len(datagram) == 156
    sample = decode(datagram)
    np.testing.assert_array_equal(sample.velocity, [0.25, -4.0, 1.0])
    np.testing.assert_allclose(sample.covariance, moving().covariance, rtol=1e-7)


@pytest.mark.parametrize(
    "datagram, reason",
    [
        (resealed(encode(moving())[:5] + b"\x00" + encode(moving())[6:-4]), "format"),
        (resealed(encode(moving())[:4] + b"\x01" + encode(moving())[5:-4]), "format"),
        (encode(moving((50.0, 0.0, 0.0))), "velocity"),
        (encode(moving(spread=-1.0)), "covariance"),
        (encode(moving(spread=1e-9)), "covariance"),  # the correlation is more than one
        (encode(moving())[:-1], "size"),
        (encode(moving())[:-5] + b"\x01" + encode(moving())[-4:], "checksum"),
    ],
)
def test_impossible_motions_are_refused(datagram, reason):
    with pytest.raises(ValueError, match=reason):
        decode(datagram)


def test_the_bridge_s_track_takes_both_versions_and_turns_motions_into_the_table_s_frame():
    turned = TrackerCalibration((0.1, 0.0, 0.0), (0.0, 0.0, np.pi / 2), 0.001, 9, "2026-01-01")
    tracker = Tracker(TrackerConfig(), Calibration(tracker=turned))
    assert tracker.receive(frame(4, 1.492, 7, (0.5, -1.2, 0.25)), HOME, 1.5) is not None
    sample = tracker.receive(encode(moving()), HOME, 1.51)
    assert sample.position == pytest.approx([1.35, 0.5, 0.25], abs=1e-6)
    assert sample.velocity == pytest.approx([4.0, 0.25, 1.0], abs=1e-6)
    assert sample.covariance[1, 4] == pytest.approx(1e-4, rel=1e-3)
    assert tracker.counts["accepted"] == 2 and tracker.counts["lost"] == 0


@pytest.mark.parametrize("place, value", [(0, b"X"), (4, b"\x02"), (5, b"\x02"), (5, b"\x81"), (5, b"\x00")])
def test_another_format_is_refused_in_spite_of_a_good_checksum(place, value):
    with pytest.raises(ValueError, match="format|position"):
        decode(resealed(GOLDEN[:place] + value + GOLDEN[place + 1 :]))


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 11.0, -1e300])
def test_impossible_positions_are_refused(number):
    for place in (20, 28, 36):
        with pytest.raises(ValueError, match="position"):
            decode(resealed(GOLDEN[:place] + struct.pack("<d", number) + GOLDEN[place + 8 :]))
    with pytest.raises(ValueError, match="position"):
        decode(frame(0, 0.0, position=(number, 0, 0)))


def test_what_is_refused_is_counted_and_changes_nothing():
    tracker, now = Tracker(TrackerConfig()), 50.0
    assert tracker.receive(frame(10, now), HOME, now) is not None
    state = tracker.received, tracker.seen, tracker.newest, len(tracker.track)
    bad = bytearray(frame(11, now + 0.008))
    bad[30] ^= 1
    for datagram, source, when, reason in (
        (frame(11, now + 0.008), "192.168.0.9", now + 0.01, "stranger"),
        (bytes(bad), HOME, now + 0.01, "checksum"),
        (b"", HOME, now + 0.01, "size"),
        (golden() + b"\0", HOME, now + 0.01, "size"),
        (frame(11, now + 0.008), HOME, now + 0.008 + 0.151, "stale"),
        (frame(11, now + 0.008), HOME, now + 0.008 - 0.006, "future"),
        (frame(10, now), HOME, now + 0.01, "duplicate"),
        (frame(9, now - 0.008), HOME, now + 0.01, "out of order"),
        (frame(11, now), HOME, now + 0.01, "out of order"),  # a clock that stands still
        (frame(12, now - 0.008), HOME, now + 0.01, "out of order"),  # or goes back
    ):
        before = tracker.counts[reason]
        assert tracker.receive(datagram, source, when) is None
        assert tracker.counts[reason] == before + 1, reason
        assert (tracker.received, tracker.seen, tracker.newest, len(tracker.track)) == state
    assert tracker.receive(frame(11, now + 0.008), HOME, now + 0.023) is not None
    assert tracker.seen == pytest.approx(now + 0.008) and tracker.received == now + 0.023


def test_sequence_wraps_around_and_gaps_are_counted():
    tracker = Tracker(TrackerConfig())
    for i, sequence in enumerate([2**32 - 2, 2**32 - 1, 0, 1, 5]):
        assert tracker.receive(frame(sequence, 1 + i * 0.008), HOME, 1.001 + i * 0.008)
    assert tracker.counts["lost"] == 3 and tracker.counts["accepted"] == 5
    assert tracker.receive(frame(2**32 - 1, 1.05), HOME, 1.05) is None  # from before the wrap


def test_a_tracker_started_anew_is_heard_again_after_a_second_of_silence():
    tracker = Tracker(TrackerConfig())
    tracker.receive(frame(5000, 1.0), HOME, 1.0)
    assert tracker.receive(frame(0, 1.9), HOME, 1.9) is None
    assert tracker.receive(frame(1, 2.1), HOME, 2.1) is not None
    assert tracker.receive(frame(2, 2.108), HOME, 2.11) is not None


def test_a_new_ball_has_a_track_of_its_own_and_empty_frames_keep_the_old_one():
    tracker = Tracker(TrackerConfig())
    for i in range(5):
        tracker.receive(frame(i, i * 0.008, 1), HOME, i * 0.008)
    tracker.receive(frame(5, 0.04, 1, None), HOME, 0.04)
    assert len(tracker.track) == 5 and tracker.seen == 0.032 and tracker.received == 0.04
    tracker.receive(frame(6, 0.048, 2, (0.1, 0.2, 0.3)), HOME, 0.05)
    assert len(tracker.track) == 1 and tracker.ball == 2
    np.testing.assert_array_equal(tracker.track.at(0.0), [0.1, 0.2, 0.3])


def test_the_clocks_difference_is_taken_into_account():
    tracker = Tracker(TrackerConfig(clock_offset=-1000.0))
    assert tracker.receive(frame(0, 1005.0), HOME, 5.015).captured == pytest.approx(5.0)
    assert Tracker(TrackerConfig()).receive(frame(0, 1005.0), HOME, 5.015) is None


def test_damaged_datagrams_are_never_taken():
    random = np.random.default_rng(0)
    valid = [frame(i, i * 0.008, i // 200, random.uniform(-0.1, 0.1, 3)) for i in range(1000)]
    known, taken = set(valid), 0
    tracker = Tracker(TrackerConfig(oldest=1e9, ahead=1e9))
    kinds, places, bits = (
        random.integers(5, size=100_000),
        random.integers(48, size=(100_000, 3)),
        random.integers(8, size=100_000),
    )
    for i in range(100_000):
        data = bytearray(valid[i % 1000])
        place, other, third = places[i]
        if kinds[i] == 0:
            data[place] ^= 1 << bits[i]
        elif kinds[i] == 1:
            data[place], data[other], data[third] = data[other], data[third], data[place]
        elif kinds[i] == 2:
            del data[place:]
        elif kinds[i] == 3:
            data[min(place, other) : max(place, other)] = random.bytes(abs(int(place) - int(other)))
        else:
            data = data + data[:place]
        if tracker.receive(bytes(data), HOME, i * 1e-4) is not None:
            taken += 1
            assert bytes(data) in known
    assert tracker.counts.total() - tracker.counts["lost"] == 100_000
    assert 0 < taken < 100_000 / 10  # swaps that changed nothing


def test_a_bad_network_leaves_the_track_in_order():
    faults = NetworkFaults(
        loss=0.2, duplication=0.2, reordering=0.3, hold=0.02, bit_flip=0.05, delay=0.002, jitter=0.004
    )
    network, tracker = Network(faults, 3), Tracker(TrackerConfig())
    cameras, sent, times = TrackerEmulator(TrackerParams(noise=0.0), 1), {}, []
    for i in range(8000):
        now = i * 0.001
        if i % 8 == 0:
            truth = np.array([0.1, 1.0 - now / 10, 0.3])
            sent[round(now, 9)] = truth
            cameras.step(now, 1, truth)
        for datagram in cameras.due(now):
            network.send(datagram, now)
        for datagram in network.due(now):
            sample = tracker.receive(datagram, HOME, now)
            if sample is not None:
                times.append(sample.captured)
                np.testing.assert_allclose(sample.position, sent[round(sample.captured, 9)], atol=1e-12)
    assert (np.diff(times) > 0).all()
    kept = np.array([t for t, _ in tracker.track.samples()])
    assert (np.diff(kept) > 0).all() and len(kept) == 256
    counts = tracker.counts
    assert counts["duplicate"] > 50 and counts["out of order"] > 100 and counts["checksum"] > 20
    assert 400 < counts["accepted"] < 800 and counts["accepted"] + counts["lost"] == pytest.approx(1000, abs=10)


def test_network_is_deterministic_and_keeps_its_probabilities():
    def carried(seed):
        network = Network(NetworkFaults(loss=0.2, duplication=0.1, jitter=0.003), seed)
        for i in range(5000):
            network.send(i.to_bytes(4, "big"), i * 0.001)
        return network.due(10.0)

    assert carried(1) == carried(1) != carried(2)
    assert len(carried(1)) == pytest.approx(5000 * 0.8 * 1.1, rel=0.03)
    with pytest.raises(ValueError, match="loss: expected 0 to 1, got 1.2"):
        NetworkFaults(loss=1.2)


def test_cameras_are_late_noisy_and_can_fall_silent():
    cameras, received = TrackerEmulator(TrackerParams(offset=(0.01, 0.0, -0.02)), 0), []
    for i in range(4000):
        now = i * 0.008
        if i == 3000:
            cameras.drop_out(now + 0.8)
        cameras.step(now, 1, np.array([0.2, 0.5, 0.3]))
        received += [(now, decode(d)) for d in cameras.due(now)]
    assert {round(now - s.captured, 6) for now, s in received} == {0.016}  # 15 ms, seen every 8 ms
    error = np.array([s.position for _, s in received]) - [0.21, 0.5, 0.28]
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=3e-4)
    np.testing.assert_allclose(error.std(axis=0), 0.003, rtol=0.05)
    gaps = np.diff([s.sequence for _, s in received])
    assert sorted(set(gaps)) == [1, 101]


def flying(i, **changed):
    """Frame i of a ball at 6 m/s."""
    position = changed.pop("position", (0.1, 1.5 - 6.0 * 0.008 * i, 0.4))
    return frame(changed.pop("sequence", i), 1 + i * 0.008, 1, position)


def test_an_outlier_is_refused_and_a_track_that_goes_on_elsewhere_is_taken_up():
    tracker = Tracker(TrackerConfig())
    for i in range(10):
        assert tracker.receive(flying(i), HOME, 1 + i * 0.008)
    assert tracker.receive(flying(10, position=(9.0, -9.0, 9.0)), HOME, 1.08) is None  # 20 m in 8 ms
    assert tracker.counts["outlier"] == 1 and len(tracker.track) == 10
    assert tracker.receive(flying(11), HOME, 1.088) is not None and len(tracker.track) == 11
    for i in range(12, 20):
        random = np.random.default_rng(i).uniform(-9, 9, 3)
        assert tracker.receive(flying(i, position=random), HOME, 1 + i * 0.008) is None
    assert len(tracker.track) == 11 and tracker.received == pytest.approx(1.152)
    taken = [tracker.receive(flying(i, position=(7.0, 7.0, 0.1)), HOME, 1 + i * 0.008) for i in range(20, 24)]
    assert [sample is not None for sample in taken] == [False, False, True, True]
    assert len(tracker.track) == 2


def test_the_fastest_ball_and_noise_are_no_outliers():
    random = np.random.default_rng(0)
    tracker = Tracker(TrackerConfig())
    for i in range(100):
        place = np.array([0.0, 8.0 - 35.0 * 0.008 * (i % 50), 0.4]) + 0.01 * random.normal(size=3)
        assert tracker.receive(frame(i, 1 + i * 0.008, i // 50, place), HOME, 1 + i * 0.008)


def test_one_far_sequence_number_does_not_block_the_true_ones():
    tracker = Tracker(TrackerConfig())
    for i in range(5):
        tracker.receive(flying(i), HOME, 1 + i * 0.008)
    assert tracker.receive(flying(5, sequence=2**30), HOME, 1.04) is None
    assert tracker.counts["far ahead"] == 1
    for i in range(6, 20):
        assert tracker.receive(flying(i), HOME, 1 + i * 0.008) is not None
    taken = [tracker.receive(flying(i, sequence=10**6 + i), HOME, 1 + i * 0.008) for i in range(20, 23)]
    assert [sample is not None for sample in taken] == [False, True, True]  # a tracker that was started anew


def test_frames_are_taken_from_one_port():
    tracker = Tracker(TrackerConfig())
    assert tracker.receive(flying(0), HOME, 1.0, 5000)
    assert tracker.receive(flying(1), HOME, 1.008, 6000) is None and tracker.counts["stranger"] == 1
    assert tracker.receive(flying(1), HOME, 1.008, 5000)
    assert tracker.receive(flying(200), HOME, 2.6, 6000)  # after a second of silence
    tracker = Tracker(TrackerConfig(source_port=5000))
    assert tracker.receive(flying(0), HOME, 1.0, 6000) is None
    assert tracker.receive(flying(0), HOME, 1.0, 5000)
