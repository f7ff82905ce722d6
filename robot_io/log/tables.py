"""A log as CSV tables; times in seconds since the session's start."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import fields
from itertools import chain
from pathlib import Path

import numpy as np

from ballmodel.io.atomic_files import replacing
from robot_io.log.messages import Ball
from robot_io.log.reader import SessionLog
from robot_io.log.topics import TIMINGS

GAP = 0.25  # [s] without a sample, after which a ball of the same number is another trajectory
SHORTEST = 2  # samples of a trajectory that is worth a row

# What ``mjx-tt fit-human`` reads; commands as sent to the robot; states as measured.
TABLES = {
    "ball.csv": "session,trajectory,t,x,y,z",
    "command.csv": "t,joint,velocity",
    "state.csv": "t,joint,position",
    "events.csv": "t,level,name,text",
    "ticks.csv": f"tick,t,{','.join(TIMINGS)}",
}


def export(log: Iterable[SessionLog], folder: str | Path) -> tuple[list[Path], int]:
    """Writes TABLES of a log's pieces into ``folder``, each complete or not at all; their paths, and balls in them."""
    folder, pieces = Path(folder), iter(log)
    first = next(pieces)  # of a log that cannot be read no folder is made
    folder.mkdir(parents=True, exist_ok=True)
    balls: list[Ball] = []  # kept: a trajectory may go on in the next piece
    with ExitStack() as stack:
        writers = {}
        for name, header in TABLES.items():
            temporary = stack.enter_context(replacing(folder / name))
            writers[name] = csv.writer(stack.enter_context(open(temporary, "w", newline="", encoding="utf-8")))
            writers[name].writerow(header.split(","))
        for piece in chain([first], pieces):
            for name, rows in _rows(piece):
                writers[name].writerows(rows)
            balls.append(piece.ball)
        names = [field.name for field in fields(Ball)]
        ball = Ball(**{name: np.concatenate([getattr(b, name) for b in balls], axis=-1) for name in names})
        found = trajectories(ball)
        for name, indices in found:
            writers["ball.csv"].writerows(
                (first.name, name, _seconds(ball.capture_time[i] - first.start_time), *ball.position[:, i].tolist())
                for i in indices
            )
    return [folder / name for name in TABLES], len(found)


def _rows(log: SessionLog) -> Iterator[tuple[str, Iterator[tuple]]]:
    start, ticks = log.start_time, log.ticks
    for name, series, values in (
        ("command.csv", log.commands, log.commands.sent),
        ("state.csv", log.joints, log.joints.position),
    ):
        rows = zip(series.time - start, values.T.tolist(), strict=True)
        yield name, ((_seconds(t), *cell) for t, row in rows for cell in zip(log.robot.joints, row, strict=True))
    yield "events.csv", ((_seconds(e.time - start), e.level.name.lower(), e.name, e.text) for e in log.events)
    seconds = (ticks.time - start, *(getattr(ticks, name) for name in TIMINGS))
    yield "ticks.csv", ((int(tick), *map(_seconds, row)) for tick, *row in zip(ticks.tick, *seconds, strict=True))


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


def _seconds(value: float) -> str:
    """To the nanosecond, which is what the log holds."""
    return f"{value:.9f}"
