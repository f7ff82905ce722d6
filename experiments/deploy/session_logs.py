"""Sessions at the robot as a diagnosis reads them: the balls' flights, and each joint's commands and positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.joint.log import SHORTEST, JointRecord
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from robot_io.log import SessionLog, read

LONGEST_GAP = 0.1  # [s] without a sample that ends a flight


def is_session(path: Path) -> bool:
    """True when an MCAP is a robot's log rather than a file of trajectories."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        with open(path, "rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, OSError):
        return False
    return summary is not None and any(c.topic == "/joint_states" for c in summary.channels.values())


def load(path: Path, robot: Robot | None = None) -> tuple[tuple[Trajectory, ...], tuple[JointRecord, ...]]:
    """Flights and joint records of a session of a robot; None: the paper's.

    Raises robot_io.errors' exceptions for a damaged log, ValueError for one of a robot with other joints.
    """
    log, wanted = read(path), robot or robots.paper()
    played = log.robot
    if played.joints != wanted.contract.joints:
        raise ValueError(
            f"{path}: a session of {played.robot}, whose joints are {', '.join(played.joints)}; --robot is "
            f"{wanted.name}, allowed is {played.robot}"
        )
    return flights(log), _joints(log, wanted)


def flights(log: SessionLog) -> tuple[Trajectory, ...]:
    """The balls of a session, each between two gaps."""
    out = []
    for ball in np.unique(log.ball.id):
        mine = np.flatnonzero(log.ball.id == ball)
        order = mine[np.argsort(log.ball.capture_time[mine], kind="stable")]
        time = log.ball.capture_time[order]
        order = order[np.concatenate([[True], np.diff(time) > 0.0])]
        time = log.ball.capture_time[order]
        position = log.ball.position[:, order]
        cuts = np.flatnonzero(np.diff(time) > LONGEST_GAP) + 1
        for k, part in enumerate(np.split(np.arange(order.size), cuts)):
            if part.size:
                name = f"{ball}" if not cuts.size else f"{ball}.{k}"
                out.append(Trajectory(log.path.stem, name, time[part], position[:, part]))
    return tuple(out)


def _joints(log: SessionLog, robot: Robot) -> tuple[JointRecord, ...]:
    states, commands = log.joints, log.commands
    if states.time.size < 2 or commands.time.size < 2:
        return ()
    ticks, sent = np.unique(commands.time, return_index=True)
    out = []
    for j, name in enumerate(log.robot.joints):
        known = np.flatnonzero(np.isfinite(states.position[j]))  # arm and gantry report by turns
        moments, first = np.unique(states.time[known], return_index=True)
        if moments.size > 1 and moments[-1] - max(moments[0], ticks[0]) >= SHORTEST:
            positions = states.position[j, known[first]]
            out.append(JointRecord(name, ticks, commands.sent[j, sent], moments, positions, robot=robot))
    return tuple(out)
