"""Logs of a diagnosis: the balls and joints they hold, and checks that they can be what they claim to be.

A log in millimetres, with swapped axes or in another frame would be fitted all the same, and answered with nonsense: so
its gravity, its bounces and its direction of flight are looked at first.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ballmodel.io.formats import GUESS, INDEX, SUFFIXES, read
from ballmodel.io.samples import TrackOptions
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.joint import JointRecord, read_robot_csv
from mjx_tt.diagnosis.tracks.frame import align
from mjx_tt.robot.robots import Robot

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
        parts = sorted(file.iterdir()) if file.is_dir() else [file]
        digest = hashlib.sha256(b"".join(part.read_bytes() for part in parts)).hexdigest()
        if digest in seen and file.name != ROBOT_FILES[0]:  # the same commands may be given twice
            raise ValueError(f"{file}: is the same log as {seen[digest]}, which would count twice")
        found[file], seen[digest] = digest, file
    return found


def load_logs(
    paths: Sequence[str | os.PathLike],
    robot: Robot | None = None,
    options: TrackOptions = GUESS,
    frame: str | None = None,
) -> Logs:
    """Reads logs: tracks of balls and pairs command.csv, state.csv (or a folder that holds them).

    Of several pairs the longest is used. Files of one folder share a frame.

    Args:
        paths: files and folders.
        robot: whose joints they are; None: the paper's.
        options: what is known of the tracks' columns, units and topic.
        frame: of the tracks (see ``tracks.frame.align``); None: found out.

    Raises:
        ValueError: names the file and what is wrong with it.
        FileNotFoundError: there is no such file.
    """
    files = hashes(paths)
    if not files:
        raise ValueError("no log was given")
    balls: list[Trajectory] = []
    joints, notes = longest([(str(folder), read_robot_csv(*pair, robot)) for folder, pair in _pairs(files).items()])
    tracks: dict[Path, list[Trajectory]] = {}
    for file in (f for f in files if f.name not in ROBOT_FILES):
        try:
            data = read(file, options=options)
        except ValueError as error:
            if file.suffix.lower() != ".mcap":
                raise
            raise ValueError(
                f"{error} (a session of `mjx-tt run` is read by "
                "`mjx-tt diagnose`, or by experiments.commands.diagnose.read_logs)"
            ) from None
        if not hasattr(data, "trajectories"):
            raise ValueError(
                f"{file}: holds single ball states, no trajectories: a diagnosis needs positions over "
                "time (`mjx-tt fit-human` takes such states)"
            )
        notes += tuple(f"{file.name}: {note}" for note in getattr(data, "notes", ()))
        single = len(data) == 1 and not data.trajectories[0].name
        tracks.setdefault(file.parent, []).extend(
            replace(t, name=file.stem) if single else t for t in data.trajectories
        )
    for folder, found in tracks.items():
        names = [file.name for file in files if file.parent == folder and file.name not in ROBOT_FILES]
        aligned, done = align(found, str(folder / names[0]) if len(names) == 1 else str(folder), frame)
        balls, notes = balls + list(aligned), notes + done
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
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_file() or (path / "metadata.yaml").is_file():  # a file, or a ROS 2 bag
        return [path]
    if (path / INDEX).is_file():
        return [path / INDEX]
    found = [p for p in sorted(path.iterdir()) if p.suffix.lower() in SUFFIXES]
    if not found:
        raise ValueError(f"{path}: holds no log; expected files of {', '.join(SUFFIXES)}")
    return found


def before_racket(t: Trajectory) -> Trajectory:
    """The trajectory up to where its motion along the table turns round."""
    y = t.position[1]
    if len(t) < 4:
        return t
    forward = np.sign(y[min(len(y) - 1, 10)] - y[0])
    back = np.flatnonzero(np.maximum.accumulate(forward * y) - forward * y > TURN)
    return t.part(0, max(int(np.argmax(forward * y[: back[0] + 1])), 1)) if back.size else t
