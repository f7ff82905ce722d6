"""Measured trajectories: readers, their errors, segmentation and resampling."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from ballmodel.io import TrackOptions, read, write_mcap
from ballmodel.trajectory import Dataset, Trajectory, first_bounce, free_flight
from tests.support.paths import MEASURED

needs_data = pytest.mark.skipif(not MEASURED.is_dir(), reason=f"no measured data in {MEASURED}")

GOOD = "session,trajectory,t,x,y,z\nmon,1,0.00,0.1,1.2,0.3\nmon,1,0.01,0.1,1.15,0.31\nmon,2,0.0,0,1,0.2\n"


def bouncing(noise=0.0, rate=120.0, seed=0, start=(0.1, 1.2, 0.3), velocity=(0.2, -4.5, 1.0)):
    """A ball in vacuum with one bounce of restitution 0.9, sampled with noise; also the time of the bounce."""
    rng = np.random.default_rng(seed)
    fall = (velocity[2] + np.sqrt(velocity[2] ** 2 + 2 * 9.81 * (start[2] - 0.02))) / 9.81
    time = np.arange(int(rate * (fall + 0.25))) / rate + rng.uniform(0, 0.2 / rate)
    z = start[2] + velocity[2] * time - 4.905 * time**2
    late = time - fall
    z = np.where(late > 0, 0.02 + 0.9 * (9.81 * fall - velocity[2]) * late - 4.905 * late**2, z)
    position = np.stack([start[0] + velocity[0] * time, start[1] + velocity[1] * time, z])
    return Trajectory("", "ball", time, position + rng.normal(0, noise, position.shape)), fall


# --- trajectories


@pytest.mark.parametrize(
    ("time", "position", "message"),
    [
        ([0, 1, 1], np.zeros((3, 3)), "sample 2 has t=1.0 after t=1.0"),
        ([0, 1], [[0, np.nan], [0, 0], [0, 0]], "sample 1 is not finite"),
        ([0, 1], [[0, 0], [1200.0, 1150.0], [300, 310]], "millimetres"),
        ([0, 8000], np.zeros((3, 2)), "milliseconds"),
    ],
)
def test_unusable_trajectories_are_refused_by_name(time, position, message):
    with pytest.raises(ValueError, match=message) as error:
        Trajectory("monday", "7", np.array(time, float), np.array(position, float))
    assert "monday/7" in str(error.value)


@pytest.mark.parametrize("rate", [60.0, 125.0, 180.0])
@pytest.mark.parametrize("seed", range(5))
def test_free_flight_ends_at_the_bounce_despite_noise(rate, seed):
    trajectory, bounce = bouncing(noise=0.002, rate=rate, seed=seed)
    end = free_flight(trajectory).time[-1]
    assert bounce - 2.5 / rate < end < bounce


def test_a_flight_without_bounce_is_kept_whole():
    trajectory, bounce = bouncing(noise=0.002)
    before = trajectory.part(0, int(np.sum(trajectory.time < bounce)))
    assert first_bounce(before) is None
    assert len(free_flight(before)) == len(before)


def test_a_slow_ball_low_over_the_table_does_not_bounce_by_noise():
    for seed in range(20):
        trajectory, bounce = bouncing(noise=0.003, seed=seed, start=(0, 1.2, 0.06), velocity=(0, -4.0, 0.4))
        found = first_bounce(trajectory)
        assert found is not None and abs(trajectory.time[found] - bounce) < 0.02


# --- CSV


def test_csv_groups_rows_into_trajectories(tmp_path):
    path = tmp_path / "balls.csv"
    path.write_text(GOOD)
    data = read(path)
    assert [(t.session, t.name, len(t)) for t in data] == [("mon", "1", 2), ("mon", "2", 1)]
    assert data.sessions == ("mon",)
    np.testing.assert_array_equal(data.trajectories[0].position, [[0.1, 0.1], [1.2, 1.15], [0.3, 0.31]])
    path.write_text("\ufefftrajectory,t,x,y,z\n1,0,0,1,0.2\n", encoding="utf-8")
    assert read(path).trajectories[0].session == ""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.15", "1.15m", "row 3, column 'y': '1.15m' is not a number"),
        (",0.31", ",0.31,5", "Expected 6 fields in line 3, saw 7"),
        ("trajectory,t", "trajectory,when", "row 1: no column is known as t; there are .*when.* --columns t=NAME"),
    ],
)
def test_malformed_csv_names_file_row_and_column(tmp_path, old, new, message):
    path = tmp_path / "bad.csv"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ValueError, match=message) as error:
        read(path)
    assert "bad.csv" in str(error.value)


# --- MCAP


@pytest.fixture
def recording(tmp_path):
    rng = np.random.default_rng(0)
    time = 1.7e9 + np.arange(2000) / 125
    balls = tuple(Trajectory("tue", str(i), time + 20 * i, rng.normal(size=(3, 2000))) for i in range(3))
    path = tmp_path / "balls.mcap"
    write_mcap(path, Dataset(balls, "test"))
    return path, balls


def test_mcap_round_trip(recording):
    path, balls = recording
    for ours, theirs in zip(read(path), balls, strict=True):
        assert (ours.session, ours.name) == (theirs.session, theirs.name)
        np.testing.assert_array_equal(ours.position, theirs.position)
        np.testing.assert_allclose(ours.time, theirs.time, atol=1e-6, rtol=0)
    assert [p.name for p in path.parent.iterdir()] == ["balls.mcap"]


def test_truncated_mcap_is_an_error_and_its_complete_chunks_can_be_salvaged(recording, tmp_path):
    path, balls = recording
    whole = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    salvaged = []
    for part in (0.45, 0.7, 0.95):
        cut.write_bytes(whole[: int(len(whole) * part)])
        with pytest.raises(ValueError, match=r"cut.mcap: damaged or cut short .* hold \d+ messages"):
            read(cut)
        data = read(cut, options=TrackOptions(salvage=True))
        salvaged.append(sum(len(t) for t in data))
        for ours, theirs in zip(data, balls[: len(data)], strict=True):
            np.testing.assert_array_equal(ours.position, theirs.position[:, : len(ours)])
    assert 0 < salvaged[0] < salvaged[1] < salvaged[2] < 6000


def test_a_flipped_bit_never_becomes_a_wrong_sample(recording, tmp_path):
    """It is an error, except in the chunk indices, which hold no sample and are not needed to read."""
    path, balls = recording
    whole = bytearray(path.read_bytes())
    damaged = tmp_path / "damaged.mcap"
    noticed = 0
    for offset in np.random.default_rng(1).integers(len(whole) // 10, len(whole) // 2, 40):
        flipped = bytearray(whole)
        flipped[offset] ^= 0x10
        damaged.write_bytes(flipped)
        try:
            data = read(damaged)
        except ValueError as error:
            assert "damaged.mcap" in str(error)
            noticed += 1
        else:
            for ours, theirs in zip(data, balls[: len(data)], strict=True):
                np.testing.assert_array_equal(ours.position, theirs.position)
    assert noticed > 20


# --- DeepMind and AIMY


@needs_data
def test_deepmind_states():
    data = read(MEASURED / "deepmind_ball_states" / "rallies.json")
    assert len(data) == 13088
    np.testing.assert_allclose(data.state.velocity[:, 0], [0.78, -5.55, 0.52], atol=1e-6)
    np.testing.assert_allclose(data.state.spin[:, 0], [62.81, -5.84, -7.62], atol=1e-6)
    assert np.median(np.linalg.norm(data.state.velocity, axis=0)) == pytest.approx(5.5, abs=0.1)
    assert np.mean(data.state.velocity[1] < 0) == pytest.approx(0.92, abs=0.01)


@needs_data
def test_aimy_balls_fly_to_the_robot_and_bounce_on_its_half():
    for session, count in (("mn5008_topspin", 15), ("no_spin_robot_simple", 48)):
        data = read(MEASURED / "aimy_launcher" / f"{session}.hdf5")
        assert (len(data), data.sessions) == (count, (session,))
        # Two recordings end some 20 mm above the table, before the bounce.
        cut_short = {"9", "14"} if session == "mn5008_topspin" else set()
        assert {t.name for t in data if first_bounce(t) is None} == cut_short
        for trajectory in data:
            bounce = first_bounce(trajectory)
            assert 0.018 < trajectory.position[2].min() < 0.05
            assert bounce is None or -1.37 < trajectory.position[1, bounce] < 0.0
            assert trajectory.position[1, 0] > 1.0
            # The last sample of the free flight is close above the table and still falling.
            assert free_flight(trajectory).position[2, -1] < 0.07


def test_malformed_deepmind_states_name_entry_and_field(tmp_path):
    path = tmp_path / "states.json"
    entry = {"id": 1, **{f"{p}_{a}": 0.5 for p in ("pos", "vel", "w_vel") for a in "xyz"}}
    path.write_text(json.dumps([entry]))
    assert read(path).state.position.shape == (3, 1)
    for change, message in (
        ({"vel_y": "fast"}, "entry 1, field 'vel_y': a finite number is wanted, got 'fast'"),
        ({"pos_x": None}, "entry 1, field 'pos_x'"),
        ({"w_vel_z": float("nan")}, "entry 1, field 'w_vel_z'"),
    ):
        path.write_text(json.dumps([entry, {**entry, **change}]))
        with pytest.raises(ValueError, match=message):
            read(path)
    path.write_text("[{")
    with pytest.raises(ValueError, match="states.json: not readable as a table"):
        read(path)


def test_malformed_aimy_names_the_group(tmp_path):
    path = tmp_path / "launcher.hdf5"
    with h5py.File(path, "w") as file:
        file["originals/0/positions"] = np.zeros((5, 3))
    with pytest.raises(ValueError, match="/originals/0 has no time_stamps"):
        read(path)
    with h5py.File(path, "w") as file:
        file["something"] = 1
    with pytest.raises(ValueError, match="no group /originals .* found: something"):
        read(path)
    path.write_bytes(b"no hdf5")
    with pytest.raises(ValueError, match="not readable as HDF5"):
        read(path)
