"""Motion of each joint beside its own response: what the other joints and the arm's pose do to its servo."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse, Motion
from mjx_tt.diagnosis.joint.log import JointRecord
from mjx_tt.robot.servo import follow

IDEAL = {"servo": 0.0, "servo_gain": 1.0}
BARE = {"backlash": 0.0, "joint_offset": 0.0, "observation_delay": 0.0}
STEP = 1.0 / 300.0  # [s] of the robot's model
REST, LATEST = 0.3, 0.1  # [s] after which a robot stands; from a command to the state that shows it


def coupling(records: Sequence[JointRecord], responses: Mapping[str, JointResponse]) -> dict[str, Motion]:
    """Measured time [s] and movement [rad], [m] of each joint that its response alone does not have.

    The robot of the simulation plays the logged commands, as a whole, from where it was measured: at the first command,
    and again after every pause of the log in which it had come to rest, for somebody may have moved it meanwhile.
    Nothing is known where a joint is not logged. A movement is up to a constant from pause to pause.
    """
    by_name, robot = {r.joint: r for r in records}, records[0].robot
    joints = robot.contract.joints
    if set(by_name) != set(joints):
        return {}
    mine = [by_name[name] for name in joints]
    begin, end = min(r.command_time[0] for r in mine), max(r.state_time[-1] for r in mine)
    cuts = [begin, *(cut for cut in _rests(mine) if begin < cut < end - STEP), end + STEP]
    parts = [np.arange(first, last, STEP) for first, last in pairwise(cuts)]
    ticks, ends = np.concatenate(parts), np.cumsum([part.size for part in parts])[:-1]
    driven, alone = (
        np.stack([_alone(r, responses[r.joint], ticks, **changes) for r in mine], axis=1) for changes in (IDEAL, {})
    )
    movement = []
    for first, velocity, own in zip(cuts, np.split(driven, ends), np.split(alone, ends), strict=False):
        start = np.array([_measured(r, first) for r in mine]) - [responses[r.joint].joint_offset for r in mine]
        whole, step = follow(robot, start, np.diff(velocity, axis=0) / STEP)
        if abs(step - STEP) > 1e-9:
            raise ValueError(f"the robot's model steps by {step} s, {STEP} is wanted")
        movement.append(whole - start - (own - own[0]))
    every = np.concatenate(movement)
    return {r.joint: (ticks + responses[r.joint].observation_delay, every[:, i]) for i, r in enumerate(mine)}


def _alone(record: JointRecord, response: JointResponse, time: np.ndarray, **changes: float) -> np.ndarray:
    bare = dataclasses.replace(response, **BARE, **changes)
    return bare.simulate(record.command_time, record.command_velocity, time)


def _measured(record: JointRecord, time: float) -> float:
    """Position at the first state from ``time`` on; between states at the log's begin."""
    later = record.state_time >= time
    if time <= record.command_time[0] or not later.any():
        return float(np.interp(record.command_time[0], record.state_time, record.state_position))
    return float(record.state_position[np.argmax(later)])


def _rests(records: Sequence[JointRecord]) -> list[float]:
    """Ends [s] of pauses in which no joint was watched and none was told to move during the last REST of it.

    What is commanded less than LATEST before the first state is sent after the pause: that state waits for it.
    """
    found = []
    for resumed in records[0].resumed():
        # Each bus reports with a delay of its own.
        earlier = [r.state_time[r.state_time <= resumed - LATEST] for r in records]
        paused = max(float(t[-1]) if t.size else -np.inf for t in earlier)
        sent = np.concatenate([r.command_time for r in records])
        end = float(min(sent[(sent > resumed - LATEST) & (sent <= resumed)], default=resumed))
        if end - paused > REST and not any(_told(r, end - REST, end) for r in records):
            found.append(end)
    return found


def _told(record: JointRecord, begin: float, end: float) -> bool:
    """True if a command that is not zero was in force between two times [s]."""
    first, last = np.searchsorted(record.command_time, (begin, end), side="left")
    return bool(record.command_velocity[max(first - 1, 0) : last].any())
