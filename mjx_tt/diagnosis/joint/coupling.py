"""Motion of each joint beside its own response: what the other joints and the arm's pose do to its servo."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse, Motion
from mjx_tt.diagnosis.joint.log import JointRecord
from mjx_tt.robot.servo import follow

IDEAL = {"servo": 0.0, "servo_gain": 1.0}
BARE = {"backlash": 0.0, "joint_offset": 0.0, "observation_delay": 0.0}
STEP = 1.0 / 300.0  # [s] of the robot's model


def coupling(records: Sequence[JointRecord], responses: Mapping[str, JointResponse]) -> dict[str, Motion]:
    """Measured time [s] and movement [rad], [m] of each joint that its response alone does not have.

    The robot of the simulation plays the logged commands once, as a whole; nothing is known where a joint is not
    logged.
    """
    by_name, robot = {r.joint: r for r in records}, records[0].robot
    joints = robot.contract.joints
    if set(by_name) != set(joints):
        return {}
    mine = [by_name[name] for name in joints]
    begin = min(r.command_time[0] for r in mine)
    time = np.arange(begin, max(r.state_time[-1] for r in mine) + STEP, STEP)
    start = np.array([np.interp(r.command_time[0], r.state_time, r.state_position) for r in mine])
    start -= [responses[name].joint_offset for name in joints]

    def alone(record: JointRecord, **changes: float) -> np.ndarray:
        response = dataclasses.replace(responses[record.joint], **BARE, **changes)
        return response.simulate(record.command_time, record.command_velocity, time)

    driven = np.stack([alone(r, **IDEAL) for r in mine], axis=1)
    whole, step = follow(robot, start, np.diff(driven, axis=0) / STEP)
    if abs(step - STEP) > 1e-9:
        raise ValueError(f"the robot's model steps by {step} s, {STEP} is wanted")
    return {
        r.joint: (time + responses[r.joint].observation_delay, whole[:, i] - start[i] - alone(r))
        for i, r in enumerate(mine)
    }
