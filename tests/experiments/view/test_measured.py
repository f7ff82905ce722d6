"""Replays of a session at the robot, and of a diagnosis whose nominal model is known to be wrong."""

import json
import re

import numpy as np
import pytest

from experiments.view import measured
from mjx_tt.robot.mjcf import home_qpos, load_model
from mjx_tt.sim.model import ModelFile, SimModel, with_values
from robot_io import log
from tests.oracles.ball_flight import RADIUS, TABLE_MU, Touch, bounce, fly, path

DEAD = 0.8  # restitution of the table that the balls were measured on
RATE = 125.0  # [Hz]
UP = np.array([0.0, 0.0, 1.0])


def thrown(k: int) -> np.ndarray:
    """Samples (n, 4) of time [s] and position [m] of one ball that bounces on the dead table."""
    start = Touch(0.0, np.array([0.1 * k, 1.2, 0.3]), np.array([0.1, -4.5 - 0.1 * k, 1.0]), np.zeros(3))
    moment, state = fly(start, lambda position: position[2] - RADIUS)

    def share(normal_speed, slip):
        return min(TABLE_MU * (1 + DEAD) * normal_speed / slip, 0.4)

    after = Touch(moment, state[:3], *bounce(state[3:], np.zeros(3), UP, DEAD, share))
    times = np.arange(0.0, moment + 0.25, 1 / RATE)
    first = path(start, times[times < moment])
    later = path(after, np.concatenate([[moment], times[times >= moment]]))[:, 1:]
    return np.column_stack([times, np.concatenate([first, later], axis=1).T])


@pytest.fixture
def folder(tmp_path):
    lines = ["session,trajectory,t,x,y,z"]
    for k in range(6):
        lines += [f"s,{k},{t:.6f},{x:.6f},{y:.6f},{z:.6f}" for t, x, y, z in thrown(k)]
    (tmp_path / "balls.csv").write_text("\n".join(lines) + "\n")
    provenance = {"model": "nominal", "logs": {str(tmp_path / "balls.csv"): "hash"}}
    model = with_values(SimModel(), {"ball.table.restitution": DEAD})
    ModelFile(model, (), provenance).save(tmp_path / "extended.yaml")
    (tmp_path / "verdict.json").write_text(json.dumps({"verdict": "the table is dead"}))
    return tmp_path


def test_the_extended_model_meets_the_measured_balls_and_the_nominal_one_misses_them(folder):
    playlist = measured.load_diagnosis(folder)
    assert playlist.count == 6 and playlist.caption(0).startswith("the table is dead: trajectory s/")
    for n in range(6):
        (replay,) = playlist.replays(n)
        last = np.isfinite(replay.balls["measured"][:, 0]).nonzero()[0][-1]
        true = replay.balls["measured"][last]
        assert np.linalg.norm(replay.balls["extended"][last] - true) < 0.003
        assert np.linalg.norm(replay.balls["nominal"][last] - true) > 0.05
        told = re.search(r"; nominal misses by (\d+) mm, extended misses by (\d+) mm$", playlist.caption(n))
        for name, number in zip(("nominal", "extended"), told.groups(), strict=True):
            assert abs(1e-3 * int(number) - np.linalg.norm(replay.balls[name][last] - true)) < 0.03


def test_a_session_of_the_robot_is_replayed_as_it_was_logged(tmp_path):
    start, home = 50.0, home_qpos(load_model())
    with log.FileRecorder(tmp_path, "session", {}, {}, start, 0) as recorder:
        recorder.put(log.episode_start(start + 0.2, 1))
        for k in range(120):
            t, now = k / 75, start + k / 75
            flown = np.array([0.2, 1.2 - 4.0 * t, 0.3 + 1.0 * t - 4.905 * t**2])
            if flown[2] > 0.02:
                recorder.put(log.Ball(now, now, flown, 1))
            joints = home + np.eye(8)[2] * 0.2 * np.sin(2 * np.pi * t)
            recorder.put(log.Joints(now, joints, np.zeros(8), now))
            recorder.put(log.Command(k, now, np.zeros(8), np.full(8, 0.1), joints))
        recorder.put(log.Event(start + 0.7, log.Level.ERROR, "fault", "tracker: silent"))
        recorder.put(log.episode_end(start + 1.2, 1, "missed", {"hit": 0.0}))
    playlist = measured.load(tmp_path / "session.mcap", None)
    (replay,) = playlist.replays(0)
    assert playlist.caption(0) == "session.mcap, episode 1 of 1" and replay.outcome == "missed"
    np.testing.assert_allclose(replay.qpos[:, 2], home[2] + 0.2 * np.sin(2 * np.pi * replay.time), atol=1e-3)
    seen, simulated = replay.balls["measured"], replay.balls["simulated"]
    flying = np.isfinite(seen[:, 0]) & np.isfinite(simulated[:, 0])
    np.testing.assert_allclose(seen[flying, 1], 1.2 - 4.0 * replay.time[flying], atol=1e-3)
    assert np.abs(seen - simulated)[flying].max() < 0.1  # the logged ball knows no air
    np.testing.assert_allclose(replay.series["Commands sent [m/s, rad/s]"].values, 0.1)
    assert replay.events == ((pytest.approx(0.7), "FAULT: tracker: silent"),)
