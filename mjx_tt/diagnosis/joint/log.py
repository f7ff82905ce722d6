"""Logs of the joints: velocity commands and measured positions, read, checked and made ready for fits.

A log is a pair of CSV files: ``command.csv`` with columns t, joint, velocity and ``state.csv`` with columns t, joint,
position; joints by name, SI units, rows of different joints in any mixture, each joint's own rows in order of time. A
value that is nan was not reported.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse, Motion
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot

WINDOW = 2.0  # [s] of a free offset and of one cluster of the errors, a tenth of a log of less than 20 s
SAMPLES = 4000  # states of a joint that a fit looks at, evenly spread over the log
FASTEST = 5.0  # times a joint's rated speed beyond which a command is in other units than rad/s or m/s
WIDEST = 5.0  # times a joint's range beyond which a position is in other units than rad or m
SPARSEST = 0.5  # [s] from state to state in the median, beyond which time is in other units than seconds
WITHIN = 0.1  # share of the commands that must fall into the time of the states
SHORTEST = 1.0  # [s] of common time of commands and states that can tell anything
PAUSE, TIMES = 0.5, 5.0  # [s], and times the usual interval of the states, that nobody watched the joint


@dataclass(frozen=True)
class JointRecord:
    """Commands and states of one joint, on one clock.

    Raises ValueError, naming the joint, for a joint that the robot does not have, arrays that do not match, numbers
    that are not finite, time that does not increase, fewer than SHORTEST seconds of states after the first command,
    times that are not the same seconds, and numbers too large to be SI units.
    """

    joint: str
    command_time: np.ndarray  # (n,) [s] when each command was sent; it holds until the next one
    command_velocity: np.ndarray  # (n,) [rad/s], an axis [m/s]
    state_time: np.ndarray  # (m,) [s] when each state arrived
    state_position: np.ndarray  # (m,) [rad], an axis [m]
    robot: Robot = dataclasses.field(default_factory=robots.paper)

    def __post_init__(self) -> None:
        contract = self.robot.contract
        if self.joint not in contract.joints:
            raise ValueError(f"no joint {self.joint!r}; joints are {', '.join(contract.joints)}")
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
                f"{self.joint}: states are {apart:g} s apart, at most {SPARSEST:g} s are wanted "
                "(are these milliseconds?)"
            )
        within = np.mean((self.command_time >= self.state_time[0]) & (self.command_time <= self.state_time[-1]))
        if within < WITHIN and self.command_time[-1] > self.state_time[-1]:
            raise ValueError(
                f"{self.joint}: {within:.0%} of the commands fall into the time of the states (commands "
                f"{self.command_time[0]:.3f}..{self.command_time[-1]:.3f}, states {self.state_time[0]:.3f}.."
                f"{self.state_time[-1]:.3f}: are the commands' times milliseconds?)"
            )
        i, limits = contract.joints.index(self.joint), contract.limits
        _check_size(self.joint, "velocity", self.command_velocity, FASTEST * limits.velocity[i])
        _check_size(self.joint, "position", self.state_position, WIDEST * max(-limits.lower[i], limits.upper[i]))
        _check_units(self)

    def resumed(self) -> np.ndarray:
        """Times (k,) [s] of the first states after pauses, in which somebody may have moved the joint."""
        apart = np.diff(self.state_time)
        return self.state_time[1:][apart > max(PAUSE, TIMES * float(np.median(apart)))]

    def between(self, begin: float, end: float) -> JointRecord:
        """Commands and states from one moment [s] of the log's clock to another."""
        sent, reported = ((t >= begin) & (t <= end) for t in (self.command_time, self.state_time))
        return dataclasses.replace(
            self,
            command_time=self.command_time[sent],
            command_velocity=self.command_velocity[sent],
            state_time=self.state_time[reported],
            state_position=self.state_position[reported],
        )


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


def _read(path: Path, value: str, joints: tuple[str, ...]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
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
                if joint not in joints:
                    raise ValueError(f"{path}:{reader.line_num}: no joint {joint!r}; joints are {', '.join(joints)}")
                times, values = rows.setdefault(joint, ([], []))
                try:
                    at, value_then = float(row[time_at]), float(row[value_at])
                    if not math.isnan(value_then):  # a joint that has not reported yet
                        times.append(at)
                        values.append(value_then)
                except ValueError as error:
                    raise ValueError(f"{path}:{reader.line_num}: t and {value} must be numbers, {error}") from None
        except (csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not a CSV file, {error}") from None
    if not rows:
        raise ValueError(f"{path}: no row")
    return {joint: (np.array(times), np.array(values)) for joint, (times, values) in rows.items()}


def read_robot_csv(
    command: str | os.PathLike, state: str | os.PathLike, robot: Robot | None = None
) -> tuple[JointRecord, ...]:
    """Records of the joints of a pair of files, in the order of the robot, None for the paper's.

    Raises OSError for files that cannot be read and ValueError, naming file and line or joint, for content that is not
    as described above or for a joint that only one of the two files has.
    """
    command, state = Path(command), Path(state)
    robot = robots.paper() if robot is None else robot
    joints = robot.contract.joints
    commands, states = _read(command, "velocity", joints), _read(state, "position", joints)
    for joint in joints:
        if (joint in commands) != (joint in states):
            there, absent = (command, state) if joint in commands else (state, command)
            raise ValueError(f"{absent}: no row of {joint}, which {there} has")
    records = []
    for joint in (j for j in joints if j in commands):
        try:
            records.append(JointRecord(joint, *commands[joint], *states[joint], robot))
        except ValueError as error:
            raise ValueError(f"{command}, {state}: {error}") from None
    return tuple(records)


class JointLog:
    """Commands, states (n,) and nominal response of one joint.

    base: the nominal parameters that a fit may change; the two delays are one sum, under action_delay.
    sizes: of the commands that are not zero; fastest: the largest of them, 0 for a joint at rest.
    rated_velocity, rated_acceleration: what the joint is built for.
    every: indices of the states after the first command; time and measured (n,) are SAMPLES of them at most.
    starts, window: first samples of the windows (k,) and each sample's window (n,); a pause ends one.
    """

    def __init__(self, record: JointRecord, nominal: JointResponse, beside: Motion | None = None):
        self.record, self.nominal, self.beside = record, nominal, beside
        self.base = {f.name: getattr(nominal, f.name) for f in dataclasses.fields(nominal)}
        self.base["action_delay"] += self.base.pop("observation_delay")
        del self.base["joint_offset"]
        u = record.command_velocity
        keep = np.concatenate([[True], u[1:] != u[:-1]])  # a repeated command changes nothing
        self.command_time, self.command_velocity = record.command_time[keep], u[keep]
        sizes = np.abs(u)
        self.sizes = sizes[sizes > 0.0]
        self.fastest = float(sizes.max())
        contract = record.robot.contract
        i, limits = contract.joints.index(record.joint), contract.limits
        self.unit = contract.units[i]
        self.rated_velocity, self.rated_acceleration = limits.velocity[i], limits.acceleration[i]
        self.every = use = np.flatnonzero(record.state_time >= record.command_time[0])
        if use.size > SAMPLES:
            use = use[np.round(np.linspace(0, use.size - 1, SAMPLES)).astype(int)]
        self.time, self.measured = record.state_time[use], record.state_position[use]
        self.width = min(max((self.time[-1] - self.time[0]) / 10.0, 0.3), WINDOW)
        self._resumed = record.resumed()
        self.starts, self.window = self.windows(self.time)

    def windows(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First samples of the windows (k,) and each sample's window (n,)."""
        window = np.floor((time - time[0]) / self.width).astype(int)
        watch = np.searchsorted(self._resumed, time, side="right")
        changed = (window[1:] != window[:-1]) | (watch[1:] != watch[:-1])
        starts = np.flatnonzero(np.concatenate([[True], changed]))
        return starts, np.repeat(np.arange(starts.size), np.diff(np.append(starts, time.size)))

    def response(self, values: Mapping[str, float]) -> JointResponse:
        """The nominal response with the sum of the delays as action_delay and some parameters replaced."""
        return dataclasses.replace(self.nominal, **{**self.base, **values}, observation_delay=0.0, joint_offset=0.0)

    def simulate(self, values: Mapping[str, float], time: np.ndarray | None = None) -> np.ndarray:
        """Positions of a joint with these parameters, at ``time`` or at the samples."""
        time = self.time if time is None else time
        return self.response(values).simulate(self.command_time, self.command_velocity, time, beside=self.beside)

    def centred(self, x: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """x (n, ...) less its mean in each window."""
        if weight is None:
            count = np.diff(np.append(self.starts, self.time.size))
            mean = (np.add.reduceat(x, self.starts, axis=0).T / count).T
        else:
            total = np.add.reduceat((x.T * weight).T, self.starts, axis=0)
            mean = (total.T / np.add.reduceat(weight, self.starts)).T
        return x - mean[self.window]
