"""Shots and bounces in the form of Sony's Ace (SonyResearch/ace_public): one CSV of events, measured with spin.

Columns player_id, rally_id, type (shot, bounce or net, of which shot_p1 is one player's), timestamp, ball_pos,
ball_vel_out, ball_spin_out, the last three bracketed triples in metres, m/s and rad/s. Their x points towards the human
and z up; the table frame has y there.
"""

from __future__ import annotations

import csv
import os
import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ballmodel.io.deepmind import MeasuredStates
from ballmodel.state import BallState
from ballmodel.trajectory import LARGEST_COORDINATE

KINDS = ("shot", "bounce", "net")
COLUMNS = ("rally_id", "type", "timestamp", "ball_pos", "ball_vel_out", "ball_spin_out")
LEAST_SPEED, LARGEST_SPEED = 0.2, 60.0  # [m/s] of a ball after an event
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan", re.IGNORECASE)


@dataclass(frozen=True)
class Events:
    """Shots and bounces in the order of the file, in the table frame."""

    rally: tuple[str, ...]
    shot: Bool[np.ndarray, " n"]  # a bounce otherwise
    time: Float[np.ndarray, " n"]  # [s]
    state: BallState  # (3, n) after the event
    source: str

    def __len__(self) -> int:
        return self.time.size

    @property
    def landings(self) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Indices of the shots that a bounce of the same rally follows, and of these bounces."""
        shots = np.flatnonzero(self.shot[:-1] & ~self.shot[1:])
        same = np.array([self.rally[i] == self.rally[i + 1] for i in shots], bool)
        return shots[same], shots[same] + 1

    def shots(self) -> MeasuredStates:
        """The shots as start states, each with the place of the bounce that follows it."""
        every, (shots, bounces) = np.flatnonzero(self.shot), self.landings
        landing = np.full((2, len(self)), np.nan)
        landing[:, shots] = np.asarray(self.state.position)[:2, bounces]
        state = BallState(
            *(np.asarray(part)[:, every] for part in (self.state.position, self.state.velocity, self.state.spin))
        )
        return MeasuredStates(every, state, self.source, landing[:, every])


def read_events(path: str | os.PathLike) -> Events:
    """Reads the CSV, without events that lack numbers or are no ball's.

    Raises ValueError naming file, row and column.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise ValueError(f"{path}: column {', '.join(missing)} is missing; wanted: {', '.join(COLUMNS)}")
    unique = len({row["rally_id"] for row in rows}) == len(rows)  # match/rally/event
    rally, shot, numbers = [], [], []
    for number, row in enumerate(rows, start=2):
        kind = row["type"].strip().lower().partition("_")[0]  # shot_p1: the first player's
        if kind not in KINDS:
            raise ValueError(f"{path}: row {number}, column 'type': {row['type']!r}; allowed: {', '.join(KINDS)}")
        if kind == "net":
            continue
        vectors = [[float(v) for v in NUMBER.findall(row[name])] for name in COLUMNS[3:]]
        if any(len(v) not in (0, 3) for v in vectors):
            raise ValueError(f"{path}: row {number}: three numbers in brackets are wanted as {', '.join(COLUMNS[3:])}")
        values = [float(row["timestamp"]), *(x for v in vectors for x in v or [np.nan] * 3)]
        speed, away = np.linalg.norm(values[4:7]), np.abs(values[1:4]).max()
        # A shot that does not move, or is somewhere else, stands for none: trackers write zeros or -1 for what is lost.
        if np.all(np.isfinite(values)) and LEAST_SPEED < speed < LARGEST_SPEED and away < LARGEST_COORDINATE:
            rally.append(row["rally_id"].rpartition("/")[0] if unique else row["rally_id"])
            shot.append(kind == "shot")
            numbers.append(values)
    if not numbers:
        raise ValueError(f"{path}: no event has all its numbers")
    table = np.array(numbers).T
    position, velocity, spin = (np.stack([-v[1], v[0], v[2]]) for v in np.split(table[1:], 3))
    return Events(tuple(rally), np.array(shot), table[0], BallState(position, velocity, spin), str(path))
