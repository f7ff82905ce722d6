"""``mjx-tt log``: logs of sessions at the robot, to list, check, salvage and export, and captures to replay."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from experiments import options
from experiments.commands import command
from experiments.errors import ConfigError, error_context
from experiments.options import argument, option
from experiments.progress import make_console


@command(
    "log",
    """\
  mjx-tt log list runs/robot
  mjx-tt log check runs/robot/20261121-153000.mcap
  mjx-tt log salvage runs/robot/20261121-153000.mcap.part
  mjx-tt log export runs/robot/20261121-153000.mcap --out tables/
  mjx-tt log lerobot runs/robot --out dataset/         a LeRobot data set of sessions
  mjx-tt log lerobot balls.csv --out dataset/          or of measured balls alone
  mjx-tt log replay arm.pcap --out arm.csv             a real arm's EGM, played to the emulated controller
""",
)
def log(
    action: Annotated[Literal["list", "check", "salvage", "export", "lerobot", "replay"], Parameter("ACTION")],
    /,
    *paths: Annotated[
        Path,
        argument("LOG", "an .mcap or .mcap.part; list: a folder; lerobot: .mcap, balls, or a folder; replay: a pcap"),
    ],
    out: Annotated[Path | None, option("PATH", "salvage and replay: the file; export and lerobot: the folder")] = None,
) -> int:
    """Lists, checks, salvages or exports the logs of a robot; replays a capture of its arm."""
    screen = make_console()
    if action == "list":
        list_logs(paths[0], screen)
    elif action == "check":
        return 1 if check(paths, screen) else 0
    elif action == "lerobot":
        lerobot(paths, out, screen)
    else:
        for path in paths:
            {"salvage": salvage, "export": export, "replay": replay}[action](path, out, screen)
    return 0


def list_logs(folder: Path, console: Console) -> None:
    """Prints the logs of a folder, oldest first; finished ones are not read through. Raises ConfigError for none."""
    from robot_io.log.scan import glance
    from robot_io.log.writer import SUFFIX, UNFINISHED

    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    paths = [path for path in folder.iterdir() if path.name.endswith((SUFFIX, UNFINISHED)) and path.is_file()]
    if not paths:
        raise ConfigError(f"{folder}: no logs ({SUFFIX} or {UNFINISHED}) in it")
    table = Table("log", "started (UTC)", "duration", "messages", "lost", "state", title_justify="left")
    for path in sorted(paths, key=lambda path: path.stat().st_mtime):
        with error_context():
            overview = glance(path)
        session, end = overview.metadata.get("session", {}), overview.metadata.get("end", {})
        table.add_row(
            path.name,
            session.get("started_utc", "-")[:19].replace("T", " "),
            f"{overview.duration:.1f} s",
            f"{overview.messages:,}",
            end.get("dropped", "unknown"),
            "finished" if overview.state == "sound" else overview.state,
        )
    console.print(table)


def check(paths: Iterable[Path], console: Console) -> int:
    """Reads logs through, checks every checksum and prints what is wrong; returns how many are not sound."""
    from robot_io import log

    faulty = 0
    for path in paths:
        with error_context():
            overview = log.check(path)
        faulty += overview.state != "sound"
        console.print(
            f"{path}: {overview.state}, {overview.messages:,} messages in {overview.duration:.1f} s", soft_wrap=True
        )
        for fault in overview.faults:
            console.print(f"  {fault}", soft_wrap=True)
        for topic, count in sorted(overview.counts.items()):
            console.print(f"  {topic:20} {count:>10,}")
    return faulty


def salvage(path: Path, out: Path | None, console: Console) -> Path:
    """Writes what is sound of a damaged or unfinished log as a proper file, and returns its path."""
    from robot_io import log

    with error_context():
        overview = log.salvage(path, out)
    console.print(f"{overview.path}: {overview.messages:,} messages, {overview.duration:.1f} s", soft_wrap=True)
    for line in overview.metadata["salvage"]["faults"].splitlines():
        console.print(f"  lost: {line}", soft_wrap=True)
    return overview.path


def export(path: Path, out: Path | None, console: Console) -> list[Path]:
    """Writes the tables of a log into a folder (its name without the suffix, if not given); returns their paths."""
    from robot_io import log
    from robot_io.log.writer import SUFFIX

    with error_context():
        written, balls = log.export(log.stream(path), out or path.with_name(path.name.removesuffix(SUFFIX)))
    for table in written:
        console.print(table, soft_wrap=True)
    console.print(f"{balls:,} balls; mjx-tt fit-human {written[0]} makes a distribution of them")
    return written


def lerobot(paths: Sequence[Path], out: Path | None, console: Console) -> None:
    """Writes sessions, or measured balls, as one LeRobot data set, and says what is not in it. Raises ConfigError."""
    if out is None:
        raise ConfigError("log lerobot needs --out: the folder of the data set")
    options.check_exists(*paths)
    from experiments.sharing import lerobot as data_sets
    from experiments.sharing import recordings

    recording = recordings.read([str(path) for path in paths])
    data_sets.write(recording, out)
    frames = sum(len(episode.columns["next.done"]) for episode in recording.episodes)
    made = f"{out}: {len(recording.episodes):,} episodes, {frames:,} frames at 75 Hz"
    console.print(made, *recording.notes, sep="\n", soft_wrap=True)


def replay(path: Path, out: Path | None, console: Console) -> None:
    """Plays a capture's EGM replies to the emulated controller, and says how the real one differs.

    ``out`` becomes a CSV of times [s], captured and replayed positions [rad].
    """
    options.check_exists(path)
    from robot_io.emulator import capture as captures
    from robot_io.emulator.arm import ArmParams

    with error_context():
        capture = captures.read(path)
        emulated = captures.replay(capture, ArmParams())
    captured, times = capture.positions, capture.times - capture.times[0]
    gaps = 1e3 * np.diff(times, append=times[-1])
    console.print(
        f"{path}: {len(times):,} packets of the controller, {capture.lost:,} lost, every {np.median(gaps):.1f} ms, "
        f"at most {gaps.max():.1f} ms; {len(capture.replies):,} replies, {capture.skipped:,} other packets",
        soft_wrap=True,
    )
    for i, apart in enumerate(np.degrees(captured - emulated).T):
        rough, worst = np.sqrt(np.mean(apart**2)), np.abs(apart).max()
        console.print(f"  joint {i + 1}: {rough:.3f} deg from the emulated controller, at most {worst:.3f} deg")
    if out is not None:
        names = [f"{kind}_{i + 1}" for kind in ("captured", "replayed") for i in range(captured.shape[1])]
        table = np.column_stack([times, captured, emulated])
        np.savetxt(out, table, fmt="%.12g", delimiter=",", header=",".join(["time", *names]), comments="")
        console.print(f"{out}: times [s] and positions [rad]", soft_wrap=True)
