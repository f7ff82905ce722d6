"""``mjx-tt calibrate``: tracker, robot and clock of one installation, from measured points and logs into a YAML."""

from __future__ import annotations

from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.console import Console

from ballmodel.constants import PADDLE_RADIUS
from experiments import options
from experiments.commands import command
from experiments.config.files import read_yaml
from experiments.errors import ConfigError, error_context
from experiments.options import argument, existing, option
from experiments.progress import make_console
from experiments.runs import run_dir
from robot_io.calibrated import Calibration, ClockCalibration, RobotCalibration, TrackerCalibration
from robot_io.contract import PAPER


@command(
    "calibrate",
    """\
  mjx-tt calibrate tracker ball.csv              table_x, table_y, table_z and ball_x, ball_y, ball_z of every point
  mjx-tt calibrate robot touches.csv --robot robot.yaml        table_x, ... and gantry_x ... joint_6 of every touch
  mjx-tt calibrate robot touches.csv my_arm --robot robot.yaml      of a robot of your own, or one that comes with it
  mjx-tt calibrate clock runs/robot/20261121-153000.mcap       a session of half a minute or more

Writes calibration.yaml, each part beside the others; robot.yaml names it: "calibration: calibration.yaml".
mjx-tt robot check writes the ball's columns of the points, robot jog the joints' as well; the table's are yours.
""",
)
def calibrate(
    part: Annotated[Literal["tracker", "robot", "clock"], Parameter("PART")],
    source: Annotated[Path, argument("FILE", "CSV of points, or the log of a session", existing())],
    name: Annotated[
        str | None, Parameter("ROBOT", help="robot: the installed one, by folder or name (default: the paper's)")
    ] = None,
    /,
    *,
    robot: Annotated[
        Path | None, option("YAML", "robot.yaml whose axis zeros are stored with the robot's", existing("--robot"))
    ] = None,
    out: Annotated[Path, option("YAML", "calibration to write or extend")] = Path("calibration.yaml"),
) -> None:
    """Calibrates tracker, robot and clock from measured points and logs."""
    if name is not None and part != "robot":
        raise ConfigError(f"{name}: the {part}'s calibration is of no robot; allowed with calibrate robot")
    options.check_writable(out.parent)
    from experiments.config import robot as robots

    screen = make_console()
    known = robots.load_calibration(out) if out.exists() else Calibration()
    found: TrackerCalibration | RobotCalibration | ClockCalibration
    if part == "tracker":
        found = _tracker(source, screen)
    elif part == "robot":
        found = _robot(source, name, robot, screen)
    else:
        found = _clock(source, known, screen)
    # What run would refuse is not written.
    known = robots.fill(Calibration, robots.plain(known) | {part: asdict(found)}, str(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    run_dir.write_yaml(out, robots.plain(known))
    screen.print(f"{out}: {part} written; robot.yaml names it: calibration: {out.name}")


def _today() -> str:
    return date.today().isoformat()


def _tracker(path: Path, screen: Console) -> TrackerCalibration:
    from robot_io.calibration import points, tracker

    with error_context():
        lines, (table, seen) = points.read(path, points.TABLE, points.BALL)
    with error_context(str(path)):
        fit = tracker.fit(table, seen, _today())
    _show_points(screen, path, lines, fit.residuals, fit.used)
    position, turn = 1e3 * fit.deviation[:3], 1e3 * fit.deviation[3:]
    screen.print(
        f"residual {1e3 * fit.calibration.residual:.2f} mm; standard deviations: {position[0]:.2f} mm at the points' "
        f"centre, turned about x, y, z {turn[0]:.2f}, {turn[1]:.2f}, {turn[2]:.2f} mrad"
    )
    return fit.calibration


def _robot(path: Path, name: str | None, installed: Path | None, screen: Console) -> RobotCalibration:
    """Of the robot of that name or in that folder; None: the one that robot.yaml, ``installed``, names."""
    from experiments.config import robot as robots
    from mjx_tt.robot import robots as simulated
    from robot_io.calibration import points, robot
    from robot_io.control.config import RobotConfig

    name = name or (robots.named(installed) if installed else None)
    contract, end = PAPER, None  # end (3,) [m] of the blade in the last joint's frame
    if name is not None:
        with error_context():
            standing = simulated.load(name)
        if standing.contract != PAPER:
            frame, contract = standing.paddle(), standing.contract
            end = frame.pos - standing.chain().links[-1].anchor + PADDLE_RADIUS * frame.rot[:, 0]
    config = robots.load_robot(installed, False, contract) if installed else RobotConfig.of(contract)
    with error_context():
        lines, table, joints, paddle = points.touched(path, contract, end)
    with error_context(str(path)):
        zeros = tuple(axis.zero for axis in config.axes)
        fit = robot.fit(table, joints, paddle, zeros, _today(), contract)
    _show_points(screen, path, lines, fit.residuals, fit.used)
    found = fit.calibration
    values = (*found.joint_zeros, *found.base_position, *found.base_rotation, *found.tip)
    for name, value, deviation in zip(robot.names(contract), values, fit.deviation, strict=True):
        unit = "mrad" if "zero" in name or "turned" in name else "mm"
        screen.print(f"  {name:24} {1e3 * value:+8.2f} +- {1e3 * deviation:.2f} {unit}")
    screen.print(f"residual {1e3 * found.residual:.2f} mm")
    for text in fit.unknown:
        screen.print(f"not separated by these poses, left near 0: {text}", style="yellow")
    return found


def _clock(path: Path, known: Calibration, screen: Console) -> ClockCalibration:
    from experiments.config import robot as robots
    from robot_io import log
    from robot_io.calibration import clock

    with error_context():
        session = log.read(path)
    then = session.attachments.get("calibration.yaml")  # what joints and ball were logged with
    if then is not None:
        where = f"{path}: calibration.yaml"
        known = robots.fill(Calibration, read_yaml(then.decode(), where) or {}, where)
    with error_context(str(path)):
        found, told = clock.fit(session, known, _today())
    for line in told:
        screen.print(line)
    return found


def _show_points(screen: Console, path: Path, lines: list[int], residuals: np.ndarray, used: np.ndarray) -> None:
    for line, residual, good in zip(lines, residuals, used, strict=True):
        if not good:
            screen.print(f"{path}: line {line}: {1e3 * residual:.1f} mm off: not used", style="yellow")
    screen.print(f"{int(used.sum())} of {len(lines)} points used")
