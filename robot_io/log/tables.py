"""A log as CSV tables; times in seconds since the session's start."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ballmodel.io.atomic_files import replacing
from robot_io.log.messages import Ball
from robot_io.log.reader import SessionLog

GAP = 0.25  # [s] without a sample, after which a ball of the same number is another trajectory
SHORTEST = 2  # samples of a trajectory that is worth a row


def export(log: SessionLog, folder: str | Path) -> list[Path]:
    """Writes the tables of a log into ``folder``, each complete or not at all, and returns their paths.

    ball.csv     session,trajectory,t,x,y,z                what ``mjx-tt fit-human`` reads
    command.csv  t,joint,velocity                          as sent to the robot
    state.csv    t,joint,position                          as measured
    events.csv   t,level,name,text
    ticks.csv    tick,t,lateness,policy_seconds,ball_age,gantry_age,arm_age
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    start, commands, joints, ticks = log.start_time, log.commands, log.joints, log.ticks
    names = log.robot.joints
    ages = (ticks.ball_age, ticks.gantry_age, ticks.arm_age)
    seconds = (ticks.time - start, ticks.lateness, ticks.policy_seconds, *ages)
    tables = {
        "ball.csv": ("session,trajectory,t,x,y,z", _balls(log)),
        "command.csv": ("t,joint,velocity", _by_joint(names, commands.time - start, commands.sent)),
        "state.csv": ("t,joint,position", _by_joint(names, joints.time - start, joints.position)),
        "events.csv": (
            "t,level,name,text",
            ((_seconds(event.time - start), event.level.name.lower(), event.name, event.text) for event in log.events),
        ),
        "ticks.csv": (
            "tick,t,lateness,policy_seconds,ball_age,gantry_age,arm_age",
            ((int(tick), *map(_seconds, row)) for tick, *row in zip(ticks.tick, *seconds, strict=True)),
        ),
    }
    paths = []
    for name, (header, rows) in tables.items():
        path = folder / name
        with replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header.split(","))
            writer.writerows(rows)
        paths.append(path)
    return paths


def trajectories(ball: Ball) -> list[tuple[str, np.ndarray]]:
    """Name and sample indices (n,), in the order of capture, of every ball in play.

    A ball's number tells one from the next. A number that comes again after GAP seconds without it, such as after a
    restart of the tracker, begins a trajectory named "number.2". Samples that repeat a capture time are left out, and
    so are positions that are not finite and trajectories of fewer than SHORTEST samples.
    """
    found: list[tuple[str, np.ndarray]] = []
    seen: Counter[int] = Counter()
    sound = np.flatnonzero(np.isfinite(ball.position).all(axis=0))
    order = sound[np.argsort(ball.capture_time[sound], kind="stable")]
    pieces: list[tuple[int, np.ndarray]] = []
    for id in np.unique(ball.id):
        indices = order[ball.id[order] == id]
        steps = np.diff(ball.capture_time[indices])
        indices, steps = indices[np.concatenate([[True], steps > 0.0])[: indices.size]], steps[steps > 0.0]
        pieces += [(int(id), piece) for piece in np.split(indices, np.flatnonzero(steps > GAP) + 1)]
    pieces = [piece for piece in pieces if piece[1].size >= SHORTEST]
    for id, indices in sorted(pieces, key=lambda piece: ball.capture_time[piece[1][0]]):
        seen[id] += 1
        found.append((str(id) if seen[id] == 1 else f"{id}.{seen[id]}", indices))
    return found


def _balls(log: SessionLog) -> Iterator[tuple]:
    for name, indices in trajectories(log.ball):
        times = log.ball.capture_time[indices] - log.start_time
        for t, position in zip(times, log.ball.position[:, indices].T, strict=True):
            yield (log.name, name, _seconds(t), *map(_number, position))


def _by_joint(names: tuple[str, ...], times: np.ndarray, values: np.ndarray) -> Iterator[tuple]:
    for t, row in zip(times, values.T, strict=True):
        yield from ((_seconds(t), joint, _number(value)) for joint, value in zip(names, row, strict=True))


def _seconds(value: float) -> str:
    """To the nanosecond, which is what the log holds."""
    return f"{value:.9f}"


def _number(value: float) -> str:
    return repr(float(value))
