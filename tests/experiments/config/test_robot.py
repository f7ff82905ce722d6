"""robot.yaml and rig.yaml, mutated: no watchdog is loosened beyond its ceiling, nothing ends in a traceback."""

from __future__ import annotations

import copy
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from experiments.config import robot
from experiments.errors import ConfigError
from robot_io.control.config import RANGES, RobotConfig, linear_axes
from robot_io.devices.festo import CmmtProfile
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


def dotted(path):
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)[1:]


@pytest.mark.parametrize("kind", [RobotConfig, RigParams])
def test_every_field_mutated_is_refused_in_words_or_within_its_ceiling(kind):
    """A refusal names the file, the key, what was given and what is allowed."""
    data = yaml.safe_load(robot.to_yaml(kind()))
    refused = accepted = 0
    for path in paths(data):
        for value in VALUES:
            try:
                config = robot.fill(kind, mutated(data, path, value), "file.yaml")
            except ConfigError as error:
                refused += 1
                assert len(str(error)) < 2000
                for line in str(error).splitlines():
                    # Of tuples whose entries belong together the key is the tuple's; a calibration needs its date.
                    key = dotted(path).rpartition("[")[0] or dotted(path)
                    undated = path[0] == "calibration" and f"file.yaml: {dotted(path[:2])}.date is empty"
                    assert line.startswith((f"file.yaml: {key}", undated or f"file.yaml: {key}")), line
                    assert "allowed" in line and ("got " in line or " is " in line or "unknown key" in line), line
                continue
            accepted += 1
            for name, (low, high) in robot.RANGES[kind].items():
                assert all(low <= number <= high for number in numbers(config, name)), (path, value)
    assert refused > 1000 and accepted > 50


@pytest.mark.parametrize("kind", [RobotConfig, RigParams])
def test_a_missing_key_is_its_default_and_a_missing_entry_is_refused(kind):
    data = yaml.safe_load(robot.to_yaml(kind()))
    for path in paths(data):
        changed = copy.deepcopy(data)
        owner = changed
        for key in path[:-1]:
            owner = owner[key]
        del owner[path[-1]]
        if isinstance(path[-1], int):
            with pytest.raises(ConfigError, match="allowed"):
                robot.fill(kind, changed, "file.yaml")
        else:
            assert robot.fill(kind, changed, "file.yaml") == kind()


@pytest.mark.parametrize(
    "value", [".nan", ".inf", "-.inf", "~", "1e6", "0x7fffffff", "2026-11-22", "!!set {a}", "1:30"]
)
def test_what_yaml_makes_of_a_watchdog_is_refused(tmp_path, value):
    path = tmp_path / "robot.yaml"
    for key in ("late", "stale_arm", "overspeed", "following_ticks", "table_margin"):
        path.write_text(f"safety: {{{key}: {value}}}")
        with pytest.raises(ConfigError, match=rf"robot.yaml: safety\.{key}: got .*; allowed: "):
            robot.load_robot(path)


def test_the_generated_page_documents_every_ceiling():
    script = "import generated_pages as g; from experiments.config.robot import RANGES, RigParams, RobotConfig\n"
    script += "for kind in (RobotConfig, RigParams): print(g.dataclass_page('t', 'c', kind, RANGES))"
    folder = Path(robot.__file__).parents[2] / "docs" / "_ext"
    page = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True, check=True).stdout
    for path, (low, high) in robot.RANGES[RobotConfig].items():
        row = rf"\| `{path.split('.')[-1]}` \|.*{re.escape(f'| {low:g} to {high:g} |')}"
        assert re.search(row, page), path


def test_every_number_of_a_robot_has_a_ceiling():
    data = yaml.safe_load(robot.to_yaml(RobotConfig()))
    found = {".".join(str(key) for key in path if isinstance(key, str)) for path in paths(data)}
    sections = {"arm", "axes", "axes_motion", "tracker", "delays", "safety", "realtime"}
    sections |= {"calibration", *(f"calibration.{part}" for part in ("tracker", "robot", "clock"))}
    words = {
        "name",
        "robot",
        "axis_profile",
        "axes.combined",
        "realtime.lock_memory",
        *(f"calibration.{part}.date" for part in ("tracker", "robot", "clock")),
        *(f"{d}.{n}" for d in ("arm", "axes", "tracker") for n in ("host", "controller", "source")),
    }
    assert found - sections - words == set(RANGES)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("axes_motion: {acceleration: 10.0}", "axes_motion.acceleration is 10.0 m/s^2, allowed is at least 15.0"),
        ("axis_profile: fhpp\naxes: [{}, {velocity_unit: 0.001}]", "axes.velocity_unit is 0.001, allowed is no such"),
    ],
)
def test_what_voids_a_proof_or_reaches_no_drive_is_refused(tmp_path, text, says):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(says)):
        robot.load_robot(path)


def test_units_of_a_drive_reach_its_profile_and_no_axis_outlasts_the_gate(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("safety: {late: 0.02}\naxes: [{}, {combined: false, base_velocity: 3.0, position_unit: 1.0e-5}]")
    axes = linear_axes(robot.load_robot(path))
    first, second = (channel.axis for channel in axes._channels)
    assert (first.profile, second.profile) == (CmmtProfile(), CmmtProfile(position_unit=1e-5, base_velocity=3.0))
    assert (first.link._combined, second.link._combined) == (True, False)
    assert axes.config.command_timeout == 0.02


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
