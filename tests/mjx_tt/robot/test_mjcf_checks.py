"""Mistakes in a user's YAML or MJCF: each is refused with file, key or element, and what to change."""

from __future__ import annotations

import shutil

import pytest

from mjx_tt.robot import robots

YAML, MJCF = "description.yaml", "robot.xml"


@pytest.fixture
def folder(tmp_path):
    """A copy of the arm on one axis that a test may break."""
    return shutil.copytree(robots.SHIPPED / "ur10e_rail", tmp_path / "mine")


def refusal(folder) -> str:
    with pytest.raises(ValueError) as caught:
        robots.load(folder)
    return str(caught.value)


def test_a_copy_is_the_robot_itself(folder):
    assert robots.load(folder) == robots.load(folder / YAML) == robots.load_shipped("ur10e_rail")


ELBOW = "elbow: {range: [-3.14, 3.14]"
# What: file, text in it, text in its place, what the message says.
MISTAKES = {
    "degrees": (
        YAML,
        ELBOW,
        "elbow: {range: [-180, 180]",
        ["joints.elbow.range: expected radians, not degrees", "got [-180.0, 180.0]"],
    ),
    "policy too fast": (YAML, "policy_velocity: 2,", "policy_velocity: 3,", ["joints.rail: policy_velocity 3", "2.0]"]),
    "home outside": (YAML, "home: 0.1}", "home: 1.2}", ["joints.rail.home: expected", "-0.99 to 0.99, got 1.2"]),
    "no such capsule": (
        YAML,
        "[col_base, col_wrist]",
        "[col_base, col_wirst]",
        ["pairs: got 'col_wirst'", "col_wrist"],
    ),
    "milliseconds": (
        YAML,
        "arm_action: [0.05,",
        "arm_action: [50,",
        ["latencies.arm_action[0]: expected a number from 0 to 1 s, got 50"],
    ),
    "home in the table": (YAML, "position: [0, -2.3, -0.45]", "position: [0, -1.4, -0.6]", ["at home", "the table"]),
    "position servo": (
        MJCF,
        '<velocity name="elbow" joint="elbow" kv=',
        '<position name="elbow" joint="elbow" kp=',
        ["actuator elbow: is no velocity servo", '<velocity name="elbow" joint="elbow" kv="..."/>'],
    ),
    "box for capsule": (
        MJCF,
        '<geom name="col_wrist" class="ur10e_collision" fromto="0 0 -.02 0 0 .12" size=".06"/>',
        '<geom name="col_wrist" type="box" size=".06 .06 .1"/>',
        ["geom col_wrist: must be a capsule", 'write type="capsule"'],
    ),
    "paddle on the forearm": (
        MJCF,
        '<body name="wrist_1" ',
        '<site name="bat"/><body name="wrist_1" ',
        ["site bat: is moved by joint elbow", "a body that the last joint moves"],
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_mistake_is_refused_with_file_element_and_remedy(folder, what):
    name, before, after, said = MISTAKES[what]
    file = folder / name
    text = file.read_text(encoding="utf-8")
    assert before in text
    file.write_text(text.replace(before, after, 1), encoding="utf-8")
    if what == "paddle on the forearm":
        yaml = folder / YAML
        yaml.write_text(yaml.read_text(encoding="utf-8").replace("paddle: paddle", "paddle: bat"), encoding="utf-8")
    message = refusal(folder)
    assert str(folder / YAML) in message or str(folder / MJCF) in message
    for part in said:
        assert part in message
