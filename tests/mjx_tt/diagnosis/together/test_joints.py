"""Drives from logs of fine Euler steps of ``test_joint``, which know nothing of the arm: lags, gains, common delays."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.together import joints
from mjx_tt.robot import robots
from mjx_tt.robot.servo import servos
from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES, LIMITS
from tests.mjx_tt.diagnosis.test_joint import command, euler

PRIOR = {
    **{f"drives.{name}.lag": (0.015, 0.01) for name in JOINT_NAMES},
    **{f"drives.{name}.velocity_gain": (1.0, 0.04) for name in JOINT_NAMES},
}
DELAYS = {"festo": 0.082, "abb": 0.113}  # [s] sums; believed are 97.5 and 100 ms


def records(seconds: float, noise: float, seed: int = 0, **extra: float):
    """Logs of all joints, each with a lag and gain of its own, and the truth by dotted path."""
    rng, truth, cases, times, commands = np.random.default_rng(seed), {}, [], [], []
    for i, name in enumerate(JOINT_NAMES):
        bus, servo = "festo" if i in FESTO_JOINTS else "abb", servos(robots.paper())[i]
        own = {"lag": rng.uniform(0.002, 0.02), "velocity_gain": rng.uniform(0.95, 1.05)}
        truth |= {f"drives.{name}.{effect}": value for effect, value in own.items()}
        beside = {"delay": DELAYS[bus], "servo": servo.time_constant, "servo_gain": servo.gain}
        cases.append(own | beside | extra)
        time, u = command(rng, seconds, "sines", 0.4 * LIMITS.velocity[i])
        times.append(time)
        commands.append(u)
    query = np.arange(0.0, seconds, 0.004)
    clean = euler(times, commands, [query] * len(cases), cases)
    logs = [
        JointRecord(name, times[i], commands[i], query, clean[i] + rng.normal(0.0, noise, query.size))
        for i, name in enumerate(JOINT_NAMES)
    ]
    return logs, truth


@pytest.fixture
def alone(monkeypatch):
    """Joints that do not move each other, as the logs of ``euler``."""
    monkeypatch.setattr(joints, "coupling", lambda *_: {})


def test_lags_gains_and_the_delay_of_each_bus_are_found(alone):
    logs, truth = records(12.0, 1e-4)
    found = joints.fit(logs, SimModel(), PRIOR)
    truth |= {"latency.festo_action": DELAYS["festo"] - 0.033, "latency.abb_action": DELAYS["abb"] - 0.029}
    errors = np.sqrt(np.diagonal(found.covariance))
    assert set(found.paths) == set(truth)
    for path, value, error in zip(found.paths, found.mean, errors, strict=True):
        assert abs(value - truth[path]) < 4.0 * error + 1e-5, (path, value, truth[path], error)
        assert error < (0.001 if path.endswith(("lag", "action")) else 0.002)
    assert found.samples().values.min() >= 0.0


def test_what_is_not_in_the_model_shows_in_what_is_left(alone):
    plain, played = (joints.fit(records(8.0, 1e-4, backlash=b)[0], SimModel(), PRIOR).left for b in (0.0, 0.01))
    assert max(plain.values()) < 1.5e-4 and all(played[name] > 3.0 * plain[name] for name in JOINT_NAMES)
