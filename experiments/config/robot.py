"""YAML of a robot and of the rig: dataclasses of ``robot_io`` filled from mappings, with errors that say what to change."""

from __future__ import annotations

import dataclasses
import json
import types
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from experiments.config.experiment import read_yaml
from experiments.config.validation import nearest
from experiments.errors import ConfigError, checked
from robot_io.control.config import RobotConfig
from robot_io.emulator.ball_launcher import Throws
from robot_io.emulator.config import RigParams


def load_robot(path: str | Path) -> RobotConfig:
    """A robot.yaml. Raises ConfigError."""
    return fill(RobotConfig, _mapping(path), str(path))


def load_rig(path: str | Path | None) -> RigParams:
    """A rig.yaml, or the standard rig. Raises ConfigError."""
    return RigParams() if path is None else fill(RigParams, _mapping(path), str(path))


def to_yaml(config) -> str:
    """Every key of a robot or rig with its value, ready to be edited."""
    return yaml.safe_dump(json.loads(json.dumps(dataclasses.asdict(config))), sort_keys=False)


def fill(kind: type, data: dict[str, Any], where: str):
    """An instance of a dataclass; keys that are left out keep their defaults. Raises ConfigError."""
    hints = get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind)]
    values = {}
    for key, value in data.items():
        if key not in names:
            raise ConfigError(f"{where}: {key}: unknown key; {nearest(str(key), names)}allowed: {', '.join(names)}")
        values[key] = _value(hints[key], value, f"{where}: {key}")
    try:
        return kind(**values)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{where}: {error}") from None


def _value(hint, value, where: str):
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        inner = [a for a in get_args(hint) if a is not type(None)]
        return None if value is None and len(inner) < len(get_args(hint)) else _value(inner[0], value, where)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"{where}: got {value!r}; allowed: a mapping of {', '.join(hint.__dataclass_fields__)}")
        return fill(hint, value, where)
    if origin is tuple:
        items = get_args(hint)
        if not isinstance(value, list):
            raise ConfigError(f"{where}: got {value!r}; allowed: a list")
        if items[-1] is Ellipsis:
            items = items[:1] * len(value)
        if len(items) != len(value):
            raise ConfigError(f"{where}: got {len(value)} entries; allowed: {len(items)}")
        return tuple(_value(item, v, f"{where}[{i}]") for i, (item, v) in enumerate(zip(items, value)))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or isinstance(value, bool) is not (hint is bool):
        raise ConfigError(f"{where}: got {value!r}; allowed: {hint.__name__}")
    if hint is float and not np.isfinite(value):
        raise ConfigError(f"{where}: got {value!r}; allowed: a finite number")
    return value


def _mapping(path: str | Path) -> dict[str, Any]:
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    data = read_yaml(text, str(path)) or {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a mapping is needed, got {type(data).__name__}")
    return data


def throws_of(balls, model, count: int, seed: int) -> Throws:
    """Balls to throw, drawn from a distribution as training draws them."""
    import jax

    from ballmodel.sampling import sample_pool

    pool = checked(balls.name, sample_pool, jax.random.key(seed), balls, model.ball, count)
    order = np.random.default_rng(seed).permutation(count)  # a pool need not be in random order
    return Throws(
        *(np.asarray(x, np.float64)[:, order] for x in (pool.state.position, pool.state.velocity, pool.state.spin))
    )
