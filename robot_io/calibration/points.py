"""Measured points of a calibration: a CSV with a header, one point a line, lengths in m and angles in rad.

    table_x, table_y, table_z   where the point is in the table frame, by tape measure or gauge; a ball's centre at rest
                                on the table has z = 0.02
    ball_x, ball_y, ball_z      what the tracker gives for the ball there, before any calibration
    gantry_x ... joint_6        what axes and controller report while the paddle touches the point; another robot's
                                joints by their names
    paddle_x, paddle_y, paddle_z  point of the paddle that touches, in the last joint's frame; without these columns it
                                is the blade's end

Other columns are ignored: ``mjx-tt robot check`` notes the ball's columns, ``jog`` the joints' as well.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from ballmodel.constants import PADDLE_RADIUS
from robot_io.contract import PAPER, Contract
from robot_io.safety.clearance import RobotGeometry

TABLE = ("table_x", "table_y", "table_z")
BALL = ("ball_x", "ball_y", "ball_z")
PADDLE = ("paddle_x", "paddle_y", "paddle_z")


def read(path: Path, *groups: tuple[str, ...]) -> tuple[list[int], list[np.ndarray]]:
    """Line numbers, and the columns of each group as (n, ...), of the lines with the first column of every group.

    Raises ValueError naming file, line and column.
    """
    try:
        with open(path, encoding="utf-8", newline="") as stream:
            rows = csv.DictReader(stream, skipinitialspace=True)
            names, lines = rows.fieldnames or (), [(rows.line_num, row) for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read: {error}") from None
    missing = [name for group in groups for name in group if name not in names]
    if missing:
        raise ValueError(f"{path}: no columns {', '.join(missing)}; found: {', '.join(names) or 'none'}")
    used = [(line, row) for line, row in lines if all(row[group[0]] for group in groups)]
    numbers = [[[_number(path, line, name, row[name]) for name in group] for line, row in used] for group in groups]
    return [line for line, _ in used], [np.array(n).reshape(-1, len(g)) for n, g in zip(numbers, groups, strict=True)]


def touched(
    path: Path, contract: Contract = PAPER, end: np.ndarray | None = None
) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
    """Line numbers, table points (n, 3), readings (n, joints) and touching points (n, 3) of the paddle.

    contract  of the robot; end: the blade's end (3,) [m] in its last joint's frame, None: the paper's robot's

    Raises ValueError as ``read``.
    """
    with_paddle = PADDLE[0] in path.read_text(encoding="utf-8", errors="replace").partition("\n")[0]
    lines, (table, joints, *paddle) = read(path, TABLE, contract.joints, *([PADDLE] if with_paddle else []))
    if end is None:
        end = RobotGeometry.load().blade + np.array([PADDLE_RADIUS, 0.0, 0.0])  # of the nominal paddle
    return lines, table, joints, paddle[0] if paddle else np.tile(end, (len(lines), 1))


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{path}: line {line}: {name} is {text!r}; a finite number is needed")
    return value
