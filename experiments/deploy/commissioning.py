"""``mjx-tt robot``: a dry run, and small motions by hand; both note points for a calibration."""

from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy.operator_console import KEYS, QUIT, Key, Keyboard, View
from experiments.deploy.session import Session
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES, N_JOINTS
from robot_io.control import messages, process
from robot_io.control.config import RobotConfig
from robot_io.control.messages import Request, Status
from robot_io.errors import RefusedError

COLUMNS = ("table_x", "table_y", "table_z", "ball_x", "ball_y", "ball_z", *JOINT_NAMES)
MARK = "m"
MARK_TIME = 1.0  # [s] over which a mark takes the mean
STILL = 0.003, 0.002  # [m] of the ball, [m] or [rad] of the joints: spread within that time above which it moves
STEPS = ((0.001, 0.002), (0.005, 0.01), (0.02, 0.05))  # [m], [rad] of small, middle and large steps
JOG_KEYS = {
    **{key: KEYS[key] for key in ("p", "a", " ", "r")},
    "1..8": Key("choose a joint"),
    "x y z": Key("or the blade, along an axis of the table"),
    "+ -": Key("move a step"),
    "s": Key("size of the steps"),
    MARK: Key("note this point"),
    QUIT: KEYS[QUIT],
}
CHECK_KEYS = {**{key: KEYS[key] for key in ("a", " ", "r")}, MARK: Key("note where the ball lies"), QUIT: KEYS[QUIT]}


def check(
    robot: Path, artefact: Path | None, log_folder: Path, points: Path, seconds: float | None, console: Console
) -> int:
    """Compute and log everything, send nothing: tracker and arm are heard, arm and axes move in thought."""
    return _operate(robot, artefact, log_folder, points, seconds, console, dry=True)


def jog(robot: Path, log_folder: Path, points: Path, seconds: float | None, console: Console) -> int:
    """Move the robot in small steps through the safety gate."""
    return _operate(robot, None, log_folder, points, seconds, console, dry=False)


class Jogger:
    """Choice of joint or axis and of the step's size, by keys."""

    def __init__(self) -> None:
        self._chosen: int | str = 0
        self._size = 0

    def pressed(self, key: str) -> Request | None:
        """Request of a key; None where it only chooses, or means nothing."""
        if key in "12345678":
            self._chosen = int(key) - 1
        elif key in "xyz":
            self._chosen = key
        elif key == "s":
            self._size = (self._size + 1) % len(STEPS)
        elif key in "+-":
            return self._step(1.0 if key == "+" else -1.0)
        return None

    def _step(self, sign: float) -> Request:
        metres, radians = STEPS[self._size]
        if isinstance(self._chosen, str):
            return messages.JogBlade(tuple(sign * metres * (axis == self._chosen) for axis in "xyz"))
        size = metres if self._chosen in FESTO_JOINTS else radians
        return messages.Jog(tuple(sign * size * (i == self._chosen) for i in range(N_JOINTS)))

    def __str__(self) -> str:
        metres, radians = STEPS[self._size]
        if isinstance(self._chosen, str):
            return f"blade along {self._chosen}, {1e3 * metres:g} mm a step"
        name = JOINT_NAMES[self._chosen]
        return f"{name}, {f'{1e3 * metres:g} mm' if self._chosen in FESTO_JOINTS else f'{1e3 * radians:g} mrad'} a step"


class Marks:
    """Means over ``MARK_TIME`` of what tracker and joints report, before any calibration, as lines of a CSV."""

    def __init__(self, path: Path, config: RobotConfig, with_joints: bool) -> None:
        self._path, self._found, self._with_joints = path, config.calibration, with_joints
        self._until = -np.inf
        self._balls: list[np.ndarray] = []
        self._joints: list[np.ndarray] = []

    def begin(self) -> None:
        self._until, self._balls, self._joints = time.monotonic() + MARK_TIME, [], []

    def take(self, status: Status) -> str | None:
        """Take a state; a sentence when a mark was written or given up."""
        if self._until == -np.inf:
            return None
        if status.ball is not None:
            self._balls.append(self._found.tracker.inward(np.array(status.ball)))
        self._joints.append(np.array([position for _, position, _ in status.joints]))
        if time.monotonic() < self._until:
            return None
        self._until = -np.inf
        ball, joints = _steady(self._balls, STILL[0]), _steady(self._joints, STILL[1])
        if ball is None and (joints is None or not self._with_joints):
            return "not noted: nothing stands still"
        if joints is not None:
            joints[2:] -= self._found.robot.joint_zeros
        values = ["", "", "", *_cells(ball, 3), *_cells(joints if self._with_joints else None, N_JOINTS)]
        new = not self._path.exists()
        with open(self._path, "a", encoding="utf-8", newline="") as stream:
            lines = csv.writer(stream)
            lines.writerows([COLUMNS, values] if new else [values])
        return f"noted in {self._path}; fill in table_x, table_y, table_z of its last line"


def _steady(values: list[np.ndarray], spread: float) -> np.ndarray | None:
    """Mean, where there are some, all finite, and they do not differ."""
    if not values or not np.isfinite(values).all() or (np.std(values, axis=0) > spread).any():
        return None
    return np.mean(values, axis=0)


def _cells(values: np.ndarray | None, count: int) -> list[str]:
    return [""] * count if values is None else [f"{value:.6f}" for value in values]


def _operate(
    robot: Path,
    artefact: Path | None,
    log_folder: Path,
    points: Path,
    seconds: float | None,
    console: Console,
    dry: bool,
) -> int:
    config, name = robots.load_robot(robot), time.strftime("%Y%m%d-%H%M%S")
    attachments = (("robot.yaml", robot.read_text(encoding="utf-8")),)
    folder = None if artefact is None else str(artefact)
    title = f"{config.name}: nothing is sent" if dry else f"{config.name}: by hand"
    log_folder.mkdir(parents=True, exist_ok=True)
    log_name = f"{name}-{'check' if dry else 'jog'}"
    options = process.ControlOptions(
        folder, log_folder=str(log_folder), log_name=log_name, attachments=attachments, dry=dry, jog=not dry
    )
    keys, jogger, marks = CHECK_KEYS if dry else JOG_KEYS, Jogger(), Marks(points, config, not dry)
    with Session(config, options, console) as session:
        for line in session.report:
            console.print(f"  {line}", highlight=False)
        end = time.monotonic() + (float("inf") if seconds is None else seconds)
        with Keyboard() as keyboard, View(console, title, keys) as view:
            while time.monotonic() < end:
                for message in session.messages(0.1):
                    view.take(message)
                    if isinstance(message, Status) and (told := marks.take(message)):
                        view.say(told)
                key = keyboard.pressed() or ""
                if key == QUIT:
                    break
                request = KEYS[key].request if key in keys and key in KEYS else None
                if not dry and key and request is None:
                    request = jogger.pressed(key)
                    view.say(str(jogger))
                if key == MARK:
                    marks.begin()
                    view.say("hold still ...")
                if request is not None:
                    session.send(request)
        status = session.status
    if status is None:
        raise RefusedError("the control process sent no status")
    ball = "no ball" if status.ball is None else "ball at {:+.3f} {:+.3f} {:+.3f} m".format(*status.ball)
    frames, arm = status.tracker_counts, status.egm
    refused = sum(n for why, n in frames.items() if why not in ("accepted", "lost"))
    console.print(
        f"{ball} in the table frame; tracker {frames.get('accepted', 0)} frames, "
        f"{refused} refused; arm {arm['accepted']} packets, "
        f"{arm['replies']} answered; log {process.log_path(options)}",
        highlight=False,
    )
    return 0
