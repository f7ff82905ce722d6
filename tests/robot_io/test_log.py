"""The log of a session: recorder process, file, reader, damage, tables."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rich.console import Console

from ballmodel.io import read as read_balls
from experiments.commands import log as session_logs
from experiments.errors import ConfigError
from robot_io import log
from robot_io.contract import JOINT_NAMES
from robot_io.log import messages as records
from robot_io.log import scan
from robot_io.log.__main__ import take_records
from robot_io.log.messages import LogError
from robot_io.log.writer import SessionWriter, parts, sample_clock_offset, session
from tests.support.paths import ROOT

NANO = 1_000_000_000
START = 100.0  # [s] on the control clock of made-up sessions
EPOCH = 1_700_000_000 * NANO  # of that clock's zero


def tick(k: int, now: float) -> tuple:
    """One control tick's records, every number of which follows from k."""
    eight, eleven = np.arange(8.0) + k, np.arange(11.0) - k
    return (
        log.Ball(now - 0.020, now - 0.001, np.array([0.1, 1.2 - 0.01 * k, 0.3]), k // 40),
        log.Joints(now - 0.004, eight, -eight, now - 0.002),
        log.Observation(k, now, eleven),
        log.Action(k, now, np.full(8, 0.001 * k)),
        log.Command(k, now, eight + 0.5, eight + 0.25, eight + 0.125),
        log.Tick(k, now, 1e-4, 2e-4, 0.02, 0.008, 0.004),
    )


def make(folder: Path, ticks: int = 300, name: str = "session", **metadata) -> Path:
    with log.FileRecorder(folder, name, metadata, {"robot.yaml": "rate: 75\n"}, START, EPOCH) as recorder:
        recorder.put(log.episode_start(START, 1))
        for k in range(ticks):
            recorder.put(*tick(k, START + k / 75))
        recorder.put(log.episode_end(START + ticks / 75, 1, "returned", {"hit": 1.0, "return": 0.5}))
    return folder / f"{name}.mcap"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make(tmp_path_factory.mktemp("log"))


def expect_ticks(session: log.SessionLog, count: int) -> None:
    """Every number of the first ``count`` ticks is there; times are rounded to the nanosecond."""
    k, now = np.arange(count), session.ticks.time
    eight = np.arange(8.0)[:, None] + k
    for found, expected in (
        (session.commands.tick, k),
        (session.commands.requested, eight + 0.5),
        (session.commands.sent, eight + 0.25),
        (session.commands.reference, eight + 0.125),
        (session.joints.position, eight),
        (session.joints.velocity, -eight),
        (session.observations.values, np.arange(11.0)[:, None] - k),
        (session.actions.values, np.tile(0.001 * k, (8, 1))),
        (session.ball.position, [0.1 + 0 * k, 1.2 - 0.01 * k, 0.3 + 0 * k]),
        (session.ball.id, k // 40),
        (session.ticks.tick, k),
        (session.ticks.gantry_age, np.full(count, 0.008)),
    ):
        np.testing.assert_array_equal(found, expected)
    times = session.ball.capture_time, session.ball.received, session.joints.time, session.joints.received
    wanted = now - np.array([[0.020], [0.001], [0.004], [0.002]])
    np.testing.assert_allclose(times, wanted, rtol=0, atol=3e-9)


def chunks_of(path: Path) -> list:
    """Where the file's chunks are, by the mcap library."""
    with open(path, "rb") as file:
        return make_reader(file).get_summary().chunk_indexes


def flip(path: Path, offset: int, bits: int, to: Path) -> Path:
    """A copy with some bits of one byte flipped."""
    flipped = bytearray(path.read_bytes())
    flipped[offset] ^= bits
    to.write_bytes(flipped)
    return to


# --- records


def test_a_packed_ball_is_these_bytes():
    packed = log.Ball(1.5, 2.0, [0.0, -1.0, 0.25], 7).pack()
    assert packed.hex() == (
        "01000000000000f83f0000000000000040070000000000000000000000000000000000f0bf000000000000d03f"
    )


def test_records_survive_packing():
    originals = [*tick(3, 5.0), log.Event(1.0, log.Level.ERROR, "fault", "größer"), log.Metadata("a", {"b": "c"})]
    for original in originals:
        back = records.unpack(original.pack())
        for name in original.__dataclass_fields__:
            np.testing.assert_array_equal(getattr(back, name), getattr(original, name))


def test_what_is_no_record_is_refused():
    with pytest.raises(LogError, match=r"Command.sent has shape \(6,\), expected \(8,\)"):
        log.Command(1, 0.0, np.zeros(8), np.zeros(6), np.zeros(8)).pack()
    with pytest.raises(LogError, match="event name ''"):
        log.Event(0.0, log.Level.INFO, "").pack()
    with pytest.raises(LogError, match="at most 4094"):
        log.Metadata("robot", {"yaml": "x" * 5000}).pack()
    with pytest.raises(LogError, match="unknown kind"):
        records.unpack(b"\xff123")
    with pytest.raises(LogError, match="Ball of 10 bytes"):
        records.unpack(log.Ball(0.0, 0.0, np.zeros(3)).pack()[:10])


def test_a_long_event_is_cut_to_what_a_pipe_takes_whole():
    packed = log.Event(0.0, log.Level.INFO, "n" * 100, "ä" * 5000).pack()
    assert len(packed) <= records.LARGEST
    assert records.unpack(packed).text.endswith("ää [cut]")


def test_frames_come_out_whole_however_the_bytes_are_cut():
    wanted = [b"a" * n for n in (1, 300, 4094, 2)]
    stream = b"".join(struct.pack("<H", len(part)) + part for part in wanted)
    for step in (1, 7, 4096, len(stream)):
        buffer, found = bytearray(), []
        for i in range(0, len(stream), step):
            buffer += stream[i : i + step]
            found += take_records(buffer)
        assert found == wanted and not buffer


# --- a whole session


def test_round_trip_through_the_recorder_process(tmp_path):
    before = time.time()
    metadata = {"artefact": "abc", "git": {"dirty": False}}
    with log.Recorder(tmp_path, "monday", metadata, {"robot.yaml": "a: 1\n"}) as r:
        assert (tmp_path / "monday.mcap.part").exists()
        start = time.monotonic()
        r.put(log.episode_start(start, 7, ball="player1/M0"))
        for k in range(500):
            r.put(*tick(k, start + k / 75))
        r.put(log.Metadata("policy", {"digest": "def", "update": 3}))
        r.put(log.Event(start + 7.0, log.Level.FATAL, "fault", "egm_silent: the arm does not answer"))
        r.put(log.episode_end(start + 7.0, 7, "missed", {"hit": 0.0}))
        path = r.close()
    assert (path, r.close(), r.dropped, r.malformed) == (tmp_path / "monday.mcap", path, 0, 0)
    assert os.listdir(tmp_path) == ["monday.mcap"]
    session = log.read(path)
    expect_ticks(session, 500)
    # A double holds this machine's monotonic clock to better than a microsecond.
    np.testing.assert_allclose(session.ticks.time, start + np.arange(500) / 75, rtol=0, atol=1e-8)
    assert before - 0.01 <= session.utc(start).timestamp() <= time.time() + 0.01
    assert session.metadata["session"]["artefact"] == "abc"
    assert json.loads(session.metadata["session"]["git"]) == {"dirty": False}
    assert session.metadata["policy"]["update"] == "3"
    assert session.attachments == {"robot.yaml": b"a: 1\n"}
    assert (session.name, session.dropped, session.faults) == ("monday", 0, ())
    assert [(e.level, e.name) for e in session.events] == [
        (log.Level.INFO, "episode_start"),
        (log.Level.FATAL, "fault"),
        (log.Level.INFO, "episode_end"),
    ]
    (episode,) = session.episodes
    assert (episode.number, episode.outcome, episode.reward) == (7, "missed", {"hit": 0.0})
    assert episode.details["ball"] == "player1/M0"
    assert episode.end - episode.start == pytest.approx(7.0, abs=1e-8)


def test_standard_readers_open_the_file(recording):
    """The mcap library with the schemas that stand in the file, not with ours."""
    with open(recording, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        counts = summary.statistics.channel_message_counts
        assert {summary.channels[i].topic: n for i, n in counts.items()} == {
            "/ball": 300,
            "/joint_states": 300,
            "/commands/requested": 300,
            "/commands/sent": 300,
            "/observation": 300,
            "/action": 300,
            "/tick": 300,
            "/event": 2,
            "/scene": 1,
            "/tf": 250,
        }
        messages = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((schema.name, message, decoded))
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.data) == ("robot.yaml", b"rate: 75\n")
    name, message, ball = messages["/ball"][1]
    assert name == "foxglove.Point3InFrame"
    assert message.publish_time == EPOCH + round((START + 1 / 75 - 0.020) * NANO)
    assert message.log_time == EPOCH + round((START + 1 / 75 - 0.001) * NANO)
    assert ball.timestamp.seconds * NANO + ball.timestamp.nanos == message.publish_time
    assert (ball.frame_id, ball.point.x, ball.point.y, ball.point.z) == ("table", 0.1, 1.19, 0.3)
    name, message, sent = messages["/commands/sent"][2]
    assert (name, message.sequence, [j.name for j in sent.joints]) == ("foxglove.JointStates", 2, list(JOINT_NAMES))
    assert [j.position for j in sent.joints] == list(np.arange(8) + 2.125)
    assert [j.velocity for j in sent.joints] == list(np.arange(8) + 2.25)
    requested = messages["/commands/requested"][2][2].joints[0]
    assert requested.velocity == 2.5 and not requested.HasField("position")
    name, _, observation = messages["/observation"][4]
    assert (name, observation.tick, list(observation.values)) == ("robot_log.Values", 4, list(np.arange(11.0) - 4))
    name, _, decoded = messages["/tick"][4]
    assert (name, decoded.tick) == ("robot_log.Tick", 4)
    assert (decoded.lateness, decoded.ball_age, decoded.arm_age) == (1e-4, 0.02, 0.004)
    name, _, event = messages["/event"][0]
    assert (name, event.name, event.level) == ("foxglove.Log", "episode_start", 2)
    assert json.loads(event.message) == {"episode": 1}


def test_messages_in_which_zeros_are_left_out_or_that_are_longer_keep_their_numbers(tmp_path):
    """proto3 omits a field that is 0, and numbers of ticks have other lengths: read as the library does."""
    random = np.random.default_rng(0)
    position = random.choice([0.0, -0.0, 1.5, np.inf], (3, 300))
    timings = random.choice([0.0, 1e-3, np.inf], (5, 300))
    ticks = np.array([*range(100), *range(126, 226), *range((1 << 32) - 100, 1 << 32)])
    with log.FileRecorder(tmp_path, "zeros", {}, start_time=START, clock_offset_ns=EPOCH) as recorder:
        for k, tick in enumerate(ticks):
            now = START + k * 1e-7  # nanoseconds of one to nine digits
            recorder.put(log.Ball(now, now, position[:, k], 1), log.Tick(int(tick), now, *timings[:, k]))
            recorder.put(log.Observation(int(tick), now, np.zeros(11)))
    path = recorder.close()
    session = log.read(path)
    np.testing.assert_array_equal(session.ball.position, position)
    np.testing.assert_array_equal(session.ticks.tick, ticks)
    for name, values in zip(("lateness", "policy_seconds", "ball_age", "gantry_age", "arm_age"), timings, strict=True):
        np.testing.assert_array_equal(getattr(session.ticks, name), values)
    np.testing.assert_array_equal(session.observations.values, np.zeros((11, 300)))
    with open(path, "rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages("/tick"))
    assert [message.decoded_message.lateness for message in decoded] == list(timings[0])


def test_the_pieces_of_a_stream_are_the_whole(recording):
    whole = log.read(recording)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan, "BATCH", 1)
        pieces = list(log.stream(recording, most=500))
    assert len(pieces) > 3 and [len(piece.attachments) for piece in pieces] == [1] * len(pieces)
    for series in ("ball", "joints", "commands", "observations", "actions", "ticks"):
        for name in (field.name for field in fields(getattr(whole, series))):
            parts = [getattr(getattr(piece, series), name) for piece in pieces]
            np.testing.assert_array_equal(np.concatenate(parts, axis=-1), getattr(getattr(whole, series), name))
    assert sum((piece.events for piece in pieces), ()) == whole.events
    assert "end" not in pieces[0].metadata and pieces[-1].metadata == whole.metadata


def test_a_long_session_goes_on_in_more_files(recording, tmp_path):
    """Each is a sound log by itself, and together they are what one file would be; so are the tables."""
    made = session(tmp_path, "session", {}, {"robot.yaml": "rate: 75"}, EPOCH, START, False)
    writer = SessionWriter(made, largest=30_000)
    for record in (log.episode_start(START, 1), *(r for k in range(300) for r in tick(k, START + k / 75))):
        writer.write(record.pack())
    writer.write(records.End(3, 0).pack())
    first = writer.finish()
    files = parts(first)
    assert first == tmp_path / "session.mcap" and files[1].name == "session.002.mcap" and len(files) > 2
    assert sorted(files) == sorted(tmp_path.iterdir())
    assert all(log.check(file).state == "sound" for file in files)
    assert sum(log.read(file).ticks.tick.size for file in files) == 300
    pieces = list(log.stream(first))
    assert [piece.metadata["session"].get("part", "1") for piece in pieces] == [str(i + 1) for i in range(len(files))]
    assert np.concatenate([piece.ticks.tick for piece in pieces]).tolist() == list(range(300))
    assert pieces[-1].dropped == 3 and pieces[-1].attachments == {"robot.yaml": b"rate: 75"}
    whole, _ = log.export([log.read(recording)], tmp_path / "whole")
    parted, _ = log.export(log.stream(first), tmp_path / "parted")
    for one, other in zip(whole, parted, strict=True):
        if one.name != "events.csv":
            assert one.read_text() == other.read_text(), one.name


def test_a_stream_ends_where_the_file_is_damaged(recording, tmp_path):
    damaged = flip(recording, chunks_of(recording)[3].chunk_start_offset + 9 + 100, 4, tmp_path / "damaged.mcap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan, "BATCH", 1)
        pieces = log.stream(damaged, most=1)
        ticks = next(pieces).ticks.tick.size
        with pytest.raises(LogError, match="chunk 4 cannot be used"):
            for piece in pieces:
                ticks += piece.ticks.tick.size
    assert 100 < ticks < 250


def test_equal_sessions_give_equal_files(tmp_path, recording):
    assert make(tmp_path).read_bytes() == recording.read_bytes()


def test_recorders_refuse_what_they_would_overwrite_or_hide(tmp_path):
    make(tmp_path, 1, "here")
    (tmp_path / "part.mcap.part").write_bytes(b"")
    (tmp_path / "file").write_bytes(b"")
    for kind in (log.Recorder, log.FileRecorder):
        with pytest.raises(LogError, match="here.mcap: exists"):
            kind(tmp_path, "here", {})
        with pytest.raises(LogError, match="part.mcap.part: exists"):
            kind(tmp_path, "part", {})
        with pytest.raises(LogError, match="'a/b': no name"):
            kind(tmp_path, "a/b", {})
        with pytest.raises(LogError, match="metadata host|metadata format"):
            kind(tmp_path, "new", {"format": "mine"})
        with pytest.raises(LogError, match="metadata 'x': .* no JSON"):
            kind(tmp_path, "new", {"x": object()})
    with pytest.raises(LogError, match="file"):
        log.Recorder(tmp_path / "file", "new", {})
    with log.FileRecorder(tmp_path, "strict", {}) as recorder:
        with pytest.raises(LogError, match="time nan"):
            recorder.put(log.Event(float("nan"), log.Level.INFO, "x"))


def test_malformed_records_do_not_disturb_the_control_thread(tmp_path):
    with log.Recorder(tmp_path, "a", {}) as recorder:
        now = time.monotonic()
        recorder.put(log.Ball(now, now, np.zeros(2)), *tick(0, now))  # cannot be packed
        recorder.put(log.Ball(float("inf"), now, np.zeros(3)))  # refused by the recorder process
        recorder.put(*tick(1, now))
    session = log.read(recorder.close())
    assert (recorder.malformed, session.metadata["end"]["malformed"], session.ball.id.size) == (1, "2", 2)
    (event,) = session.events
    assert event.name == "log_dropped"
    assert "Ball.position has shape (2,)" in json.loads(event.text)["reason"]


def test_a_full_pipe_drops_and_counts(tmp_path):
    with log.Recorder(tmp_path, "full", {}) as recorder:
        os.kill(recorder._process.pid, signal.SIGSTOP)
        start, put = time.monotonic(), 0
        while recorder.dropped < 300:
            recorder.put(*tick(put, start + put / 75))
            put += 1
        held = put - recorder.dropped // 6
        assert held > 5 * 75, "the pipe shall hold five seconds of ticks"
        os.kill(recorder._process.pid, signal.SIGCONT)
        while recorder._reported[0] < recorder.dropped:  # room comes back
            time.sleep(0.01)
            recorder.put(*tick(put, start + put / 75))
            put += 1
        dropped = recorder.dropped
    session = log.read(recorder.close())
    assert session.dropped == dropped
    assert session.ticks.tick.size == put - dropped // 6
    reported = [json.loads(event.text) for event in session.events if event.name == "log_dropped"]
    assert (len(reported), reported[0]["dropped"], reported[0]["total_dropped"]) == (1, dropped, dropped)


# --- dying

DYING = """
import subprocess, sys, time
from tests.robot_io.test_log import tick
from robot_io import log
recorder = log.Recorder({folder!r}, "dying", {{"a": "b"}})
heir = subprocess.Popen(["sleep", "60"], pass_fds=[recorder._pipe], stdout=subprocess.DEVNULL)
print(recorder._process.pid, heir.pid, flush=True)
start = time.monotonic()
k = 0
while True:
    recorder.put(*tick(k, time.monotonic()))
    print(k, flush=True)
    k += 1
    time.sleep(max(0.0, start + k / 75 - time.monotonic()))
"""


def killed(folder: Path, ticks: int, also_recorder: bool) -> tuple[int, int]:
    """Runs a process that logs at 75 Hz and kills it after ``ticks``.

    Returns the last tick it put and the process id of a child of it that holds the pipe open.
    """
    code = DYING.format(folder=str(folder))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    pid, heir = map(int, process.stdout.readline().split())
    last = 0
    for line in process.stdout:
        last = int(line)
        if last >= ticks:
            break
    if also_recorder:
        os.kill(pid, signal.SIGKILL)
    process.kill()
    rest = process.stdout.read().split()
    process.wait()
    return int(rest[-1]) if rest else last, heir


@pytest.mark.realtime
def test_when_the_control_process_is_killed_nothing_is_lost(tmp_path):
    last, heir = killed(tmp_path, 75, also_recorder=False)
    deadline = time.monotonic() + 30
    while not (tmp_path / "dying.mcap").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(heir, signal.SIGKILL)
    session = log.read(tmp_path / "dying.mcap")
    assert session.ticks.tick.size >= last
    expect_ticks(session, session.ticks.tick.size)
    assert (session.dropped, session.metadata["end"]["closed"]) == (None, "false")
    assert not (tmp_path / "dying.mcap.part").exists()


@pytest.mark.realtime
def test_when_both_are_killed_all_but_half_a_second_is_there(tmp_path):
    last, heir = killed(tmp_path, 100, also_recorder=True)
    os.kill(heir, signal.SIGKILL)
    part = tmp_path / "dying.mcap.part"
    assert os.listdir(tmp_path) == [part.name]
    with pytest.raises(LogError, match=r"part: not finished .* messages of the first \d.\d\d s can be had: mjx-tt"):
        log.read(part)
    session = log.read(part, salvage=True)
    count = session.ticks.tick.size
    assert count >= last - 75 // 2
    expect_ticks(session, count)
    assert session.metadata["session"]["a"] == "b"
    overview = log.salvage(part)
    assert (overview.path, overview.state) == (tmp_path / "dying.mcap", "sound")
    expect_ticks(log.read(overview.path), count)


def test_a_dead_recorder_is_noticed_and_does_not_disturb(tmp_path):
    recorder = log.Recorder(tmp_path, "a", {})
    recorder.put(*tick(0, time.monotonic()))
    os.kill(recorder._process.pid, signal.SIGKILL)
    recorder._process.wait()
    assert recorder.failure is None
    recorder.put(*tick(1, time.monotonic()))
    assert "a.mcap.part: the recorder process has ended" in recorder.failure
    recorder.put(*tick(2, time.monotonic()))
    assert recorder.dropped == 12
    with pytest.raises(LogError, match="mjx-tt log salvage"):
        recorder.close()


@pytest.mark.parametrize("removed", ["folder", "file"])
def test_a_log_that_was_removed_is_noticed(tmp_path, removed):
    folder = tmp_path / "logs"
    recorder = log.Recorder(folder, "a", {})
    recorder.put(*tick(0, time.monotonic()))
    if removed == "folder":
        shutil.rmtree(folder)
    else:
        os.rename(folder / "a.mcap.part", folder / "b.mcap.part")
    deadline = time.monotonic() + 20.0
    while recorder.failure is None and time.monotonic() < deadline:
        time.sleep(0.05)
        recorder.put(*tick(1, time.monotonic()))
    assert "a.mcap.part: removed or moved while it was written" in recorder.failure
    with pytest.raises(LogError, match="not finished"):
        recorder.close()


def test_a_disk_that_takes_no_more_is_told_and_what_it_took_is_kept(tmp_path):
    recorder = log.Recorder(tmp_path, "big", {})
    resource.prlimit(recorder._process.pid, resource.RLIMIT_FSIZE, (40_000, 40_000))
    start = time.monotonic()
    for k in range(20_000):
        recorder.put(*tick(k, start + k / 75))
        if recorder.failure is not None:
            break
        time.sleep(0.001)
    assert "big.mcap.part: the recorder process has ended ([Errno 27] File too large)" in recorder.failure
    for _ in range(2):
        with pytest.raises(LogError, match="not finished"):
            recorder.close()
    overview = log.salvage(tmp_path / "big.mcap.part")
    kept = log.read(overview.path).commands
    assert kept.tick.size > 70
    np.testing.assert_array_equal(kept.sent, np.arange(8.0)[:, None] + np.arange(kept.tick.size) + 0.25)


# --- damage


def test_any_flipped_bit_is_found(recording, tmp_path):
    size = recording.stat().st_size
    rng = np.random.default_rng(0)
    for offset in [*range(60), *range(size - 60, size), *rng.integers(60, size - 60, 300).tolist()]:
        overview = log.check(flip(recording, offset, 1 << rng.integers(8), tmp_path / "damaged.mcap"))
        assert any(fault.start <= offset <= fault.end for fault in overview.faults), (offset, overview.faults)


def test_damage_in_one_chunk_costs_that_chunk_only(recording, tmp_path):
    chunks = chunks_of(recording)
    assert len(chunks) > 4
    for lost in (chunks[0], chunks[2]):
        start = lost.chunk_start_offset
        damaged = flip(recording, start + 9 + 100, 4, tmp_path / f"damaged{start}.mcap")
        with pytest.raises(LogError, match=f"bytes {start} to {start + lost.chunk_length}: chunk . cannot be used"):
            log.read(damaged)
        session = log.read(damaged, salvage=True)
        assert len(session.faults) == 1
        lost_from, lost_to = ((t - EPOCH) / NANO for t in (lost.message_start_time, lost.message_end_time))
        assert not np.any((session.ticks.time > lost_from + 0.02) & (session.ticks.time < lost_to - 0.02))
        assert 300 * (1 - 1.5 / len(chunks)) < session.ticks.tick.size < 300
        overview = log.salvage(damaged)
        assert (overview.state, overview.path.name) == ("sound", f"{damaged.stem}.salvaged.mcap")
        assert str(session.faults[0]) == overview.metadata["salvage"]["faults"]
        np.testing.assert_array_equal(log.read(overview.path).commands.sent, session.commands.sent)


def test_a_broken_length_costs_the_way_to_the_next_chunk_only(recording, tmp_path):
    damaged = flip(recording, chunks_of(recording)[1].chunk_start_offset + 3, 1, tmp_path / "damaged.mcap")
    ticks = log.read(damaged, salvage=True).ticks.tick
    assert ticks[-1] == 299 and 200 < ticks.size < 300


def test_cut_files_give_their_complete_chunks(recording, tmp_path):
    whole = recording.read_bytes()
    cut = tmp_path / "cut.mcap.part"
    sizes = []
    for share in (0.3, 0.5, 0.7):
        cut.write_bytes(whole[: int(share * len(whole))])
        assert log.check(cut).state == "interrupted"
        session = log.read(cut, salvage=True)
        sizes.append(session.ticks.tick.size)
        assert session.episodes[0].end is None
        assert len(session.faults) == 1
    assert 0 < sizes[0] < sizes[1] < sizes[2] < 300
    for content in (b"", b"hello, this is no log", whole[:20]):
        cut.write_bytes(content)
        with pytest.raises(LogError, match="cut.mcap.part: not finished .* 0 messages"):
            log.read(cut)
        with pytest.raises(LogError, match="nothing can be salvaged"):
            log.salvage(cut, tmp_path / "out.mcap")
    assert os.listdir(tmp_path) == [cut.name]


# --- tables


def test_the_tables(recording, tmp_path):
    paths, number = log.export([log.read(recording)], tmp_path / "tables")
    assert number == 8
    assert sorted(os.listdir(tmp_path / "tables")) == sorted(path.name for path in paths)
    balls = read_balls(tmp_path / "tables" / "ball.csv")
    assert balls.sessions == ("session",)
    assert [trajectory.name for trajectory in balls] == [str(i) for i in range(8)]
    assert [len(trajectory) for trajectory in balls] == [40] * 7 + [20]
    third = balls.trajectories[2]
    np.testing.assert_allclose(third.time, np.arange(80, 120) / 75 - 0.020, rtol=0, atol=2e-9)
    np.testing.assert_array_equal(third.position[1], 1.2 - 0.01 * np.arange(80, 120))
    lines = (tmp_path / "tables" / "command.csv").read_text().splitlines()
    assert lines[:3] == ["t,joint,velocity", "0.000000000,gantry_x,0.25", "0.000000000,gantry_y,1.25"]
    assert len(lines) == 1 + 8 * 300
    lines = (tmp_path / "tables" / "state.csv").read_text().splitlines()
    assert lines[:2] == ["t,joint,position", "-0.004000000,gantry_x,0.0"]
    lines = (tmp_path / "tables" / "events.csv").read_text().splitlines()
    assert lines[1] == '0.000000000,info,episode_start,"{""episode"": 1}"'
    lines = (tmp_path / "tables" / "ticks.csv").read_text().splitlines()
    assert lines[2] == "1,0.013333333,0.000100000,0.000200000,0.020000000,0.008000000,0.004000000"


def test_trajectories_follow_the_ball_not_the_order_of_arrival():
    times = np.array([0.00, 0.02, 0.01, 0.02, 0.03, 1.00, 1.01, 5.0, 0.05])
    ids = np.array([4, 4, 4, 4, 5, 4, 4, 9, 5])
    position = np.ones((3, 9))
    position[0, 6] = 7.0
    found = log.trajectories(log.Ball(times, times, position, ids))
    assert [(name, list(indices)) for name, indices in found] == [("4", [0, 2, 1]), ("5", [4, 8]), ("4.2", [5, 6])]
    position[2, 2] = np.nan
    assert list(log.trajectories(log.Ball(times, times, position, ids))[0][1]) == [0, 1]
    nothing = log.Ball(np.zeros(0), np.zeros(0), np.zeros((3, 0)), np.zeros(0, int))
    assert log.trajectories(nothing) == []


# --- the command line's functions


def test_the_command_lines_functions(recording, tmp_path):
    whole = recording.read_bytes()
    good, cut = tmp_path / "good.mcap", tmp_path / "cut.mcap.part"
    good.write_bytes(whole)
    cut.write_bytes(whole[: len(whole) // 2])
    console = Console(record=True, width=200, file=open(os.devnull, "w"))
    session_logs.list_logs(tmp_path, console)
    shown = console.export_text()
    assert "finished" in shown and "interrupted" in shown
    assert session_logs.check([good], console) == 0
    assert session_logs.check([good, cut], console) == 1
    assert "unfinished" in console.export_text()
    with pytest.raises(ConfigError, match="mjx-tt log salvage"):
        session_logs.export(cut, None, console)
    salvaged = session_logs.salvage(cut, None, console)
    assert salvaged == tmp_path / "cut.mcap"
    with pytest.raises(ConfigError, match="exists"):
        session_logs.salvage(cut, None, console)
    written = session_logs.export(salvaged, None, console)
    assert written[0] == tmp_path / "cut" / "ball.csv" and written[0].exists()
    assert "fit-human" in console.export_text()
    with pytest.raises(ConfigError, match="no logs"):
        session_logs.list_logs(tmp_path / "cut", console)


def test_the_clock_offset_is_that_of_this_machine():
    assert abs(sample_clock_offset() - (time.time_ns() - time.monotonic_ns())) < 50_000_000
