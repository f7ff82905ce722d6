"""robot.yaml and rig.yaml, mutated: no watchdog is loosened beyond its ceiling, nothing ends in a traceback."""

from __future__ import annotations

import copy
import re

import pytest
import yaml

from experiments.config import robot
from experiments.errors import ConfigError
from robot_io.control.config import RobotConfig, linear_axes
from robot_io.devices.festo import CmmtProfile
from robot_io.emulator.config import RigParams

VALUES = [0, 1, -1, 7, 0.5, -0.25, 1e-9, 1e6, 1e308, -1e308, 10**400, float("inf"), float("nan"), 65536]
VALUES += [True, None, "x", "1", [], [1.0], [1e300] * 8, [-1.0, 1.0], {}, {"x": 1}]
# What protects people and robot ends here, whatever a file says (docs/concepts/safety.md).
CEILINGS = {
    "arm.timeout": (0.01, 0.1),
    "axes_motion.node_guard": (0.02, 0.2),
    "axes_motion.command_timeout": (0.02, 0.1),
    "axes_motion.state_timeout": (0.02, 0.1),
    "tracker.clock_bound": (0.001, 0.02),
    "safety.speed_scale": (0.001, 1.0),
    "safety.head_room": (0.5, 1.0),
    "safety.drive_delay": (0.0, 0.3),
    "safety.drive_delay_error": (0.0, 0.05),
    "safety.silence": (0.004, 10.0),
    "safety.table_margin": (0.01, 0.5),
    "safety.floor_margin": (0.15, 0.7),
    "safety.overspeed": (1.05, 2.0),
    "safety.following_error": (0.005, 0.4),
    "safety.delay": (0.0, 0.3),
    "safety.following_ticks": (1, 6),
    "safety.late": (0.02, 0.1),
    "safety.stale_arm": (0.01, 0.1),
    "safety.stale_axes": (0.01, 0.1),
    "safety.stale_tracker": (0.01, 0.05),
    "safety.stale_policy": (0.02, 0.1),
    "calibration.robot.base_position": (-0.03, 0.03),
    "calibration.robot.joint_zeros": (-0.05, 0.05),
}


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
    """A refusal names the file, the key, what is allowed and what was given."""
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
                    undated = path[0] == "calibration" and f"file.yaml: {dotted(path[:2])}.date: expected"
                    assert line.startswith((f"file.yaml: {key}", undated or f"file.yaml: {key}")), line
                    assert "expected " in line and "got " in line, line
                continue
            accepted += 1
            for name, (low, high) in CEILINGS.items() if kind is RobotConfig else ():
                assert all(low <= number <= high for number in numbers(config, name)), (path, value)
    assert refused > 1000 and accepted > 50


@pytest.mark.parametrize(
    "value", [".nan", ".inf", "-.inf", "~", "1e6", "0x7fffffff", "2026-11-22", "!!set {a}", "1:30"]
)
def test_what_yaml_makes_of_a_watchdog_is_refused(tmp_path, value):
    path = tmp_path / "robot.yaml"
    for key in ("late", "stale_arm", "overspeed", "following_ticks", "table_margin"):
        path.write_text(f"safety: {{{key}: {value}}}")
        with pytest.raises(ConfigError, match=rf"robot.yaml: safety\.{key}: expected .* from .*, got "):
            robot.load_robot(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("axes_motion: {acceleration: 10.0}", "axes_motion.acceleration: expected at least 15.0 m/s^2"),
        ("axis_profile: fhpp\naxes: [{}, {velocity_unit: 0.001}]", "axes.velocity_unit: expected no such key"),
        (
            "axis_profile: EXCM-30",
            "an EXCM moves both axes of its gantry behind one controller, which is not supported",
        ),
        ("axes_motion: {lead: 0.08}", "safety.silence[0]: expected at least axes_motion.lead, 0.08 s"),
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
