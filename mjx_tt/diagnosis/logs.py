"""Logs of a diagnosis: the balls and joints they hold, and checks that they can be what they claim to be.

A log in millimetres, with swapped axes or in another frame would be fitted all the same, and answered with nonsense: so
its gravity, its bounces and its direction of flight are looked at first.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ballmodel.constants import BALL_RADIUS
from ballmodel.io.formats import read
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.joint import JointRecord, read_robot_csv

GRAVITY_RANGE = (5.0, 15.0)  # [m/s^2] that a fall in metres and seconds may show
BOUNCE_RANGE = (-0.05, 0.12)  # [m] height of the ball's centre at a bounce in the table frame
TURN = 0.15  # [m] that a ball comes back before it counts as hit
ROBOT_FILES = ("command.csv", "state.csv")


@dataclass(frozen=True)
class Logs:
    """Logs as they were read."""

    balls: tuple[Trajectory, ...]
    joints: tuple[JointRecord, ...]
    sources: dict[str, str]  # file -> SHA-256
    notes: tuple[str, ...] = ()  # what was not used, and why


def hashes(paths: Sequence[str | os.PathLike]) -> dict[Path, str]:
    """SHA-256 of every log: of the files given, and of the logs in the folders given.

    Raises ValueError for a folder without logs and for a log that is given twice, FileNotFoundError for what is not
    there.
    """
    found: dict[Path, str] = {}
    seen: dict[str, Path] = {}
    for file in (file for path in map(Path, paths) for file in _expand(path)):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        if digest in seen and file.name != ROBOT_FILES[0]:  # the same commands may be given twice
            raise ValueError(f"{file}: is the same log as {seen[digest]}, which would count twice")
        found[file], seen[digest] = digest, file
    return found


def load_logs(paths: Sequence[str | os.PathLike]) -> Logs:
    """Reads logs: ball trajectories (CSV, MCAP, AIMY) and pairs command.csv, state.csv (or a folder that holds them).

    Of several pairs the longest is used. Raises ValueError naming the file and what is wrong with it,
    FileNotFoundError when there is none.
    """
    files = hashes(paths)
    if not files:
        raise ValueError("no log was given")
    balls: list[Trajectory] = []
    joints, notes = longest([(str(folder), read_robot_csv(*pair)) for folder, pair in _pairs(files).items()])
    for file in (f for f in files if f.name not in ROBOT_FILES):
        try:
            data = read(file)
        except ValueError as error:
            if file.suffix.lower() != ".mcap":
                raise
            raise ValueError(
                f"{error} (a log of balls holds messages on /ball; a session of `mjx-tt run` is read by "
                "`mjx-tt diagnose`, or by experiments.commands.diagnose.read_logs)"
            ) from None
        if not hasattr(data, "trajectories"):
            raise ValueError(
                f"{file}: holds single ball states, no trajectories: a diagnosis needs positions over time"
            )
        check(data.trajectories, str(file))
        balls += data.trajectories
    return Logs(tuple(balls), joints, {str(file): digest for file, digest in files.items()}, notes)


def longest(
    records: Sequence[tuple[str, tuple[JointRecord, ...]]],
) -> tuple[tuple[JointRecord, ...], tuple[str, ...]]:
    """Of several logs of joints, each with its name, the one with the most states; and a note on those left out."""
    if not records:
        return (), ()
    name, chosen = max(records, key=lambda r: sum(joint.state_time.size for joint in r[1]))
    others = ", ".join(other for other, _ in records if other != name)
    return chosen, (
        f"the joints are judged by {name} alone, the longest log of them; not by {others}",
    ) if others else ()


def _pairs(files: Iterable[Path]) -> dict[Path, tuple[Path, Path]]:
    """The command.csv and state.csv of each folder. Raises ValueError where one of the two is not among the files."""
    robot = [f for f in files if f.name in ROBOT_FILES]
    pairs = {}
    for folder in dict.fromkeys(f.parent for f in robot):
        mine = {f.name: f for f in robot if f.parent == folder}
        for name, other in (ROBOT_FILES, ROBOT_FILES[::-1]):
            if other not in mine:
                raise ValueError(
                    f"{mine[name]}: the joints' {other} is missing beside it: commands and positions are needed"
                )
        pairs[folder] = (mine["command.csv"], mine["state.csv"])
    return pairs


def _expand(path: Path) -> list[Path]:
    if not path.is_dir():
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file or folder")
        return [path]
    found = [p for p in sorted(path.iterdir()) if p.suffix.lower() in (".csv", ".mcap", ".hdf5", ".h5")]
    if not found:
        raise ValueError(f"{path}: holds no .csv, .mcap or .hdf5")
    return found


def before_racket(t: Trajectory) -> Trajectory:
    """The trajectory up to where its motion along the table turns round."""
    y = t.position[1]
    if len(t) < 4:
        return t
    forward = np.sign(y[min(len(y) - 1, 10)] - y[0])
    back = np.flatnonzero(np.maximum.accumulate(forward * y) - forward * y > TURN)
    return t.part(0, max(int(np.argmax(forward * y[: back[0] + 1])), 1)) if back.size else t


def check(trajectories: Sequence[Trajectory], source: str) -> None:
    """Refuses balls that cannot be metres and seconds in the table frame.

    Raises ValueError that describes what they look like.
    """
    if not trajectories:
        raise ValueError(f"{source}: holds no trajectory")
    long = [cut for t in trajectories if len(cut := before_racket(t)) >= 8] or [t for t in trajectories if len(t) >= 8]
    if not long:
        raise ValueError(f"{source}: no trajectory has 8 samples, the longest has {max(map(len, trajectories))}")
    bend = np.median([_acceleration(t) for t in long], axis=0)
    down = int(np.argmax(np.abs(bend)))
    if np.abs(bend[down]) > 100.0 * GRAVITY_RANGE[1]:
        raise ValueError(
            f"{source}: balls fall at {np.abs(bend[down]):.0f} per s^2, metres and seconds are wanted "
            "(are these millimetres?)"
        )
    if not GRAVITY_RANGE[0] < np.abs(bend[down]) < GRAVITY_RANGE[1]:
        raise ValueError(
            f"{source}: balls accelerate by ({', '.join(f'{a:.3g}' for a in bend)}) in x, y, z; a fall of 9.8 m/s^2 "
            "along -z is wanted (wrong unit of length or time, or no free flights?)"
        )
    if down != 2:
        raise ValueError(f"{source}: balls fall along {'xyz'[down]}, z must point up (swapped axes?)")
    if bend[2] > 0.0:
        raise ValueError(f"{source}: balls fall towards +z, z must point up")
    travel = np.median([np.ptp(t.position, axis=1) for t in long], axis=0)
    if travel[0] > 2.0 * travel[1]:
        raise ValueError(
            f"{source}: balls travel {travel[0]:.2f} m along x and {travel[1]:.2f} m along y; y is the table's length "
            "(swapped axes?)"
        )
    heights = [t.position[2, k] for t in long if (k := _lowest_turn(t)) is not None]
    if len(heights) >= max(3, 0.2 * len(long)):
        height = float(np.median(heights))
        if not BOUNCE_RANGE[0] < height < BOUNCE_RANGE[1]:
            raise ValueError(
                f"{source}: balls bounce at z = {height:.3f} m; in the table frame the ball's centre bounces at "
                f"z = {BALL_RADIUS} m (another frame: is z measured from the floor, or from the camera?)"
            )
    middle = np.median(np.concatenate([t.position for t in long], axis=1), axis=1)
    if abs(middle[0]) > 1.5 or abs(middle[1]) > 2.5:
        raise ValueError(
            f"{source}: the balls' middle is x = {middle[0]:.2f}, y = {middle[1]:.2f} m, far from the table's centre "
            "(another frame?)"
        )


def _acceleration(t: Trajectory) -> np.ndarray:
    """(3,) second derivative of a parabola through the longest part of the flight without a turn upwards."""
    stop = _lowest_turn(t)
    part = slice(0, len(t) if stop is None else max(stop, 8))
    if stop is not None and stop < 8:
        part = slice(stop + 1, len(t)) if len(t) - stop > 8 else slice(0, len(t))
    time = t.time[part] - t.time[part][0]
    return 2.0 * np.polynomial.polynomial.polyfit(time, t.position[:, part].T, 2)[2]


def _lowest_turn(t: Trajectory) -> int | None:
    """Sample of the sharpest turn from falling to rising, whatever its height."""
    z = t.position[2]
    if len(t) < 12:
        return None
    k = int(np.argmin(z[3:-3])) + 3
    before, after = (z[k] - z[k - 3]) / (t.time[k] - t.time[k - 3]), (z[k + 3] - z[k]) / (t.time[k + 3] - t.time[k])
    scale = max(abs(before), abs(after), 1e-9)
    return k if before < -0.3 * scale and after > 0.3 * scale else None
