"""robot.yaml and rig.yaml, mutated: no watchdog is loosened beyond its ceiling, nothing ends in a traceback."""

from __future__ import annotations

import copy

import pytest
import yaml

from experiments.config import robot
from experiments.errors import ConfigError
from robot_io.control.config import RANGES, RobotConfig
from robot_io.emulator.config import RigParams

VALUES = [
    0,
    1,
    -1,
    7,
    0.5,
    -0.25,
    1e-9,
    1e6,
    1e308,
    -1e308,
    10**400,
    float("inf"),
    float("nan"),
    65536,
    True,
    None,
    "x",
    "1",
    [],
    [1.0],
    [1e300] * 8,
    [-1.0, 1.0],
    {},
    {"x": 1},
]


def paths(data, at=()):
    """Of every key and entry."""
    entries = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in entries:
        yield (*at, key)
        yield from paths(value, (*at, key))


def mutated(data, path, value):
    changed = copy.deepcopy(data)
    owner = changed
    for key in path[:-1]:
        owner = owner[key]
    owner[path[-1]] = value
    return changed


def numbers(config, path):
    found = [config]
    for name in path.split("."):
        found = [getattr(owner, name) for owner in found]
        found = [entry for value in found for entry in (value if isinstance(value, tuple) else (value,))]
    return [value for value in found if value is not None]


@pytest.mark.parametrize("kind", [RobotConfig, RigParams])
def test_every_field_mutated_is_refused_in_words_or_within_its_ceiling(kind):
    data = yaml.safe_load(robot.to_yaml(kind()))
    refused = accepted = 0
    for path in paths(data):
        for value in VALUES:
            try:
                config = robot.fill(kind, mutated(data, path, value), "file.yaml")
            except ConfigError as error:
                refused += 1
                assert str(error).startswith("file.yaml: ") and len(str(error)) < 2000
                assert str(path[0]) in str(error) or "gain" in str(error) or "ArmParams" in str(error)
                continue
            accepted += 1
            if kind is RobotConfig:
                for name, (low, high) in RANGES.items():
                    assert all(low <= number <= high for number in numbers(config, name)), (path, value)
    assert refused > 1000 and accepted > 50


def test_every_number_of_a_robot_has_a_ceiling():
    data = yaml.safe_load(robot.to_yaml(RobotConfig()))
    found = {".".join(str(key) for key in path if isinstance(key, str)) for path in paths(data)}
    sections = {"arm", "axes", "axes_motion", "tracker", "delays", "safety", "realtime"}
    sections |= {"calibration", *(f"calibration.{part}" for part in ("tracker", "robot", "clock"))}
    words = {
        "name",
        "rate",
        "axis_profile",
        "realtime.lock_memory",
        *(f"calibration.{part}.date" for part in ("tracker", "robot", "clock")),
        *(f"{d}.{n}" for d in ("arm", "axes", "tracker") for n in ("host", "controller", "source")),
    }
    delays = {f"delays.{name}" for name in ("ball", "arm", "axes")}  # bounded by themselves, at 0.1 s
    assert found - sections - words - delays == set(RANGES)


def test_a_robot_yaml_without_speed_scale_is_slow(tmp_path):
    path = tmp_path / "robot.yaml"
    for content in ("name: lab", "safety: {late: 0.04}", ""):
        path.write_text(content)
        assert robot.load_robot(path).safety.speed_scale == robot.COMMISSIONING <= 0.1
    path.write_text("safety: {speed_scale: 1.0}")
    assert robot.load_robot(path).safety.speed_scale == 1.0


def test_mistakes_are_told_all_at_once_with_what_is_allowed(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("arm: {port: x, hots: 1}\naxes: [{}, {port: 1.5}]\nsafety: 3")
    with pytest.raises(ConfigError) as error:
        robot.load_robot(path)
    assert str(error.value).splitlines() == [
        f"{path}: arm.port: got 'x'; allowed: int",
        f"{path}: arm.hots: unknown key; did you mean 'host'? "
        "allowed: host, port, controller, timeout, controller_port",
        f"{path}: axes[1].port: got 1.5; allowed: int",
        str(error.value).splitlines()[-1],
    ]
    assert str(error.value).splitlines()[-1].startswith(f"{path}: safety: got 3; allowed: a mapping of speed_scale, ")
