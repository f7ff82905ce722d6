"""Drives from logs of the examination's robot, whose arm MuJoCo C moves: lags, gains and common delays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.together import joints
from mjx_tt.sim.model import SimModel
from tests.exam.generator import robot

PRIOR = {
    **{f"drives.{name}.lag": (0.015, 0.01) for name in robot.JOINTS},
    **{f"drives.{name}.velocity_gain": (1.0, 0.04) for name in robot.JOINTS},
}
DELAYS = {"festo": 0.082, "abb": 0.113}  # [s] sums; believed are 97.5 and 100 ms


def records(seconds: float, seed: int = 0, **extra: float):
    """Logs of all joints, each with a lag and gain of its own, and the truth by dotted path."""
    rng, truth, true = np.random.default_rng(seed), {}, {}
    for name in robot.JOINTS:
        own = {"lag": rng.uniform(0.002, 0.02), "velocity_gain": rng.uniform(0.95, 1.05)}
        truth |= {f"drives.{name}.{effect}": value for effect, value in own.items()}
        bus, nominal = "festo" if name.startswith("gantry") else "abb", robot.nominal(name)
        true[name] = replace(nominal, action_delay=DELAYS[bus] - nominal.observation_delay, **own, **extra)
        truth[f"latency.{bus}_action"] = true[name].action_delay
    return logged(true, rng, seconds, 0.4), truth


def logged(true: dict[str, robot.Joint], rng: np.random.Generator, seconds: float, level=1.0) -> list[JointRecord]:
    """What the robot with these joints records of its strokes."""
    rows = robot.logs(true, rng, seconds, level)
    columns = {name: [np.array([(t, x) for t, n, x in part if n == name]).T for part in rows] for name in robot.JOINTS}
    return [JointRecord(name, *command, *state) for name, (command, state) in columns.items()]


def test_lags_gains_and_the_delay_of_each_bus_are_found():
    logs, truth = records(12.0)
    found = joints.fit(logs, SimModel(), PRIOR)
    errors = np.sqrt(np.diagonal(found.covariance))
    assert set(found.paths) == set(truth)
    for path, value, error in zip(found.paths, found.mean, errors, strict=True):
        assert abs(value - truth[path]) < 4.0 * error + 1e-5, (path, value, truth[path], error)
        assert error < (0.001 if path.endswith(("lag", "action")) else 0.002)
    assert found.samples().values.min() >= 0.0


def test_what_is_not_in_the_model_shows_in_what_is_left():
    plain, played = (joints.fit(records(8.0, backlash=b)[0], SimModel(), PRIOR).left for b in (0.0, 0.01))
    assert max(plain.values()) < 1.5e-4 and all(played[name] > 3.0 * plain[name] for name in robot.JOINTS)
