"""``mjx-tt robot commission``: the first day of a robot, step by step, each proven by a measurement.

Nothing moves before the steps that need no motion are proven. What moves is jogged, through the safety gate, one joint
at a time, in steps that end by themselves. A step that is not proven ends the command. Proven steps are in a YAML
beside robot.yaml; the same command goes on after them, and begins anew where robot.yaml has changed.
"""

from __future__ import annotations

import hashlib
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.console import Console
from rich.prompt import Prompt

from ballmodel.constants import BALL_RADIUS, PADDLE_RADIUS, TABLE_HEIGHT, TABLE_LENGTH, TABLE_WIDTH
from ballmodel.io.atomic_files import replacing
from experiments.deploy.control_session import ControlSession
from robot_io.contract import Contract
from robot_io.control import messages
from robot_io.control.config import RobotConfig, axis_range
from robot_io.control.messages import Message, Status
from robot_io.errors import RefusedError
from robot_io.safety.clearance import RobotGeometry

STEPS = (  # in order
    "network versions tool limits clock tracker bounces base_values comm_timeout homing emergency_stop pose signs "
    "latency speed position_gain stop calibration first_ball"
).split()
SLOW, FAST = 0.1, 1.0  # share of the policy's speed at speed_scale 0.1: 1 % and 10 %
SCALE = 0.1  # highest speed_scale of this command
WAIT, SHORT = 30.0, 1.0  # [s] for something to happen, and for an emergency stop to be noticed
CLOCK_TIME = 12.0  # [s] in which a clock's rate shows
ROBOTWARE, FIRMWARE = (6, 7), 1  # major versions of the arm's controller, least one of the drives
PLACES = (  # [m] where a hand holds the ball: at three corners of the table, and raised
    (TABLE_WIDTH / 2, -TABLE_LENGTH / 2, BALL_RADIUS),
    (TABLE_WIDTH / 2, TABLE_LENGTH / 2, BALL_RADIUS),
    (-TABLE_WIDTH / 2, -TABLE_LENGTH / 2, BALL_RADIUS),
    (0.0, 0.0, 0.3 + BALL_RADIUS),
)
HELD = 0.02  # [m] by which a ball in a hand may miss its place
STILL = (0.003, 0.01)  # [m] as of the points for a calibration
CLIPPED = 0.03  # [m] by which the ball on the blade may miss where the joints say that it is
MOVED = 0.25, 0.004  # share of a motion, and [m], by which it may differ
STEP = {"m": 0.04, "rad": 0.1}  # of the motions that are compared
LONGEST_STEP = {"m": 0.02, "rad": 0.05}  # of one request to jog
SILENCE_ERROR = 0.02  # [s] by which CommTimeout may be measured longer than the gate is told: some packets
LATE = 0.15  # [s] from a command to its effect as it is measured; the gate allows for 0.2 s
SPEED = 0.9  # share of the commanded speed that must be reached
GAIN = (0.7, 1.3)  # [1/s] of the position correction: PosCorrGain 0.2 x ext_motion_Kp 5
OVERRUN = {"m": 0.01, "rad": 0.03}  # by which a stopped joint may pass the end of the proven way
BALLS = 3
SPAN, KEPT = 4, 12  # ticks over which a speed is taken, and for which it must be kept


class NotProven(RefusedError):
    """A step was not proven; the message says what was measured, what was expected, and what to do."""


class Terminal:
    """The person at the terminal. While a question waits nothing is armed that moves: silence disarms."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def ask(self, key: str, question: str) -> str:
        """The answer to a question."""
        return Prompt.ask(question, console=self._console)

    def do(self, key: str, instruction: str) -> None:
        """Returns when it is done."""
        Prompt.ask(f"{instruction}; then press Enter", console=self._console, default="", show_default=False)

    def say(self, text: str) -> None:
        self._console.print(text)


def take(session: ControlSession, accept: Callable[[Message], bool], seconds: float) -> Any:
    """The first new message that is accepted; None: none came in time. Raises RefusedError for a refusal."""
    for _ in range(round(seconds / 0.1)):
        for message in session.messages(0.1):
            if accept(message):
                return message
            if isinstance(message, messages.Refused):
                raise message.error
    return None


@dataclass
class Record:
    """Proven steps of one robot.yaml, in a YAML beside it.

    proven  by step: what was proven, and the day
    """

    path: Path
    digest: str
    proven: dict[str, dict[str, str]] = field(default_factory=dict)

    @classmethod
    def of(cls, robot: Path) -> Record:
        """What was proven of this robot.yaml as it is now."""
        path = robot.with_suffix(".commissioning.yaml")
        record = cls(path, hashlib.sha256(robot.read_bytes()).hexdigest())
        if path.exists():
            data = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
            if data.get("robot_sha256") == record.digest:
                record.proven = dict(data.get("proven") or {})
        return record

    def add(self, step: str, text: str) -> None:
        """Write what a step has proven."""
        self.proven[step] = {"date": time.strftime("%Y-%m-%d"), "text": text}
        data = {"robot_sha256": self.digest, "proven": self.proven}
        with replacing(self.path) as path:
            path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")


class Commissioning:
    """Steps on one robot: each is a method that returns what it has proven, and raises NotProven.

    begin_play  makes a session that plays a ball at ``SCALE``, with a policy
    """

    def __init__(
        self,
        session: ControlSession,
        operator: Terminal,
        config: RobotConfig,
        record: Record,
        contract: Contract,
        begin_play: Callable[[], str],
    ) -> None:
        self._session, self._operator, self._config, self._record = session, operator, config, record
        self._contract, self._begin_play = contract, begin_play
        self._geometry = RobotGeometry.of(contract).moved(config.calibration.robot.base)
        self._axes, self._arm = list(contract.carrying), list(contract.arm)
        self._clip: np.ndarray | None = None  # the ball's place on the blade (3,) [m], in the last joint's frame

    def run(self) -> None:
        """Every step that is not proven yet. Raises NotProven at the first that cannot be, RefusedError."""
        for number, name in enumerate(STEPS, 1):
            head = f"{number:2d}/{len(STEPS)} {name}"
            if name in self._record.proven:
                self._operator.say(f"{head}: proven {self._record.proven[name]['date']}")
                continue
            try:
                text = getattr(self, f"_{name}")()
            except RefusedError as error:
                raise NotProven(f"{name}: {error}") from None
            self._record.add(name, text)
            self._operator.say(f"{head}: {text}")

    # Without motion

    def _network(self) -> str:
        status = self._wait(lambda s: s.egm["accepted"] > 250 and sum(s.tracker_counts.values()) > 125, "packets")
        lost = {"arm": status.egm["lost"] / status.egm["accepted"]}
        lost["tracker"] = status.tracker_counts.get("lost", 0) / sum(status.tracker_counts.values())
        for name, share in lost.items():
            if share > 0.01:
                raise NotProven(f"{100 * share:.1f} % of the packets of the {name} are lost; at most 1 % may be")
        if status.axes and ("is lost" in status.axes or "not answered" in status.axes):
            raise NotProven(status.axes)
        return f"arm, {len(self._axes)} axes and tracker answer; lost: {100 * max(lost.values()):.2f} % at most"

    def _versions(self) -> str:
        ware = self._ask("robotware", "RobotWare version of the arm's controller, as 6.15.01 (pendant: System Info)?")
        if _major(ware) not in ROBOTWARE:
            raise NotProven(f"RobotWare {ware}: EGM joint mode with speeds is of RobotWare 6 and 7")
        firmware = self._ask("firmware", "firmware version of the axes' drives, the lowest (vendor's set-up tool)?")
        if _major(firmware) < FIRMWARE:
            raise NotProven(f"drives' firmware {firmware}: expected {FIRMWARE} or later")
        module = self._ask("module", "MaxSpeedDeviation in deg/s of the RAPID module that is loaded, as 66?")
        if not re.fullmatch(r"\d+(\.\d+)?", module):
            raise NotProven(f"RAPID module: expected a number of deg/s, got {module!r}")
        return f"RobotWare {ware}, drives {firmware}, RAPID with {module} deg/s"

    def _tool(self) -> str:
        far = 1e3 * (float(np.linalg.norm(self._geometry.blade)) + PADDLE_RADIUS)
        found = _numbers(self._ask("tool", "TCP of the tool that EGM uses: x, y, z in mm (pendant: Jogging, Tool)?"), 3)
        if abs(math.hypot(*found) - far) > 30.0:
            raise NotProven(
                f"tool: its TCP is {math.hypot(*found):.0f} mm from the flange, the blade's end {far:.0f} mm: in "
                "manual mode the 250 mm/s are kept at the TCP only"
            )
        return f"the tool's TCP is the blade's end, {far:.0f} mm"

    def _limits(self) -> str:
        for k, i in enumerate(self._axes):
            name, axis = self._contract.joints[i], self._config.axes[k]
            question = f"software limits of the drive of {name}: lower and upper in m, by the drive (none: 0 0)?"
            low, high = sorted(
                axis.zero + axis.direction * v for v in _numbers(self._ask(f"limits_{name}", question), 2)
            )
            inner, room = axis_range(i, self._config.safety, self._contract.limits), 0.06
            if not (inner[0] - room <= low <= inner[0] and inner[1] <= high <= inner[1] + room):
                raise NotProven(
                    f"limits: the drive of {name} stops at {low:+.3f} and {high:+.3f} m; expected up to {room} m "
                    f"beyond {inner[0]:+.3f} and {inner[1]:+.3f} m, which is commanded"
                )
        return "the drives' software limits lie just outside of what is ever commanded"

    def _clock(self) -> str:
        self._session_time(CLOCK_TIME)
        status = self._last()
        trouble = status.present.get("clock") or status.clock_trouble
        if trouble:
            raise NotProven(trouble)
        return f"offset {1e3 * status.clock['offset']:+.1f} ms, drift {1e6 * status.clock['drift']:+.0f} ppm"

    def _tracker(self) -> str:
        seen = []
        for x, y, z in PLACES:
            self._operator.do(
                f"hold {x:.4f} {y:.4f} {z:.4f}",
                f"hold the ball still, its centre at x {x:+.3f}, y {y:+.3f}, z {z:+.3f} m of the table frame",
            )
            seen.append(self._ball("tracker"))
        self._operator.do("release", "take the ball away")
        found, places = np.array(seen), np.array(PLACES)
        off = np.linalg.norm(found - places, axis=1)
        if off.max() > HELD:
            raise NotProven(f"tracker: a ball held at {PLACES[int(off.argmax())]} m {_name_frame(found, places)}")
        return f"a ball held at {len(PLACES)} places is seen there, {1e3 * off.max():.0f} mm off at most"

    def _bounces(self) -> str:
        before = self._last().shown
        self._operator.do("throw", f"throw {BALLS} balls from the player's end, each bouncing on the robot's half")
        if self._until(lambda s: s.shown >= before + BALLS or "tracker_frame" in s.present, WAIT) is None:
            raise NotProven(f"{self._last().shown - before} of {BALLS} balls have shown the tracker's frame")
        self._operator.do("stop_throwing", "throw no more balls")
        if trouble := self._last().present.get("tracker_frame"):
            raise NotProven(trouble)
        return f"{BALLS} balls bounce on the table in the tracker's frame"

    def _base_values(self) -> str:
        status = self._last()
        if status.axes and "robot.yaml has" in status.axes:
            raise NotProven(status.axes)
        if self._config.axis_profile != "cmmt" and self._axes:
            self._operator.do("base_values", "compare the drives' base values with robot.yaml: FHPP carries none")
            return "compared by hand: FHPP carries no base values"
        return "the drives' units and base values are those of robot.yaml"

    def _comm_timeout(self) -> str:
        self._switch_on()
        self._session.send(messages.Mute(2.0))
        silence = self._answer(messages.Muted, 5.0).seconds
        told = self._config.safety.silence[-1]
        if silence is None or silence > told + SILENCE_ERROR:
            took = "more than 2 s" if silence is None else f"{silence:.3f} s"
            raise NotProven(
                f"without answers EGM went on for {took}, the gate is told of {told} s: set \\CommTimeout in "
                "EGMSetupUC, or the arm's entries of safety.silence in robot.yaml, which makes the robot slower"
            )
        return f"without answers EGM ends after {1e3 * silence:.0f} ms"

    def _homing(self) -> str:
        if self._axes:
            self._operator.do("home", "clear the axes' way: they search their references now")
        self._ready()
        return "axes homed, inside their range" if self._axes else "no linear axes"

    def _emergency_stop(self) -> str:
        self._ready()
        self._operator.do("press", "press the emergency stop now")
        status = self._until(lambda s: bool(s.arm and (s.axes or not self._axes)), SHORT)
        if status is None:
            left = [name for name, lost in (("arm", self._last().arm), ("axes", self._last().axes)) if not lost]
            raise NotProven(f"the emergency stop leaves the power to {' and '.join(left)}: wire it to both channels")
        self._operator.do("release_stop", "release the emergency stop, and let nobody near the robot")
        self._ready()
        return "the emergency stop takes the power from arm and axes"

    # With motion, one joint at a time

    def _pose(self) -> str:
        self._ready()
        self._operator.do(
            "clip",
            "clip the ball to the side of the blade, touching its edge, square to the handle; stay clear",
        )
        seen = self._ball("pose")
        hand, self._clip, off = self._geometry.hand(self._measured()[:, None])[0], None, math.inf
        for side in (1.0, -1.0):
            along = self._geometry.blade / np.linalg.norm(self._geometry.blade)
            clip = self._geometry.blade + side * (PADDLE_RADIUS + BALL_RADIUS) * np.cross(self._geometry.normal, along)
            miss = float(np.linalg.norm(hand[:3, :3] @ clip + hand[:3, 3] - seen))
            if miss < off:
                self._clip, off = clip, miss
        if off > CLIPPED:
            raise NotProven(
                f"the ball on the blade is {off:.3f} m from where the joints have it: is the axes' zero wrong (homing "
                "offset, axes.zero), or the arm's base or joint zeros?"
            )
        return f"the ball on the blade is where the joints have it, {1e3 * off:.0f} mm off"

    def _signs(self) -> str:
        if self._clip is None:
            self._pose()
        self._arm_robot()
        worst = 0.0
        for i, name in enumerate(self._contract.joints):
            before, q = self._ball(name), self._measured()
            self._jog(i, STEP[self._contract.units[i]], SLOW)
            moved = self._ball(name) - before
            expected = self._clipped(q + STEP[self._contract.units[i]] * self._joint(i)) - self._clipped(q)
            off = float(np.linalg.norm(moved - expected))
            worst = max(worst, off)
            if off > MOVED[0] * np.linalg.norm(expected) + MOVED[1]:
                raise NotProven(f"{name}: {self._wrong_way(i, moved, expected, q)}")
            self._jog(i, -STEP[self._contract.units[i]], FAST)
        return f"every joint moves in its direction and by its unit, {1e3 * worst:.1f} mm off at most"

    def _latency(self) -> str:
        self._arm_robot()
        found = {}
        for i in (*self._axes, self._arm[0], self._arm[-1]):
            self._jog(i, STEP[self._contract.units[i]], FAST, wait=False)
            self._session_time(0.6)
            trace = self._trace()
            found[self._contract.joints[i]] = _lag(trace, i)
            self._jog(i, -STEP[self._contract.units[i]], FAST)
        worst = max(found, key=lambda name: found[name])
        if not found[worst] <= LATE:
            raise NotProven(
                f"{worst} follows {found[worst]:.3f} s after its commands, as measured; allowed are {LATE} s, since "
                "the gate takes 0.2 s for a joint that does not follow"
            )
        return "from command to measurement: " + ", ".join(f"{n} {1e3 * v:.0f} ms" for n, v in found.items())

    def _speed(self) -> str:
        self._arm_robot()
        found = []
        for i in reversed(self._arm):  # the fastest first
            start = self._measured()[i]
            self._rush(i, 0.7)
            self._session_time(1.0)
            trace = self._trace()
            wanted, reached = (_fastest(_rate(trace.time, x[:, i])) for x in (trace.reference, trace.measured))
            if reached < SPEED * wanted:
                raise NotProven(
                    f"{self._contract.joints[i]} reaches {np.degrees(reached):.0f} deg/s of the "
                    f"{np.degrees(wanted):.0f} deg/s that are commanded: does MaxSpeedDeviation fit speed_scale?"
                )
            found.append(np.degrees(reached))
            self._jog(i, start - self._measured()[i], FAST)
        return f"the arm's joints reach {', '.join(f'{v:.0f}' for v in found)} deg/s as commanded"

    def _position_gain(self) -> str:
        self._arm_robot()
        i = self._arm[-1]
        self._jog(i, STEP["rad"] / 2, FAST, wait=False, pulled=True)
        self._session_time(2.5)
        trace = self._trace()
        error = trace.reference[:, i] - trace.measured[:, i]
        settled = trace.time > trace.time[-1] - 1.9
        left = np.clip(error[settled], 1e-6, None)
        usable = left > 0.15 * left.max()
        gain = -np.polyfit(trace.time[settled][usable], np.log(left[usable]), 1)[0] if usable.sum() > 20 else math.inf
        if error.max() > 0.9 * STEP["rad"] / 2 and error[-1] > 0.9 * STEP["rad"] / 2:
            gain = 0.0
        self._jog(i, -STEP["rad"] / 2, FAST)
        self._session_time(0.5)
        self._check_fault()
        if not GAIN[0] <= gain <= GAIN[1]:
            raise NotProven(
                f"position correction: a step of {STEP['rad'] / 2} rad is corrected at {gain:.2f} / s, expected "
                f"{GAIN[0]} to {GAIN[1]}: check PosCorrGain x ext_motion_Kp"
            )
        return f"an error of position is corrected at {gain:.2f} / s"

    def _stop(self) -> str:
        limits, worst = self._contract.limits, 0.0
        for i, name in enumerate(self._contract.joints):
            self._arm_robot()
            start = self._measured()[i]
            self._rush(i, 1.4 if self._contract.units[i] == "m" else 0.7)
            self._session.send(messages.Stop())
            stopped = self._wait(lambda s: s.state not in ("ready", "active"), "the stop").time
            self._until(lambda s: s.state == "disarmed", 5.0)
            self._session_time(0.5)
            trace = self._trace()
            speed = _rate(trace.time, trace.reference[:, i])
            fastest, way = _fastest(speed), np.sign(np.median(speed[np.abs(speed) > 0.5 * _fastest(speed)]))
            fast = way * speed > 0.8 * fastest
            # Where it begins to brake; a jogging computer that stalls lets it slow down before.
            last = int(np.flatnonzero(fast & (trace.time[SPAN:] <= stopped))[-1]) + SPAN
            proven = fastest**2 / (2.0 * limits.acceleration[i]) + fastest / self._config.rate
            end = float(way * trace.reference[last, i]) + proven
            over = float((way * trace.measured[last:, i]).max()) - end
            allowed = OVERRUN[self._contract.units[i]]
            worst = max(worst, over / allowed)
            if over > allowed:
                raise NotProven(
                    f"{name} stops {over:.3f} {self._contract.units[i]} beyond the way that the gate has proven, "
                    f"allowed are {allowed}: does its drive brake at {limits.acceleration[i]:g} / s^2?"
                )
            self._arm_robot()
            self._jog(i, start - self._measured()[i], FAST)
        share = 100 * max(worst, 0.0)
        return f"every joint stops within the proven way, {share:.0f} % of what is allowed beyond it at most"

    # At play

    def _calibration(self) -> str:
        found = self._config.calibration
        for part in ("tracker", "robot"):
            if not getattr(found, part).date:
                answer = self._ask(
                    "calibration",
                    f"{part} is not calibrated (mjx-tt calibrate {part}); held balls were within {1e3 * HELD:.0f} mm, "
                    f"the ball on the blade within {1e3 * CLIPPED:.0f} mm. Go on without? yes or no",
                )
                if answer.strip().lower() not in ("y", "yes"):
                    raise NotProven(f"{part}: calibrate it, then run this command again")
        dates = [f"{part} {getattr(found, part).date or 'not'}" for part in ("tracker", "robot")]
        return f"calibrated: {', '.join(dates)}"

    def _first_ball(self) -> str:
        self._operator.do("unclip", "take the ball off the blade and leave the robot's reach")
        return self._begin_play()

    # What steps are made of

    def _ask(self, key: str, question: str) -> str:
        return self._operator.ask(key, question).strip()

    def _last(self) -> Status:
        """The next status: what was before it may be older than what was just done."""
        for _ in self._session.messages(0.0):
            pass
        for _ in range(20):
            for message in self._session.messages(0.1):
                if isinstance(message, Status):
                    return message
        raise NotProven("the control process sends no status")

    def _session_time(self, seconds: float) -> None:
        for _ in self._session.messages(seconds):
            pass

    def _until(self, condition: Callable[[Status], bool], seconds: float) -> Status | None:
        """The first new status that fulfils a condition; None: none did in time. Raises RefusedError for a refusal."""
        return take(self._session, lambda m: isinstance(m, Status) and condition(m), seconds)

    def _wait(self, condition: Callable[[Status], bool], what: str) -> Status:
        status = self._until(condition, WAIT)
        if status is None:
            last = self._session.status
            raise NotProven(f"waited {WAIT:g} s for {what}: {'no status' if last is None else last.missing}")
        return status

    def _answer(self, kind: type[Any], seconds: float) -> Any:
        answer = take(self._session, lambda m: isinstance(m, kind), seconds)
        if answer is None:
            raise NotProven(f"the control process sent no {kind.__name__} within {seconds:g} s")
        return answer

    def _switch_on(self) -> None:
        """Motors, RAPID and EGM on."""
        if self._last().arm:
            self._operator.do("switch_on", "switch the arm's motors on and start the RAPID program")
            self._wait(lambda s: not s.arm, "the arm")

    def _ready(self) -> None:
        """Arm on, axes on and homed, no fault."""
        self._switch_on()
        refusal = ""
        for _ in range(round(WAIT)):
            status = self._last()
            if status.state == "fault" and not status.present:
                self._session.send(messages.Reset())
            elif not status.missing:
                return
            elif status.axes and not status.homing:
                self._session.send(messages.Prepare())
            try:
                self._until(lambda s: not s.missing and s.state != "fault", 1.0)
            except RefusedError as error:  # until the arm has sent its position, or an axis has answered
                refusal = f"; {error}"
                self._session_time(0.5)
        raise NotProven(f"not ready: {self._last().missing}{refusal}")

    def _arm_robot(self) -> None:
        self._ready()
        if self._last().state != "ready":
            self._session.send(messages.Arm())
            self._wait(lambda s: s.state == "ready", "being armed")

    def _check_fault(self) -> None:
        status = self._last()
        if status.halt is not None and status.state not in ("ready", "active"):
            raise NotProven(f"stopped by {status.halt.cause}: {status.halt.text}")

    def _measured(self) -> np.ndarray:
        return np.array([position for _, _, position, _ in self._last().joints])

    def _joint(self, i: int) -> np.ndarray:
        """A one for joint i, zeros for the others (n,)."""
        return np.eye(self._contract.n_joints)[i]

    def _clipped(self, q: np.ndarray) -> np.ndarray:
        """Where the ball on the blade is (3,) [m] at joint positions q (n,)."""
        hand = self._geometry.hand(q[:, None])[0]
        return hand[:3, :3] @ self._clip + hand[:3, 3]

    def _ball(self, what: str) -> np.ndarray:
        """Where a ball that is still is seen (3,) [m]."""
        trouble = ""
        for _ in range(5):
            self._session_time(1.1)
            self._session.send(messages.Mark())
            stay = self._answer(messages.Marked, 3.0).ball
            trouble = stay.trouble(*STILL)
            if not trouble:
                return stay.mean
        refused = self._last().tracker_trouble
        raise NotProven(f"{what}: no ball that stands still is seen: {refused or trouble}")

    def _jog(self, i: int, way: float, share: float, wait: bool = True, pulled: bool = False) -> None:
        """Move a joint by ``way`` in the steps that are allowed, each when the one before has been commanded."""
        unit = self._contract.units[i]
        steps = max(math.ceil(abs(way) / LONGEST_STEP[unit] - 1e-9), 1)
        for k in range(1, steps + 1):
            self._session.send(messages.Jog(tuple(way / steps * self._joint(i)), share, pulled))
            if wait or k < steps:
                self._last()
                self._until(lambda s: s.joints[i][3] == 0.0 or s.state != "ready", 10.0)
        if wait:
            self._check_fault()

    def _rush(self, i: int, seconds: float) -> None:
        """Move a joint away from the nearer end of its range at 10 % speed."""
        limits, unit = self._contract.limits, self._contract.units[i]
        way = 1.0 if self._measured()[i] < 0.5 * (limits.lower[i] + limits.upper[i]) else -1.0
        step = tuple(way * LONGEST_STEP[unit] * self._joint(i))
        for _ in range(round(seconds / 0.02)):
            self._session.send(messages.Jog(step, FAST))
            self._session_time(0.02)

    def _trace(self) -> messages.Traced:
        self._session.send(messages.Trace())
        return self._answer(messages.Traced, 3.0)

    def _wrong_way(self, i: int, moved: np.ndarray, expected: np.ndarray, q: np.ndarray) -> str:
        """What a joint's motion looks like that is not the expected one."""
        ways = (", ".join(f"{1e3 * v:+.1f}" for v in way) for way in (moved, expected))
        seen = "the ball on the blade moved by ({}) mm, expected ({})".format(*ways)
        joints, size, length = self._contract.joints, float(np.linalg.norm(expected)), float(np.linalg.norm(moved))
        if length < 0.2 * size:
            return f"it does not move: {seen}"
        for j, name in enumerate(joints):
            other = self._clipped(q + STEP[self._contract.units[j]] * self._joint(j)) - self._clipped(q)
            if j != i and np.linalg.norm(moved - other) < MOVED[0] * np.linalg.norm(other) + MOVED[1]:
                return f"{name} moved instead: are they swapped? {seen}"
        cosine = float(moved @ expected) / (size * length)
        if cosine < -0.8:
            return f"it moves the other way: is its sign wrong (axes.direction)? {seen}"
        if cosine > 0.8:
            return f"it moves {length / size:.2f} times as far: is its unit wrong (feed constant, gear)? {seen}"
        return f"it moves elsewhere: {seen}"


def _major(version: str) -> int:
    found = re.match(r"\D*(\d+)\.", version)
    return int(found[1]) if found else -1


def _numbers(text: str, count: int) -> list[float]:
    found = [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]
    if len(found) != count:
        raise NotProven(f"expected {count} numbers, got {text!r}")
    return found


def _rate(time: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Velocity over ``SPAN`` ticks each."""
    step = (x[SPAN:] - x[:-SPAN]) / (time[SPAN:] - time[:-SPAN])
    return np.where(np.isfinite(step), step, 0.0)


def _fastest(speed: np.ndarray) -> float:
    """The speed that was kept for a while: a reference that a stop takes back to the measurement jumps."""
    return float(np.sort(np.abs(speed))[-KEPT])


def _lag(trace: messages.Traced, i: int) -> float:
    """Time [s] by which the measurement follows the reference best."""
    known = np.isfinite(trace.reference[:, i]) & np.isfinite(trace.measured[:, i])
    time, reference, measured = trace.time[known], trace.reference[known, i], trace.measured[known, i]
    late = np.arange(0.0, 0.5, 0.002)
    errors = [np.abs(np.interp(time - lag, time, reference) - measured).mean() for lag in late]
    return float(late[int(np.argmin(errors))])


def _name_frame(seen: np.ndarray, places: np.ndarray) -> str:
    """What the frame looks like in which balls at places (n, 3) are seen (n, 3)."""
    x, y, z = places.T
    known = {
        "is seen with x mirrored": (-x, y, z),
        "is seen with y mirrored": (x, -y, z),
        "is seen in a frame whose z is measured from the floor": (x, y, z + TABLE_HEIGHT),
        "is seen in millimetres": (1e3 * x, 1e3 * y, 1e3 * z),
        "is seen in a frame that is turned by 90 degrees about z": (-y, x, z),
        "is seen in a frame that is turned by -90 degrees about z": (y, -x, z),
        "is seen in a frame that is turned by 180 degrees about z": (-x, -y, z),
    }
    for words, place in known.items():
        if np.linalg.norm(seen - np.array(place).T, axis=1).max() < 2.0 * HELD:
            return words
    shift = (seen - places).mean(0)
    return f"is seen {shift[0]:+.3f} {shift[1]:+.3f} {shift[2]:+.3f} m away on average: calibrate the tracker"
