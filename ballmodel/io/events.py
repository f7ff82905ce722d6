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

from ballmodel.state import BallState

KINDS = ("shot", "bounce", "net")
COLUMNS = ("rally_id", "type", "timestamp", "ball_pos", "ball_vel_out", "ball_spin_out")
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


def read_events(path: str | os.PathLike) -> Events:
    """Reads the CSV; events without all their numbers are left out. Raises ValueError naming file, row and column."""
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
        if np.all(np.isfinite(values)):
            rally.append(row["rally_id"].rpartition("/")[0] if unique else row["rally_id"])
            shot.append(kind == "shot")
            numbers.append(values)
    if not numbers:
        raise ValueError(f"{path}: no event has all its numbers")
    table = np.array(numbers).T
    position, velocity, spin = (np.stack([-v[1], v[0], v[2]]) for v in np.split(table[1:], 3))
    return Events(tuple(rally), np.array(shot), table[0], BallState(position, velocity, spin), str(path))
