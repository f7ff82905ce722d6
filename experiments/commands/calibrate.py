"""``mjx-tt calibrate``: tracker, robot and clock of one installation, from measured points and logs into a YAML."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from experiments import options
from experiments.errors import ConfigError, error_context
from experiments.options import option

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from robot_io.calibrated import Calibration, ClockCalibration, RobotCalibration, TrackerCalibration
    from robot_io.contract import Contract

app = options.command(
    "calibrate",
    "calibrate tracker, robot and clock from measured points and logs",
    """\
  mjx-tt calibrate tracker ball.csv              table_x, table_y, table_z and ball_x, ball_y, ball_z of every point
  mjx-tt calibrate robot touches.csv --robot robot.yaml        table_x, ... and gantry_x ... joint_6 of every touch
  mjx-tt calibrate robot touches.csv my_arm --robot robot.yaml      of a robot of your own, or one that comes with it
  mjx-tt calibrate clock runs/robot/20261121-153000.mcap       a session of half a minute or more

Writes calibration.yaml, each part beside the others; robot.yaml names it: "calibration: calibration.yaml".
mjx-tt robot check writes the ball's columns of the points, robot jog the joints' as well; the table's are yours.
""",
)


@app.default
def calibrate(
    part: Annotated[Literal["tracker", "robot", "clock"], Parameter("PART")],
    source: Annotated[str, Parameter("FILE", help="CSV of points, or the log of a session")],
    name: Annotated[
        str | None, Parameter("ROBOT", help="robot: the installed one, by folder or name (default: the paper's)")
    ] = None,
    /,
    *,
    robot: Annotated[str | None, option("YAML", "robot.yaml whose axis zeros are stored with the robot's")] = None,
    out: Annotated[str, option("YAML", "calibration to write or extend")] = "calibration.yaml",
) -> int:
    """Returns the exit status."""
    options.check_exists(source, robot)
    if name is not None and part != "robot":
        raise ConfigError(f"{name}: the {part}'s calibration is of no robot; allowed with calibrate robot")
    target = Path(out)
    options.check_writable(target.parent)
    from dataclasses import asdict
    from datetime import date

    from experiments.config import robot as robots
    from experiments.progress import make_console
    from experiments.runs import run_dir
    from robot_io.calibrated import Calibration
    from robot_io.contract import PAPER
    from robot_io.control.config import RobotConfig

    path, today, screen = Path(source), date.today().isoformat(), make_console()
    known = robots.load_calibration(target) if target.exists() else Calibration()
    found: TrackerCalibration | RobotCalibration | ClockCalibration
    if part == "tracker":
        found = _tracker(path, today, screen)
    elif part == "robot":
        name = name or (robots.named(robot) if robot else None)
        contract, end = (PAPER, None) if name is None else _load_standing(name)
        config = robots.load_robot(robot, False, contract) if robot else RobotConfig.of(contract)
        found = _robot(path, tuple(axis.zero for axis in config.axes), today, screen, contract, end)
    else:
        found = _clock(path, known, today, screen)
    # What run would refuse is not written.
    known = robots.fill(Calibration, robots.plain(known) | {part: asdict(found)}, str(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    run_dir.write_yaml(target, robots.plain(known))
    screen.print(f"{target}: {part} written; robot.yaml names it: calibration: {target.name}")
    return 0


def _tracker(path: Path, today: str, screen: Console) -> TrackerCalibration:
    from robot_io.calibration import points, tracker

    with error_context():
        lines, (table, seen) = points.read(path, points.TABLE, points.BALL)
    with error_context(str(path)):
        fit = tracker.fit(table, seen, today)
    _show_points(screen, path, lines, fit.residuals, fit.used)
    position, turn = 1e3 * fit.deviation[:3], 1e3 * fit.deviation[3:]
    screen.print(
        f"residual {1e3 * fit.calibration.residual:.2f} mm; standard deviations: {position[0]:.2f} mm at the points' "
        f"centre, turned about x, y, z {turn[0]:.2f}, {turn[1]:.2f}, {turn[2]:.2f} mrad"
    )
    return fit.calibration


def _load_standing(name: str) -> tuple[Contract, np.ndarray | None]:
    """Contract of a robot by its folder or name, and the end (3,) [m] of its blade in the last joint's frame.

    Raises ConfigError.
    """
    from ballmodel.constants import PADDLE_RADIUS
    from mjx_tt.robot import robots
    from robot_io.contract import PAPER

    with error_context():
        robot = robots.load(name)
    if robot.contract == PAPER:
        return PAPER, None
    frame = robot.paddle()
    return robot.contract, frame.pos - robot.chain().links[-1].anchor + PADDLE_RADIUS * frame.rot[:, 0]


def _robot(
    path: Path, zeros: tuple[float, ...], today: str, screen: Console, contract: Contract, end: np.ndarray | None
) -> RobotCalibration:
    from robot_io.calibration import points, robot

    with error_context():
        lines, table, joints, paddle = points.touched(path, contract, end)
    with error_context(str(path)):
        fit = robot.fit(table, joints, paddle, zeros, today, contract)
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


def _clock(path: Path, known: Calibration, today: str, screen: Console) -> ClockCalibration:
    from experiments.config import robot as robots
    from experiments.config.files import read_yaml
    from robot_io import log
    from robot_io.calibrated import Calibration
    from robot_io.calibration import clock

    with error_context():
        session = log.read(path)
    then = session.attachments.get("calibration.yaml")  # what joints and ball were logged with
    if then is not None:
        where = f"{path}: calibration.yaml"
        known = robots.fill(Calibration, read_yaml(then.decode(), where) or {}, where)
    with error_context(str(path)):
        found, told = clock.fit(session, known, today)
    for line in told:
        screen.print(line)
    return found


def _show_points(screen: Console, path: Path, lines: list[int], residuals: np.ndarray, used: np.ndarray) -> None:
    for line, residual, good in zip(lines, residuals, used, strict=True):
        if not good:
            screen.print(f"{path}: line {line}: {1e3 * residual:.1f} mm off: not used", style="yellow")
    screen.print(f"{int(used.sum())} of {len(lines)} points used")
