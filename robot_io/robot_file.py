"""The YAML that describes a robot of one's own: what its MJCF does not say.

    name: my_arm
    mjcf: my_arm.xml           beside the YAML
    paddle: paddle             site at the blade's centre: x along the handle, z out of the striking face
    carrying: [rail]           linear axes that carry the arm; [] for a fixed base
    joints:                    from the base to the paddle
      rail: {range: [-1, 1], velocity: 2, acceleration: 15, margin: 0.01, policy_velocity: 2, home: 0}
      ...
    mount: {position: [0, -2, -0.38], yaw: 0}     of the MJCF's origin on the floor plan [m], [rad]
    latencies: {arm_action: [0.071, 0.0057]}      mean and deviation [s]
    drives: {rail: {lag: 0.01}}                   as the drives of a model YAML
    clearance:                 capsules (geoms named col_...) and what they must not touch
      table: [col_forearm, col_blade]
      blade: [col_blade]
      pairs: [[col_base, col_blade]]

NumPy and the standard library only, so that the robot's side may read it; ``mjx_tt.robot.robots`` adds the MJCF.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from robot_io.contract import Contract, JointLimits

KEYS = {
    "name": "letters, digits, _ and -",
    "mjcf": "the MJCF's file, beside the YAML",
    "paddle": "name of the site at the blade's centre",
    "carrying": "names of the linear axes that carry the arm, or []",
    "joints": "a mapping of every joint, from the base to the paddle",
    "mount": "{position: [x, y, z], yaw: angle}",
    "latencies": "a mapping of [mean, deviation] in seconds",
    "drives": "a mapping of joints to their drives",
    "clearance": "{table: [...], blade: [...], pairs: [[a, b], ...]}",
}
OPTIONAL = ("mount", "latencies", "drives")
JOINT_KEYS = ("range", "velocity", "acceleration", "margin", "policy_velocity", "home")
LATENCIES = {  # key of the YAML: that of a model YAML
    "ball_observation": "ball_observation",
    "arm_observation": "abb_observation",
    "carrying_observation": "festo_observation",
    "arm_action": "abb_action",
    "carrying_action": "festo_action",
}
LONGEST_LATENCY = 1.0  # [s]


@dataclass(frozen=True)
class RobotFile:
    """Content of the YAML.

    mjcf                 as it stands there: a file's name, or the MJCF itself
    paddle               the site
    contract             without geometry, which needs the MJCF
    home                 joint positions [m], [rad]
    position, yaw        of the mounting [m], [rad]
    model                what the simulation's model gets: dotted path of a model YAML and value, in the file's order
    table, blade, pairs  names of capsules
    """

    name: str
    mjcf: str
    paddle: str
    contract: Contract
    home: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    model: tuple[tuple[str, float], ...] = ()
    table: tuple[str, ...] = ()
    blade: tuple[str, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()


@dataclass
class _Reader:
    """Collects mistakes, so that a file is mended in one go."""

    where: str
    mistakes: list[str] = field(default_factory=list)

    def wrong(self, key: str, given: Any, allowed: str) -> None:
        self.mistakes.append(f"{self.where}: {key}: got {given!r}; allowed: {allowed}")

    def mapping(self, key: str, given: Any, known: Iterable[str] | None, allowed: str) -> dict[str, Any]:
        """The mapping, without keys that are not known; {} for anything else."""
        if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
            self.wrong(key, given, allowed)
            return {}
        names = list(given if known is None else known)
        for name in given:
            if name not in names:
                close = difflib.get_close_matches(name, names, 1)
                hint = f"did you mean {close[0]!r}? " if close else ""
                path = f"{key}.{name}" if key else name
                self.mistakes.append(f"{self.where}: {path}: unknown key; {hint}allowed: {', '.join(names)}")
        return {name: value for name, value in given.items() if name in names}

    def number(self, key: str, given: Any, allowed: str, right: Callable[[float], bool] = lambda _: True) -> float:
        """A finite number for which ``right`` holds; NaN for anything else."""
        fits = isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given)
        if not fits or not right(given):
            self.wrong(key, given, allowed)
            return math.nan
        return float(given)

    def numbers(self, key: str, given: Any, count: int, allowed: str) -> tuple[float, ...]:
        """``count`` finite numbers; () for anything else."""
        if not isinstance(given, list) or len(given) != count:
            self.wrong(key, given, allowed)
            return ()
        values = tuple(self.number(f"{key}[{i}]", value, "a finite number") for i, value in enumerate(given))
        return () if any(math.isnan(value) for value in values) else values

    def names(self, key: str, given: Any, allowed: str, known: Iterable[str] | None = None) -> tuple[str, ...]:
        """Different names, of those known where they are given."""
        if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
            self.wrong(key, given, allowed)
            return ()
        choice = None if known is None else list(known)
        for name in given:
            if choice is not None and name not in choice:
                self.wrong(key, name, ", ".join(choice))
            elif given.count(name) > 1:
                self.wrong(key, name, "every name once")
        return tuple(dict.fromkeys(given))


def parse(data: Any, where: str) -> RobotFile:
    """The content of parsed YAML. Raises ValueError with a line for every mistake: file, key, given and allowed."""
    reader = _Reader(where)
    keys = reader.mapping("", data, KEYS, f"a mapping with the keys {', '.join(KEYS)}")
    for key, allowed in KEYS.items():
        if isinstance(data, dict) and key not in keys and key not in OPTIONAL:
            reader.mistakes.append(f"{where}: {key}: missing; allowed: {allowed}")
    for key in ("name", "mjcf", "paddle"):
        if key in keys and not (isinstance(keys[key], str) and keys[key].strip()):
            reader.wrong(key, keys[key], KEYS[key])
    name = str(keys.get("name", ""))
    if "name" in keys and not (name.replace("_", "").replace("-", "").isalnum() and name.isascii()):
        reader.wrong("name", keys["name"], KEYS["name"])
    joints = reader.mapping("joints", keys.get("joints", {}), None, KEYS["joints"])
    if "joints" in keys and isinstance(keys["joints"], dict) and not joints:
        reader.wrong("joints", keys["joints"], KEYS["joints"])
    carrying = reader.names("carrying", keys.get("carrying", []), KEYS["carrying"], joints)
    columns, home = _joints(reader, joints, carrying)
    position, yaw = _mount(reader, keys.get("mount", {}))
    model = (
        *_latencies(reader, keys.get("latencies", {})),
        *_drives(reader, keys.get("drives", {}), joints),
    )
    clearance = reader.mapping("clearance", keys.get("clearance", {}), ("table", "blade", "pairs"), KEYS["clearance"])
    if "clearance" in keys:
        for key in ("table", "blade", "pairs"):
            if key not in clearance:
                reader.mistakes.append(f"{where}: clearance.{key}: missing; allowed: {KEYS['clearance']}")
    table = reader.names("clearance.table", clearance.get("table", []), "names of capsules")
    blade = reader.names("clearance.blade", clearance.get("blade", []), "names of capsules of clearance.table", table)
    if "blade" in clearance and not blade:
        reader.wrong("clearance.blade", clearance["blade"], "at least one capsule of the blade")
    pairs = _pairs(reader, clearance.get("pairs", []))
    if reader.mistakes:
        raise ValueError("\n".join(reader.mistakes))
    try:
        limits = JointLimits(**columns, joints=tuple(joints))
    except ValueError as error:
        joint, _, rest = str(error).partition(": ")
        raise ValueError(f"{where}: joints.{joint}: {rest}") from None
    units = tuple("m" if joint in carrying else "rad" for joint in joints)
    contract = Contract(name, units, tuple(i for i, joint in enumerate(joints) if joint in carrying), limits)
    return RobotFile(
        name, str(keys["mjcf"]), str(keys["paddle"]), contract, home, position, yaw, model, table, blade, pairs
    )


def _joints(
    reader: _Reader, joints: dict[str, Any], carrying: tuple[str, ...]
) -> tuple[dict[str, tuple[float, ...]], tuple[float, ...]]:
    """Limits by name and the home pose."""
    columns: dict[str, list[float]] = {
        name: [] for name in ("lower", "upper", "velocity", "acceleration", "margin", "policy_velocity")
    }
    home = []
    for joint, given in joints.items():
        path, unit = f"joints.{joint}", "m" if joint in carrying else "rad"
        values = reader.mapping(path, given, JOINT_KEYS, f"a mapping of {', '.join(JOINT_KEYS)}")
        for key in JOINT_KEYS:
            if key not in values and isinstance(given, dict):
                reader.mistakes.append(f"{reader.where}: {path}.{key}: missing; it has no default")
        if "range" in values:
            pair = reader.numbers(f"{path}.range", values["range"], 2, f"[lower, upper] in {unit}")
            if pair and not pair[0] < pair[1]:
                reader.wrong(f"{path}.range", values["range"], "lower below upper")
            if pair and unit == "rad" and max(map(abs, pair)) > 8.0 * math.pi:
                reader.wrong(f"{path}.range", values["range"], "radians, not degrees: at most four turns")
            columns["lower"].append(pair[0] if pair else math.nan)
            columns["upper"].append(pair[1] if pair else math.nan)
        for key in ("velocity", "acceleration", "policy_velocity"):
            if key in values:
                per = "s^2" if key == "acceleration" else "s"
                allowed = f"a positive number of {unit}/{per}"
                columns[key].append(reader.number(f"{path}.{key}", values[key], allowed, lambda v: v > 0))
        if "margin" in values:
            allowed = f"a number of {unit}, 0 or positive"
            columns["margin"].append(reader.number(f"{path}.margin", values["margin"], allowed, lambda v: v >= 0))
        if "home" in values:
            home.append(_home(reader, path, values, unit))
    return {name: tuple(values) for name, values in columns.items()}, tuple(home)


def _home(reader: _Reader, path: str, values: dict[str, Any], unit: str) -> float:
    """The home position, inside the range less its margin."""
    home = reader.number(f"{path}.home", values["home"], f"a position in {unit}")
    ends, margin = values.get("range"), values.get("margin")
    numbers = [*ends, margin] if isinstance(ends, list) and len(ends) == 2 else []
    if numbers and all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        low, high = numbers[0] + numbers[2], numbers[1] - numbers[2]
        if low < high and not (math.isnan(home) or low < home < high):
            allowed = f"inside the range less its margin, {low:g} to {high:g} {unit}"
            reader.wrong(f"{path}.home", values["home"], allowed)
    return home


def _mount(reader: _Reader, given: Any) -> tuple[tuple[float, float, float], float]:
    mount = reader.mapping("mount", given, ("position", "yaw"), KEYS["mount"])
    place = mount.get("position", [0.0, 0.0, 0.0])
    position = reader.numbers("mount.position", place, 3, "[x, y, z] in m") or (0.0,) * 3
    yaw = reader.number("mount.yaw", mount.get("yaw", 0.0), "an angle in rad")
    return (position[0], position[1], position[2]), yaw


def _latencies(reader: _Reader, given: Any) -> list[tuple[str, float]]:
    found = []
    for key, pair in reader.mapping("latencies", given, LATENCIES, KEYS["latencies"]).items():
        allowed = f"[mean, deviation] in s, each from 0 to {LONGEST_LATENCY:g}"
        values = reader.numbers(f"latencies.{key}", pair, 2, allowed)
        if values and not all(0.0 <= value <= LONGEST_LATENCY for value in values):
            reader.wrong(f"latencies.{key}", pair, allowed)
        if values:
            path = f"latency.{LATENCIES[key]}"
            found += [(path, values[0]), (f"{path}_std", values[1])]
    return found


def _drives(reader: _Reader, given: Any, joints: dict[str, Any]) -> list[tuple[str, float]]:
    """Numbers by path; which effects there are the simulation's model knows."""
    found = []
    for joint, drive in reader.mapping("drives", given, joints, KEYS["drives"]).items():
        path = f"drives.{joint}"
        for effect, value in reader.mapping(path, drive, None, "a mapping of effects such as {lag: 0.01}").items():
            found.append((f"{path}.{effect}", reader.number(f"{path}.{effect}", value, "a finite number")))
    return found


def _pairs(reader: _Reader, given: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(given, list):
        reader.wrong("clearance.pairs", given, "a list of pairs of capsules, [[a, b], ...]")
        return ()
    pairs = []
    for i, pair in enumerate(given):
        names = reader.names(f"clearance.pairs[{i}]", pair, "two capsules, [a, b]")
        if len(names) == 2:
            pairs.append((names[0], names[1]))
        elif names:
            reader.wrong(f"clearance.pairs[{i}]", pair, "two different capsules")
    return tuple(pairs)
