"""Sessions at the robot as a diagnosis reads them: the balls' flights, and each joint's commands and positions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.joint.log import SHORTEST, JointRecord
from mjx_tt.diagnosis.logs import TURN
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
    return flights(log), joints_of([log], wanted)


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


def split_by_stroke(track: Trajectory) -> tuple[Trajectory, ...]:
    """A rally's track from each stroke of the person to the next one, the robot's hit between them."""
    cuts, away, farthest = [0], False, 0  # away from the robot; sample at which the ball was farthest that way
    y = track.position[1]
    for i in range(len(y)):
        ahead = y[i] - y[farthest] if away else y[farthest] - y[i]
        if ahead >= 0.0:
            farthest = i
        elif -ahead > TURN:
            if away:
                cuts.append(farthest)
            away, farthest = not away, i
    return tuple(track.part(a, b) for a, b in pairwise([*cuts, len(y)]))


def joints_of(logs: Sequence[SessionLog], robot: Robot) -> tuple[JointRecord, ...]:
    """Each joint's commands and positions over the files of a session, in their order."""
    states, commands = [log.joints for log in logs], [log.commands for log in logs]
    sent, first = np.unique(np.concatenate([c.time for c in commands]), return_index=True)
    time = np.concatenate([s.time for s in states])
    position, velocity = (
        np.concatenate(parts, axis=1) for parts in ([s.position for s in states], [c.sent for c in commands])
    )
    if time.size < 2 or sent.size < 2:
        return ()
    out = []
    for j, name in enumerate(logs[0].robot.joints):
        known = np.flatnonzero(np.isfinite(position[j]))  # arm and gantry report by turns
        moments, kept = np.unique(time[known], return_index=True)
        if moments.size > 1 and moments[-1] - max(moments[0], sent[0]) >= SHORTEST:
            out.append(JointRecord(name, sent, velocity[j, first], moments, position[j, known[kept]], robot=robot))
    return tuple(out)
