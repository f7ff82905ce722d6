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
    "ends swapped": (YAML, ELBOW, "elbow: {range: [3.14, -3.14]", ["joints.elbow.range", "below the upper"]),
    "margin fills range": (YAML, "margin: 0.01", "margin: 1.5", ["joints.rail: range", "no room", "1.5"]),
    "no such joint": (YAML, "elbow:", "elbo:", ["joints.elbo: the MJCF has no such joint", "it has rail", "elbow"]),
    "slide not listed": (YAML, "carrying: [rail]", "carrying: []", ["carrying: joint rail is a slide", "list it"]),
    "hinge listed": (YAML, "carrying: [rail]", "carrying: [rail, elbow]", ["joint elbow is no slide", "remove"]),
    "no such site": (YAML, "paddle: paddle", "paddle: bat", ["paddle: got 'bat'", "sites of the MJCF: paddle"]),
    "unknown effect": (YAML, "clearance:", "drives: {elbow: {lagg: 0.1}}\nclearance:", ["drives.elbow.lagg", "lag,"]),
    "twice": (YAML, "name: ur10e_rail", "name: a\nname: b", ["not valid YAML", "'name' is given twice"]),
    "no file": (YAML, "mjcf: robot.xml", "mjcf: arm.xml", ["mjcf: arm.xml cannot be read"]),
    "no XML": (MJCF, "</mujoco>", "", ["MuJoCo cannot compile it"]),
    "no actuator": (
        MJCF,
        '    <velocity name="elbow" joint="elbow"',
        '    <velocity name="elbow" joint="wrist_1"',
        ["joint elbow: has no actuator", "add <velocity"],
    ),
    "joint not listed": (
        MJCF,
        '<joint name="elbow" range="-180 180"/>',
        '<joint name="elbow" range="-180 180"/><joint name="play" range="-1 1"/>',
        ["joint play: is not listed under joints", "list it there or remove"],
    ),
    "dry friction": (MJCF, 'damping=".15"', 'damping=".15" frictionloss=".1"', ["frictionloss", "coulomb_friction"]),
    "spring": (MJCF, 'damping=".15"', 'damping=".15" stiffness="9"', ["wrist_1: joint stiffness", "remove stiffness"]),
    "force range": (
        MJCF,
        'joint="elbow" kv',
        'joint="elbow" forcerange="-1 1" kv',
        ["elbow: forcelimited", "remove forcerange"],
    ),
    "air": (
        MJCF,
        "  <default>\n",
        '  <option density="1.2"/>\n  <default>\n',
        ["option density: must be 0", "got 1.2; remove it"],
    ),
    "a ball of its own": (MJCF, '<body name="carriage"', '<body name="ball"', ["cannot stand", "ball", "rename it"]),
    "tied joints": (
        MJCF,
        "  <actuator>",
        '  <equality><joint joint1="wrist_1" joint2="wrist_2"/></equality>\n  <actuator>',
        ["equality constraints are not supported", "remove the <equality>"],
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
