"""What a robot was told and what it did: velocity commands and measured positions of its joints, one record a joint.

A log is a pair of CSV files: ``command.csv`` with columns t, joint, velocity and ``state.csv`` with columns t, joint,
position; joints by name, SI units, rows of different joints in any mixture, each joint's own rows in order of time.
"""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_io.contract import JOINT_NAMES, LIMITS

FASTEST = 5.0  # times a joint's rated speed beyond which a command is in other units than rad/s or m/s
WIDEST = 5.0  # times a joint's range beyond which a position is in other units than rad or m
SPARSEST = 0.5  # [s] from state to state in the median, beyond which time is in other units than seconds
WITHIN = 0.1  # share of the commands that must fall into the time of the states
SHORTEST = 1.0  # [s] of common time of commands and states that can tell anything


@dataclass(frozen=True)
class JointRecord:
    """Commands and states of one joint, on one clock.

    Raises ValueError, naming the joint, for a joint that is not in JOINT_NAMES, arrays that do not match, numbers that
    are not finite, time that does not increase, fewer than SHORTEST seconds of states after the first command, times that
    are not the same seconds, and numbers too large to be SI units.
    """

    joint: str
    command_time: np.ndarray  # (n,) [s] when each command was sent; it holds until the next one
    command_velocity: np.ndarray  # (n,) [rad/s], a gantry axis [m/s]
    state_time: np.ndarray  # (m,) [s] when each state arrived
    state_position: np.ndarray  # (m,) [rad], a gantry axis [m]

    def __post_init__(self) -> None:
        if self.joint not in JOINT_NAMES:
            raise ValueError(f"no joint {self.joint!r}; joints are {', '.join(JOINT_NAMES)}")
        for name in ("command_time", "command_velocity", "state_time", "state_position"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        for kind, values in (("command", self.command_velocity), ("state", self.state_position)):
            time = getattr(self, f"{kind}_time")
            if time.ndim != 1 or time.shape != values.shape or time.size == 0:
                raise ValueError(
                    f"{self.joint}: {kind} times and values of one shape (n,) are wanted, "
                    f"got {time.shape} and {values.shape}"
                )
            wrong = ~np.isfinite(time) | ~np.isfinite(values)
            if wrong.any():
                i = int(np.argmax(wrong))
                raise ValueError(f"{self.joint}: {kind} {i} is not finite: t={time[i]}, value={values[i]}")
            if np.any(np.diff(time) <= 0.0):
                i = int(np.argmax(np.diff(time) <= 0.0)) + 1
                raise ValueError(
                    f"{self.joint}: time must increase, {kind} {i} has t={time[i]:.6f} after t={time[i - 1]:.6f}"
                )
        common = self.state_time[-1] - max(self.state_time[0], self.command_time[0])
        if common < SHORTEST:
            raise ValueError(
                f"{self.joint}: {max(common, 0.0):.3g} s of states follow the first command, at least {SHORTEST:g} s "
                f"are wanted (commands {self.command_time[0]:.3f}..{self.command_time[-1]:.3f}, "
                f"states {self.state_time[0]:.3f}..{self.state_time[-1]:.3f}: one clock?)"
            )
        apart = float(np.median(np.diff(self.state_time)))
        if apart > SPARSEST:
            raise ValueError(
                f"{self.joint}: states are {apart:g} s apart, at most {SPARSEST:g} s are wanted (are these milliseconds?)"
            )
        within = np.mean((self.command_time >= self.state_time[0]) & (self.command_time <= self.state_time[-1]))
        if within < WITHIN and self.command_time[-1] > self.state_time[-1]:
            raise ValueError(
                f"{self.joint}: {within:.0%} of the commands fall into the time of the states (commands "
                f"{self.command_time[0]:.3f}..{self.command_time[-1]:.3f}, states {self.state_time[0]:.3f}.."
                f"{self.state_time[-1]:.3f}: are the commands' times milliseconds?)"
            )
        i = JOINT_NAMES.index(self.joint)
        _check_size(self.joint, "velocity", self.command_velocity, FASTEST * LIMITS.velocity[i])
        _check_size(self.joint, "position", self.state_position, WIDEST * max(-LIMITS.lower[i], LIMITS.upper[i]))
        _check_units(self)


def _check_size(joint: str, what: str, values: np.ndarray, largest: float) -> None:
    if np.abs(values).max() > largest:
        raise ValueError(
            f"{joint}: a {what} of {np.abs(values).max():g} is beyond {largest:g}; radians or metres are wanted "
            "(are these degrees or millimetres?)"
        )


def _check_units(record: JointRecord) -> None:
    """Refuses commands and states whose sizes differ by a factor between units."""
    hold = np.diff(record.command_time, append=max(record.command_time[-1], record.state_time[-1]))
    reached = np.concatenate([[0.0], np.cumsum(record.command_velocity * hold)])
    knots = np.append(record.command_time, record.command_time[-1] + hold[-1] + 1e-9)
    commanded, measured = np.interp(record.state_time, knots, reached), record.state_position
    if np.std(commanded) < 1e-6 or np.std(measured) < 1e-6:
        return
    ratio = np.std(measured) / np.std(commanded)
    correlation = abs(np.corrcoef(commanded, measured)[0, 1])
    for factor, units in ((180.0 / math.pi, "degrees beside radians"), (1000.0, "millimetres beside metres")):
        for f, larger in ((factor, "positions"), (1.0 / factor, "commands")):
            if correlation > 0.7 and 0.8 < ratio / f < 1.25:
                raise ValueError(
                    f"{record.joint}: positions move {ratio:.3g} times what the commands ask for; {units}? "
                    f"The {larger} are not in SI units"
                )


def _read(path: Path, value: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times and values of each joint in one file, in the order of the file."""
    columns = ("t", "joint", value)
    rows: dict[str, tuple[list[float], list[float]]] = {}
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        try:
            header = [name.strip() for name in next(reader, [])]
            missing = [name for name in columns if name not in header]
            if missing:
                raise ValueError(f"{path}: no column {missing}; wanted {list(columns)}, found {header}")
            time_at, joint_at, value_at = map(header.index, columns)
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise ValueError(f"{path}:{reader.line_num}: {len(row)} fields, the header has {len(header)}")
                joint = row[joint_at].strip()
                if joint not in JOINT_NAMES:
                    raise ValueError(
                        f"{path}:{reader.line_num}: no joint {joint!r}; joints are {', '.join(JOINT_NAMES)}"
                    )
                times, values = rows.setdefault(joint, ([], []))
                try:
                    times.append(float(row[time_at]))
                    values.append(float(row[value_at]))
                except ValueError as error:
                    raise ValueError(f"{path}:{reader.line_num}: t and {value} must be numbers, {error}") from None
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not a CSV file, {error}") from None
    if not rows:
        raise ValueError(f"{path}: no row")
    return {joint: (np.array(times), np.array(values)) for joint, (times, values) in rows.items()}


def read_robot_csv(command: str | os.PathLike, state: str | os.PathLike) -> tuple[JointRecord, ...]:
    """Records of the joints of a pair of files, in ``JOINT_NAMES`` order.

    Raises OSError for files that cannot be read and ValueError, naming file and line or joint, for content that is not
    as described above or for a joint that only one of the two files has.
    """
    command, state = Path(command), Path(state)
    commands, states = _read(command, "velocity"), _read(state, "position")
    for joint in JOINT_NAMES:
        if (joint in commands) != (joint in states):
            there, absent = (command, state) if joint in commands else (state, command)
            raise ValueError(f"{absent}: no row of {joint}, which {there} has")
    records = []
    for joint in (j for j in JOINT_NAMES if j in commands):
        try:
            records.append(JointRecord(joint, *commands[joint], *states[joint]))
        except ValueError as error:
            raise ValueError(f"{command}, {state}: {error}") from None
    return tuple(records)
