"""Replays of a diagnosis: flights of a model that is known to be wrong, beside one that is known to be right."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from experiments.errors import ConfigError
from experiments.view import measured
from mjx_tt.sim.model import ModelFile, SimModel, with_values
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


def test_a_log_that_is_gone_is_named(folder):
    (folder / "balls.csv").unlink()
    with pytest.raises(ConfigError, match="extended.yaml: provenance.logs .*balls.csv: no such file"):
        measured.load_diagnosis(folder)
