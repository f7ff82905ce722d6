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
    "unknown key": (
        YAML,
        "carrying: [rail]",
        "carying: [rail]",
        ["carying: expected one of the keys", "mean 'carrying'"],
    ),
    "missing limit": (
        YAML,
        "{range: [-1, 1], velocity: 2,",
        "{range: [-1, 1],",
        ["joints.rail.velocity: expected a number", "got nothing"],
    ),
    "degrees": (
        YAML,
        ELBOW,
        "elbow: {range: [-180, 180]",
        ["joints.elbow.range: expected radians, not degrees", "got [-180.0, 180.0]"],
    ),
    "ends swapped": (YAML, ELBOW, "elbow: {range: [3.14, -3.14]", ["joints.elbow.range", "below the upper"]),
    "no number": (
        YAML,
        "acceleration: 15,",
        "acceleration: fast,",
        ["joints.elbow.acceleration: expected a number", "got 'fast'"],
    ),
    "negative speed": (
        YAML,
        "velocity: 2, acc",
        "velocity: -2, acc",
        ["joints.rail.velocity: expected a number of more than 0, got -2"],
    ),
    "policy too fast": (YAML, "policy_velocity: 2,", "policy_velocity: 3,", ["joints.rail: policy_velocity 3", "2.0]"]),
    "home outside": (YAML, "home: 0.1}", "home: 1.2}", ["joints.rail.home: expected", "-0.99 to 0.99, got 1.2"]),
    "margin fills range": (YAML, "margin: 0.01", "margin: 1.5", ["joints.rail: range", "no room", "1.5"]),
    "no such joint": (YAML, "elbow:", "elbo:", ["joints.elbo: the MJCF has no such joint", "it has rail", "elbow"]),
    "slide not listed": (YAML, "carrying: [rail]", "carrying: []", ["carrying: joint rail is a slide", "list it"]),
    "hinge listed": (YAML, "carrying: [rail]", "carrying: [rail, elbow]", ["joint elbow is no slide", "remove"]),
    "no such site": (YAML, "paddle: paddle", "paddle: bat", ["paddle: got 'bat'", "sites of the MJCF: paddle"]),
    "no such capsule": (
        YAML,
        "[col_base, col_wrist]",
        "[col_base, col_wirst]",
        ["pairs: got 'col_wirst'", "col_wrist"],
    ),
    "blade not watched": (
        YAML,
        "blade: [col_blade_axis,",
        "blade: [col_tip,",
        ["clearance.blade: expected capsules of table", "got 'col_tip'"],
    ),
    "milliseconds": (
        YAML,
        "arm_action: [0.05,",
        "arm_action: [50,",
        ["latencies.arm_action[0]: expected a number from 0 to 1 s, got 50"],
    ),
    "unknown effect": (YAML, "clearance:", "drives: {elbow: {lagg: 0.1}}\nclearance:", ["drives.elbow.lagg", "lag,"]),
    "wider than MJCF": (
        YAML,
        "rail: {range: [-1, 1]",
        "rail: {range: [-2, 2]",
        ["joints.rail.range", "MJCF's, [-1, 1]"],
    ),
    "twice": (YAML, "name: ur10e_rail", "name: a\nname: b", ["not valid YAML", "'name' is given twice"]),
    "no file": (YAML, "mjcf: robot.xml", "mjcf: arm.xml", ["mjcf: arm.xml cannot be read"]),
    "home in the table": (YAML, "position: [0, -2.3, -0.45]", "position: [0, -1.4, -0.6]", ["at home", "the table"]),
    "no XML": (MJCF, "</mujoco>", "", ["MuJoCo cannot compile it"]),
    "position servo": (
        MJCF,
        '<velocity name="elbow" joint="elbow" kv=',
        '<position name="elbow" joint="elbow" kp=',
        ["actuator elbow: is no velocity servo", '<velocity name="elbow" joint="elbow" kv="..."/>'],
    ),
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
    "a gripper's finger": (
        MJCF,
        '<body name="wrist_1" ',
        '<body name="finger"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="f"/></body>'
        '<body name="wrist_1" ',
        ["wrist_1: branches off beside finger", "remove one of the two"],
    ),
    "dry friction": (MJCF, 'damping=".15"', 'damping=".15" frictionloss=".1"', ["frictionloss", "coulomb_friction"]),
    "spring": (MJCF, 'damping=".15"', 'damping=".15" stiffness="9"', ["wrist_1: joint stiffness", "remove stiffness"]),
    "force range": (
        MJCF,
        'joint="elbow" kv',
        'joint="elbow" forcerange="-1 1" kv',
        ["elbow: forcelimited", "remove forcerange"],
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
    "air": (MJCF, "  <default>\n", '  <option density="1.2"/>\n  <default>\n', ["option density: is 1.2", "remove it"]),
    "a ball of its own": (MJCF, '<body name="carriage"', '<body name="ball"', ["cannot stand", "ball", "rename it"]),
    "tied joints": (
        MJCF,
        "  <actuator>",
        '  <equality><joint joint1="wrist_1" joint2="wrist_2"/></equality>\n  <actuator>',
        ["equality constraints are not supported", "remove the <equality>"],
    ),
    "axis after hinge": (
        MJCF,
        'name="elbow" range',
        'name="elbow" type="slide" range',
        ["carrying: joint elbow is a slide"],
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


def test_all_mistakes_of_a_file_are_named_at_once(folder):
    file = folder / YAML
    text = file.read_text(encoding="utf-8")
    for before, after in (("velocity: 2, acc", "velocity: -2, acc"), ("home: 1.701}", "home: 9}"), ("[0.05,", "[50,")):
        assert before in text
        text = text.replace(before, after, 1)
    file.write_text(text, encoding="utf-8")
    assert len(refusal(folder).splitlines()) == 3


def test_joints_in_another_order_are_refused(folder):
    file = folder / YAML
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if line.startswith("  elbow:"))
    lines[at], lines[at + 1] = lines[at + 1], lines[at]
    file.write_text("".join(lines), encoding="utf-8")
    message = refusal(folder)
    assert "joints: the order is rail, shoulder_pan, shoulder_lift, wrist_1, elbow" in message
    assert "from base to paddle it is rail, shoulder_pan, shoulder_lift, elbow, wrist_1" in message


@pytest.mark.parametrize("path", ["no_such_robot", "tests"])
def test_no_robot_is_refused_with_those_that_are_there(path):
    with pytest.raises(ValueError, match="fr3_pedestal, irb120_gantry, ur10e_rail|holds 0 YAML files"):
        robots.load(path)
