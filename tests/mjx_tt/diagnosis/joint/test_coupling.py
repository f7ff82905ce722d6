"""Motions that joints give each other in logs with pauses, against MuJoCo C stepped by a plain loop."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.joint.coupling import coupling
from mjx_tt.diagnosis.joint.forward_model import nominal_response
from mjx_tt.robot import robots
from mjx_tt.sim.model import SimModel
from robot_io.contract import JOINT_NAMES
from robot_io.limits import LIMITS

PLAYED, AFTER = 1.4, 4.0  # [s] of each play; from one's begin to the next one's
PERIOD = 1.0 / 75.0
DELAYS = (0.02, 0.04)  # [s] after which arm and axes report


def plays(count: int) -> tuple[list[JointRecord], list[np.ndarray]]:
    """Records of hard motions from home, each followed by a pause; and the true positions (T, 8) of each."""
    model, rng = robots.paper().model(), np.random.default_rng(0)
    home, ticks = model.key("home").qpos, round(PLAYED / PERIOD)
    commands, true = [], []
    for _ in range(count):
        data = mujoco.MjData(model)
        data.qpos[:] = home
        smooth = np.cumsum(rng.normal(0.0, 0.12, (ticks, 8)), axis=0)
        command = np.clip(smooth, -0.5, 0.5) * np.asarray(LIMITS.velocity)
        path = [home.copy()]
        for u in command:
            data.ctrl[:] = u
            for _ in range(round(PERIOD / model.opt.timestep)):
                mujoco.mj_step(model, data)
                path.append(data.qpos.copy())
        commands.append(command)
        true.append(np.array(path))
    begin = AFTER * np.arange(count)
    sent = np.concatenate([b + PERIOD * np.arange(ticks + 1) for b in begin])
    records = []
    for i, name in enumerate(JOINT_NAMES):
        arrived = np.concatenate([b + model.opt.timestep * np.arange(len(true[0])) + DELAYS[i < 2] for b in begin])
        velocity = np.concatenate([np.append(command[:, i], 0.0) for command in commands])
        records.append(JointRecord(name, sent, velocity, arrived, np.concatenate([path[:, i] for path in true])))
    return records, true


def predicted(records: list[JointRecord]) -> np.ndarray:
    """Positions (T, 8) of all plays, with the nominal servo and what the joints do to each other."""
    out, delays = [], dict.fromkeys(JOINT_NAMES[:2], DELAYS[1]) | dict.fromkeys(JOINT_NAMES[2:], DELAYS[0])
    model = SimModel()
    responses = {
        r.joint: replace(nominal_response(model, r.joint), action_delay=0.0, observation_delay=delays[r.joint])
        for r in records
    }
    beside = coupling(records, responses)
    for r in records:
        found = responses[r.joint].simulate(r.command_time, r.command_velocity, r.state_time, beside=beside[r.joint])
        out.append(found)
    return np.stack(out, axis=1)


def test_after_a_pause_the_robot_is_where_it_is_measured():
    """Each of three plays, from its own begin on, within 0.2 mrad or mm, where joints push each other by some 20."""
    records, true = plays(3)
    found = predicted(records).reshape(3, -1, 8)
    for path, own in zip(true, found, strict=True):
        np.testing.assert_allclose(own - own[0], path - path[0], atol=2e-4)
    responses = {r.joint: nominal_response(SimModel(), r.joint) for r in records}
    pushed = max(np.abs(movement).max() for _, movement in coupling(records, responses).values())
    assert pushed > 0.01


def test_a_robot_that_moves_on_through_a_pause_is_not_set_anew():
    """A second without states in mid-motion: the prediction goes through it as if all had been measured."""
    records, true = plays(1)
    whole = predicted(records)
    keep = (records[0].state_time < 0.5) | (records[0].state_time > 1.2)
    cut = [
        JointRecord(r.joint, r.command_time, r.command_velocity, r.state_time[keep], r.state_position[keep])
        for r in records
    ]
    assert cut[0].resumed().size == 1
    np.testing.assert_allclose(predicted(cut), whole[keep], atol=1e-9)
    assert np.abs(whole - whole[0] - (true[0] - true[0][0])).max() < 2e-4
