"""YAML of a robot and of the rig: dataclasses of ``robot_io``, read by pydantic."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from experiments.config.experiment import read_yaml
from experiments.config.validation import LONGEST, nearest
from experiments.errors import ConfigError, checked
from robot_io.calibrated import RANGES as CALIBRATION_RANGES
from robot_io.calibrated import Calibration
from robot_io.contract import PAPER, Contract
from robot_io.control import config as robot_config
from robot_io.control.config import RobotConfig
from robot_io.emulator import config as rig_config
from robot_io.emulator.config import RigParams, for_robot
from robot_io.emulator.opponent import Throws
from robot_io.ranges import is_number, outside

if TYPE_CHECKING:  # a robot.yaml is read without JAX
    from ballmodel.registry import Balls
    from mjx_tt.robot.robots import Robot
    from mjx_tt.sim.model import SimModel

COMMISSIONING = 0.1  # speed_scale of a robot.yaml that sets none: full speed is asked for, not forgotten
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
WORDS = {
    "int_type": "int",
    "int_from_float": "int",
    "float_type": "float",
    "bool_type": "bool",
    "string_type": "str",
    "tuple_type": "a list",
    "finite_number": "a finite number",
}
RANGES = {RobotConfig: robot_config.RANGES, RigParams: rig_config.RANGES, Calibration: CALIBRATION_RANGES}
Config = TypeVar("Config", RobotConfig, RigParams, Calibration)


def named(path: str | Path) -> str | None:
    """Name or folder of the robot that a robot.yaml has as ``robot``, a folder seen from the file's own; None: none.

    Raises ConfigError.
    """
    given = _mapping(path).get("robot")
    if given is None:
        return None
    if not isinstance(given, str):
        raise ConfigError(f"{path}: robot: got {_shown(given)}; allowed: a robot's name or folder")
    from mjx_tt.robot import robots

    return given if given in robots.names() else str(Path(path).parent / given)


def standing(path: str | Path) -> Contract:
    """Contract of the robot that a robot.yaml names, the paper's where it names none. Raises ConfigError."""
    robot = named(path)
    if robot is None:
        return PAPER
    from mjx_tt.robot import robots

    return checked(f"{path}: robot", robots.load, robot).contract


def load_robot(path: str | Path, calibrated: bool = True, contract: Contract | None = None) -> RobotConfig:
    """A robot.yaml, its calibration in it or in a file that it names. Raises ConfigError.

    Without ``safety.speed_scale`` the robot is slow: COMMISSIONING.

    calibrated  False: its calibration is not looked at
    contract    of the robot that stands there, which must be the one that the file names, if any; None: that one
    """
    data = _mapping(path)
    if contract is None or data.get("robot") is not None:
        there = standing(path)
        if contract is not None and contract != there:
            raise ConfigError(f"{path}: robot: names {there.robot}, asked for is {contract.robot} as it is now")
        contract = there
    if not calibrated:
        data.pop("calibration", None)
    if isinstance(named := data.get("calibration"), str):  # relative to robot.yaml
        data["calibration"] = plain(load_calibration(Path(path).parent / named))
    safety = data.setdefault("safety", {})
    if isinstance(safety, dict):
        safety.setdefault("speed_scale", COMMISSIONING)
    return fill(RobotConfig, data, str(path), RobotConfig.of(contract), contract)


def load_calibration(path: str | Path) -> Calibration:
    """A calibration of its own. Raises ConfigError."""
    return fill(Calibration, _mapping(path), str(path))


def load_rig(path: str | Path | None, robot: Robot | None = None) -> RigParams:
    """A rig.yaml, or the standard rig, for a robot; None: the paper's. Raises ConfigError.

    Another robot's arm and axes react as late as its YAML says, unless rig.yaml says how late.
    """
    standard = RigParams()
    if robot is not None and robot.contract != PAPER:
        known, arm = dict(robot.file.model), standard.arm
        late, reported, moved = (
            known.get(f"latency.{key}") for key in ("abb_action", "abb_observation", "festo_action")
        )
        arm = replace(
            arm,
            feedback_delay=arm.feedback_delay if reported is None else reported,
            dead_time=arm.dead_time if late is None else max(late - rig_config.ARM_RESPONSE, 0.0),
        )
        dead = standard.axis_dead_time if moved is None else max(moved - rig_config.AXIS_RESPONSE, 0.0)
        standard = replace(standard, arm=arm, axis_dead_time=dead)
        checked("", RobotConfig.of(robot.contract).check_joints, robot.contract)
    contract = PAPER if robot is None else robot.contract
    params = standard if path is None else fill(RigParams, _mapping(path), str(path), standard, contract)
    return for_robot(params, contract)


def to_yaml(config: RobotConfig | RigParams | Calibration) -> str:
    """Every key of a robot or rig with its value, ready to be edited."""
    return yaml.safe_dump(plain(config), sort_keys=False)


def plain(config: RobotConfig | RigParams | Calibration) -> dict[str, Any]:
    """The same as a mapping, with lists for tuples."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def _completed(given: Any, defaults: Any) -> Any:
    """Content with the keys that its mappings omit, as the whole has them, which need not be their class's defaults."""
    if not (isinstance(given, dict) and isinstance(defaults, dict)):
        return given
    return defaults | {key: _completed(value, defaults.get(key)) for key, value in given.items()}


def fill(
    kind: type[Config], data: dict[str, Any], where: str, defaults: Config | None = None, contract: Contract = PAPER
) -> Config:
    """An instance of a dataclass; omitted keys keep the class's or the given defaults. Raises ConfigError.

    contract  whose joints a RobotConfig and RigParams have
    """
    found = {path: (value, words) for path, value, words in outside(data, RANGES[kind]) if is_number(value)}
    lines = [f"{path}: got {_shown(value)}; allowed: {words}" for path, (value, words) in found.items()]
    try:
        # By JSON, whose lists are tuples: nothing else is converted.
        content = _completed(data, _defaults()[kind] if defaults is None else plain(defaults))
        config = _adapters()[kind].validate_json(json.dumps({"file": content}, default=str)).file
    except ValidationError as error:
        for mistake in error.errors(include_url=False):
            # A number outside its range is told above, and what a dataclass says of its section then as well.
            if not found or (mistake["type"] != "value_error" and _path(mistake) not in found):
                lines.append(_line(mistake, kind))
    if not lines:
        if isinstance(config, RobotConfig):
            checked(where, config.check_joints, contract)
        if isinstance(config, RigParams):
            checked(where, for_robot, config, contract)
        return config
    raise ConfigError("\n".join(f"{where}: {line}" for line in dict.fromkeys(lines)))


@cache
def _defaults() -> dict[type, dict[str, Any]]:
    """Content of a file that omits nothing and changes nothing, by its dataclass."""
    return {kind: plain(kind()) for kind in RANGES}


@cache
def _adapters() -> dict[type, TypeAdapter]:
    """Readers of files {"file": content}, by the dataclass of their content."""
    found: dict[type, TypeAdapter] = {}
    for kind in (RobotConfig, RigParams, Calibration):

        class Content:  # pydantic takes the strictness of this class into the dataclasses inside
            __pydantic_config__ = STRICT
            file: Any

        Content.__annotations__["file"] = kind
        found[kind] = TypeAdapter(dataclasses.dataclass(Content))
    return found


def _line(mistake: Any, kind: type) -> str:
    """One mistake: dotted path, what was given, what is allowed."""
    *parents, last = mistake["loc"][1:] or ("",)
    owner: Any = kind
    for part in parents:
        owner = _member(owner, part)
    path = _path(mistake)
    given, reason = mistake["input"], mistake["type"]
    shown = _shown(given)
    if reason == "unexpected_keyword_argument":
        names = [f.name for f in dataclasses.fields(owner)]
        return f"{path}: unknown key; {nearest(str(last), names)}allowed: {', '.join(names)}"
    if reason == "value_error":
        kind_of_section = getattr(_member(owner, last), "__name__", "")
        return f"{path and path + '.'}{str(mistake['ctx']['error']).removeprefix(kind_of_section + '.')}"
    if reason in ("too_long", "missing"):
        tuple_of = owner if reason == "missing" else _member(owner, last)
        at = path.rpartition("[")[0] if reason == "missing" else path
        return f"{at}: got {len(given)} entries; allowed: {len(get_args(tuple_of))}"
    allowed = WORDS.get(reason, mistake["msg"].removeprefix("Input should be "))
    if reason in ("dataclass_type", "dataclass_exact_type"):
        allowed = f"a mapping of {', '.join(f.name for f in dataclasses.fields(_member(owner, last)))}"
    return f"{path}: got {shown}; allowed: {allowed}"


def _path(mistake: Any) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in mistake["loc"][1:])[1:]


def _shown(given: Any) -> str:
    return repr(given) if len(repr(given)) <= LONGEST else f"{repr(given)[:LONGEST]} ..."


def _member(owner: Any, part: str | int) -> Any:
    """Type of a field, or of an entry of a tuple; the first of a union."""
    if isinstance(part, int):
        return get_args(owner)[0]
    if not part:
        return owner
    hint = get_type_hints(owner)[part]
    return hint if get_origin(hint) is tuple else next(iter(get_args(hint)), hint)


def _mapping(path: str | Path) -> dict[str, Any]:
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    data = read_yaml(text, str(path)) or {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a mapping is needed, got {type(data).__name__}")
    return data


def throws_of(balls: Balls, model: SimModel, count: int, seed: int) -> Throws:
    """Balls to throw, drawn from a distribution as training draws them."""
    import jax

    from ballmodel.sampling import sample_pool

    pool = checked(balls.name, sample_pool, jax.random.key(seed), balls, model.ball, count)
    order = np.random.default_rng(seed).permutation(count)  # a pool need not be in random order
    return Throws(
        *(np.asarray(x, np.float64)[:, order] for x in (pool.state.position, pool.state.velocity, pool.state.spin))
    )
