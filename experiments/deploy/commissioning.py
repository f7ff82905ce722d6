"""``mjx-tt robot``: a dry run, and small motions by hand; both note points for a calibration."""

from __future__ import annotations

import csv
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from experiments.config import robot as robots
from experiments.deploy import robot_attachment
from experiments.deploy.control_session import start_session
from experiments.deploy.operator_console import KEYS, QUIT, Key, Keyboard, View
from experiments.errors import ConfigError, error_context
from mjx_tt.robot import robots as simulated
from robot_io.calibrated import Calibration
from robot_io.calibration import points
from robot_io.contract import PAPER, Contract
from robot_io.control import messages
from robot_io.control.messages import Request
from robot_io.errors import RefusedError
from robot_io.policy import artefact as artefacts

MARK = Key("note this point, of the last second", messages.Mark())
# Between the halves of a second, and by noise, each [m] or [rad]: more is no point. A tracker may be noisy: the mean of
# a hundred frames is not.
STILL = {"ball": (0.003, 0.01), "joints": (0.002, 0.002)}
STEPS = ((0.001, 0.002), (0.005, 0.01), (0.02, 0.05))  # [m], [rad] of small, middle and large steps
DIGITS = 9  # joints that a digit chooses
NEXT = "n"
CHECK_KEYS = {**{key: KEYS[key] for key in ("a", " ", "r")}, "m": MARK, QUIT: KEYS[QUIT]}


def jog_keys(contract: Contract) -> dict[str, Key]:
    """Keys of ``jog`` for the joints of a contract."""
    more = {NEXT: Key("choose the next joint")} if contract.n_joints > DIGITS else {}
    return {
        **{key: KEYS[key] for key in ("p", "a", " ", "r")},
        f"1..{min(contract.n_joints, DIGITS)}": Key("choose a joint"),
        **more,
        "x y z": Key("or the blade, along an axis of the table"),
        "+ -": Key("move a step"),
        "s": Key("size of the steps"),
        "m": MARK,
        QUIT: KEYS[QUIT],
    }


class Jogger:
    """Choice of joint or axis and of the step's size, by keys."""

    def __init__(self, contract: Contract = PAPER) -> None:
        self._contract = contract
        self._digits = "123456789"[: contract.n_joints]
        self._chosen: int | str = 0
        self._size = 0

    def pressed(self, key: str) -> Request | None:
        """Request of a key; None where it only chooses, or means nothing."""
        if key in self._digits:
            self._chosen = int(key) - 1
        elif key == NEXT and self._contract.n_joints > DIGITS:
            self._chosen = 0 if isinstance(self._chosen, str) else (self._chosen + 1) % self._contract.n_joints
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
            return messages.Jog(tuple(sign * metres * (axis == self._chosen) for axis in "xyz"))
        size = metres if self._contract.units[self._chosen] == "m" else radians
        return messages.Jog(tuple(sign * size * (i == self._chosen) for i in range(self._contract.n_joints)))

    def __str__(self) -> str:
        metres, radians = STEPS[self._size]
        if isinstance(self._chosen, str):
            return f"blade along {self._chosen}, {1e3 * metres:g} mm a step"
        size = f"{1e3 * metres:g} mm" if self._contract.units[self._chosen] == "m" else f"{1e3 * radians:g} mrad"
        return f"{self._contract.joints[self._chosen]}, {size} a step"


def note(path: Path, found: Calibration, seen: messages.Marked, with_joints: bool, contract: Contract = PAPER) -> str:
    """Adds what tracker and joints reported, before any calibration, to a CSV of points; returns a sentence about it.

    with_joints  False: the joints are not those of a robot
    contract     whose joints have the columns
    """
    left_out = {"ball": seen.ball.trouble(*STILL["ball"])}
    values: dict[str, float] = {}
    if not left_out["ball"]:
        values |= zip(points.BALL, found.tracker.inward(seen.ball.mean), strict=True)
    if with_joints:
        left_out["joints"] = seen.axes.trouble(*STILL["joints"]) or seen.arm.trouble(*STILL["joints"])
        if not left_out["joints"]:
            arm = seen.arm.mean - found.robot.zeros(len(contract.arm))
            values |= zip(contract.joints, (*seen.axes.mean, *arm), strict=True)
    reasons = "; ".join(f"no {what}: {trouble}" for what, trouble in left_out.items() if trouble)
    if not values:
        return f"not noted: {reasons}"
    columns = [*points.TABLE, *points.BALL, *contract.joints]
    new = not path.exists()
    with open(path, "a+", encoding="utf-8", newline="") as stream:
        stream.seek(0)
        if not new and (there := next(csv.reader(stream), [])) != columns:
            return f"not noted: {path} has the columns {', '.join(there)}; allowed with {contract.robot}: another file"
        lines = csv.DictWriter(stream, columns, restval="")
        if new:
            lines.writeheader()
        lines.writerow({name: f"{value:.6f}" for name, value in values.items()})
    return f"noted in {path}{reasons and f' ({reasons})'}; fill in table_x, table_y, table_z of its last line"


@dataclass(frozen=True)
class Commissioning:
    """A robot that is brought into service.

    robot       a robot.yaml
    log_folder  for the MCAP log
    points      CSV to which points for a calibration are added
    seconds     end after so many, None: when the operator quits
    name        of the robot that stands there, or its folder; None: the one that robot.yaml names, the policy's, or the
                paper's
    """

    robot: Path
    log_folder: Path
    points: Path
    seconds: float | None = None
    name: str | None = None

    def check(self, console: Console, policy: Path | None = None) -> int:
        """Computes and logs everything and sends nothing: tracker and arm are heard, arm and axes are simulated."""
        return self._operate(console, policy, dry=True)

    def jog(self, console: Console) -> int:
        """Moves the robot in small steps through the safety gate."""
        return self._operate(console, None, dry=False)

    def _operate(self, console: Console, policy: Path | None, dry: bool) -> int:
        contract, attached = self._load_contract(policy, console)
        config = robots.load_robot(self.robot, contract=contract)
        title = f"{config.name}: nothing is sent" if dry else f"{config.name}: by hand"
        keys, jogger = CHECK_KEYS if dry else jog_keys(contract), Jogger(contract)
        with start_session(
            config,
            contract,
            self.log_folder,
            console,
            "-check" if dry else "-jog",
            self.robot.read_text(encoding="utf-8"),
            attached,
            artefact=None if policy is None else str(policy),
            dry=dry,
            jog=not dry,
        ) as session:
            end = time.monotonic() + (float("inf") if self.seconds is None else self.seconds)
            with Keyboard() as keyboard, View(console, title, keys) as view:
                while time.monotonic() < end:
                    for message in session.messages(0.1):
                        view.take(message)
                        if isinstance(message, messages.Marked):
                            view.say(note(self.points, config.calibration, message, not dry, contract))
                    key = keyboard.pressed() or ""
                    if key == QUIT:
                        break
                    request = keys[key].request if key in keys else None
                    if not dry and key and request is None:
                        request = jogger.pressed(key)
                        view.say(str(jogger))
                    if request is not None:
                        session.send(request)
            status = session.status
        if status is None:
            raise RefusedError("the control process sent no status")
        ball = "no ball" if status.ball is None else "ball at {:+.3f} {:+.3f} {:+.3f} m".format(*status.ball)
        frames, arm = status.tracker_counts, status.egm
        refused = sum(n for why, n in frames.items() if why not in ("accepted", "lost"))
        console.print(
            f"{ball} in the table frame; tracker {frames.get('accepted', 0)} frames, {refused} refused; "
            f"arm {arm['accepted']} packets, {arm['replies']} answered; log {session.log_file}"
        )
        return 0

    def _load_contract(self, policy: Path | None, console: Console) -> tuple[Contract, robot_attachment.Attachments]:
        """Contract of the robot that stands there, and the robot for the log. Raises ConfigError."""
        loaded, name = None if policy is None else artefacts.load(policy), self.name or robots.named(self.robot)
        if name is None:
            return (PAPER, ()) if loaded is None else (loaded.contract, robot_attachment.of_policy(loaded, console))
        with error_context():
            contract = simulated.load(name).contract
        if loaded is not None and loaded.contract != contract:
            raise ConfigError(
                f"--artefact {policy}: a policy for another robot than {name} as it is now; allowed: one of "
                f"{contract.robot}, exported since it was changed last"
            )
        content = () if contract == PAPER else robot_attachment.of_content(simulated.content(name), name, console)
        return contract, content
