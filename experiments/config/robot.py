"""YAML of a robot and of the rig: dataclasses of ``robot_io``, read by pydantic."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import yaml

from experiments.config import files
from experiments.config.files import read_mapping
from experiments.errors import ConfigError, error_context
from robot_io.calibrated import Calibration
from robot_io.contract import PAPER, Contract
from robot_io.control.config import RobotConfig
from robot_io.emulator import config as rig_config
from robot_io.emulator.config import RigParams, for_robot
from robot_io.emulator.opponent import Throws

if TYPE_CHECKING:  # a robot.yaml is read without JAX
    from ballmodel.registry import Balls
    from mjx_tt.robot.robots import Robot
    from mjx_tt.sim.model import SimModel

COMMISSIONING = 0.1  # speed_scale of a robot.yaml that sets none: full speed is asked for, not forgotten
Config = TypeVar("Config", RobotConfig, RigParams, Calibration)


def named(path: str | Path) -> str | None:
    """Name or folder of the robot that a robot.yaml has as ``robot``, a folder seen from the file's own; None: none.

    Raises ConfigError.
    """
    given = read_mapping(path).get("robot")
    if given is None:
        return None
    if not isinstance(given, str):
        raise ConfigError(f"{path}: robot: expected a robot's name or folder, got {given!r}")
    from mjx_tt.robot import robots

    return given if given in robots.names() else str(Path(path).parent / given)


def standing(path: str | Path) -> Contract:
    """Contract of the robot that a robot.yaml names, the paper's where it names none. Raises ConfigError."""
    robot = named(path)
    if robot is None:
        return PAPER
    from mjx_tt.robot import robots

    with error_context(f"{path}: robot"):
        return robots.load(robot).contract


def load_robot(path: str | Path, calibrated: bool = True, contract: Contract | None = None) -> RobotConfig:
    """A robot.yaml, its calibration in it or in a file that it names. Raises ConfigError.

    Without ``safety.speed_scale`` the robot is slow: COMMISSIONING.

    calibrated  False: its calibration is not looked at
    contract    of the robot that stands there, which must be the one that the file names, if any; None: that one
    """
    data = read_mapping(path)
    if contract is None or data.get("robot") is not None:
        there = standing(path)
        if contract is not None and contract != there:
            raise ConfigError(f"{path}: robot: expected {contract.robot} as it is now, got {there.robot}")
        contract = there
    if not calibrated:
        data.pop("calibration", None)
    if isinstance(named := data.get("calibration"), str):  # relative to robot.yaml
        data["calibration"] = plain(load_calibration(Path(path).parent / named))
    if str(profile := data.get("axis_profile")).lower().startswith("excm"):
        raise ConfigError(
            f"{path}: axis_profile: expected a drive for each axis, 'cmmt' or 'fhpp', got {profile!r}: an EXCM moves "
            "both axes of its gantry behind one controller, which is not supported; give each axis a CMMT or a CMMO"
        )
    safety = data.setdefault("safety", {})
    if isinstance(safety, dict):
        safety.setdefault("speed_scale", COMMISSIONING)
    return fill(RobotConfig, data, str(path), RobotConfig.of(contract), contract)


def load_calibration(path: str | Path) -> Calibration:
    """A calibration of its own. Raises ConfigError."""
    return fill(Calibration, read_mapping(path), str(path))


def load_rig(path: str | Path | None, robot: Robot | None = None) -> RigParams:
    """A rig.yaml, or the standard rig, for a robot; None: the paper's. Raises ConfigError.

    Another robot's arm and axes react as late as its YAML says, unless rig.yaml says how late.
    """
    standard, contract = RigParams(), PAPER if robot is None else robot.contract
    if robot is not None and contract != PAPER:
        known, arm = dict(robot.file.model), dict[str, Any]()
        if (reported := known.get("latency.abb_observation")) is not None:
            arm["feedback_delay"] = reported
        if (late := known.get("latency.abb_action")) is not None:
            arm["dead_time"] = max(late - rig_config.ARM_RESPONSE, 0.0)
        standard = replace(standard, arm=replace(standard.arm, **arm))
        if (moved := known.get("latency.festo_action")) is not None:
            standard = replace(standard, axis_dead_time=max(moved - rig_config.AXIS_RESPONSE, 0.0))
        with error_context():
            RobotConfig.of(contract).check_joints(contract)
    params = standard if path is None else fill(RigParams, read_mapping(path), str(path), standard, contract)
    return for_robot(params, contract)


def to_yaml(config: RobotConfig | RigParams | Calibration) -> str:
    """Every key of a robot or rig with its value, ready to be edited."""
    return yaml.safe_dump(plain(config), sort_keys=False)


def plain(config: RobotConfig | RigParams | Calibration) -> dict[str, Any]:
    """The same as a mapping, with lists for tuples."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def fill(
    kind: type[Config], data: dict[str, Any], where: str, defaults: Config | None = None, contract: Contract = PAPER
) -> Config:
    """An instance of a dataclass; omitted keys keep the class's or the given defaults. Raises ConfigError.

    contract  whose joints a RobotConfig and RigParams have
    """
    config = files.validate(kind, _complete(data, plain(kind() if defaults is None else defaults)), where)
    with error_context(where):
        if isinstance(config, RobotConfig):
            config.check_joints(contract)
        if isinstance(config, RigParams):
            for_robot(config, contract)
    return config


def _complete(given: Any, defaults: Any) -> Any:
    """Content with the keys that its mappings omit, as the whole has them, which need not be their class's defaults."""
    if not (isinstance(given, dict) and isinstance(defaults, dict)):
        return given
    return defaults | {key: _complete(value, defaults.get(key)) for key, value in given.items()}


def throws_of(balls: Balls, model: SimModel, count: int, seed: int) -> Throws:
    """Balls to throw, drawn from a distribution as training draws them."""
    import jax

    from ballmodel.sampling import sample_pool

    with error_context(balls.name):
        pool = sample_pool(jax.random.key(seed), balls, model.ball, count)
    order = np.random.default_rng(seed).permutation(count)  # a pool need not be in random order
    return Throws(
        *(np.asarray(x, np.float64)[:, order] for x in (pool.state.position, pool.state.velocity, pool.state.spin))
    )
