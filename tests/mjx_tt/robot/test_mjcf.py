"""The robot's MJCF and the chain constants read from it, against MuJoCo C, the contract and the data sheet."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf
from mjx_tt.robot.chain import chain_from_model
from robot_io.contract import JOINT_NAMES
from robot_io.limits import LIMITS
from tests.oracles.chains import pendulum


@pytest.fixture(scope="module")
def model():
    return mjcf.load_model()


OTHER_OPTION = '<option integrator="implicitfast" {}><flag contact="disable" constraint="disable" {}/></option>'
SECOND_BODY = '<body name="second"><joint name="second"/><geom size=".1"/></body>'

REFUSED = {
    "free joint": (dict(world='<body><freejoint name="loose"/><geom size=".1"/></body>'), "loose: free joints"),
    "branch": (dict(child=SECOND_BODY + SECOND_BODY.replace("second", "third")), "third: branches off beside second"),
    "mocap base": (dict(world=f'<body mocap="true">{SECOND_BODY}</body>'), "second: a chain on a mocap body"),
    "gravcomp": (
        dict(child='<body name="load" gravcomp="1"><geom size=".1"/></body>'),
        "load: gravcomp must equal that of arm",
    ),
    "limits": (
        dict(joint='range="-1 1"', option='<option integrator="implicitfast"><flag contact="disable"/></option>'),
        "hinge: joint limits need constraints to be disabled",
    ),
    "contacts": (dict(geom='contype="1"', option='<option integrator="implicitfast"/>'), "rod: geom can collide"),
    "integrator": (
        dict(option='<option integrator="Euler"><flag constraint="disable"/></option>'),
        "option integrator: only implicitfast .* mjINT_EULER",
    ),
    "no gravity": (dict(option=OTHER_OPTION.format("", 'gravity="disable"')), "flag gravity"),
    "two actuators": (
        dict(actuator='<motor name="m" joint="hinge"/><velocity name="v" joint="hinge" kv="1"/>'),
        "v: joint hinge already has actuator m",
    ),
    "site actuator": (dict(actuator='<motor name="m" site="end"/>'), "m: only joint transmissions .* mjTRN_SITE"),
}


@pytest.mark.parametrize(("parts", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_unsupported_elements_are_refused_by_name(parts, message):
    with pytest.raises(ValueError, match=message):
        chain_from_model(pendulum(**parts))


def test_joints_and_actuators_follow_the_contract(model):
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINT_NAMES
    assert tuple(model.actuator(i).name for i in range(model.nu)) == JOINT_NAMES
    assert [link.ctrl_index for link in chain_from_model(model).links] == list(range(len(JOINT_NAMES)))
    assert model.jnt_limited.all()
    np.testing.assert_allclose(model.jnt_range.T, [LIMITS.lower, LIMITS.upper], atol=1e-12)


def test_arm_geometry_matches_the_data_sheet(model):
    """With all joints at zero the arm points along y; ABB's 290, 270, 70, 302 and 72 mm and the paddle's 174.3 mm
    extension and 76 mm blade radius add up."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = data.body("gantry_y").xpos
    reach = 0.302 + 0.072 + 0.1743 + 0.076
    np.testing.assert_allclose(data.site("paddle").xpos - base, [0, reach, 0.290 + 0.270 + 0.070], atol=1e-12)
    masses = [model.body(f"link_{i}").mass[0] for i in range(1, 6)]
    np.testing.assert_allclose(masses, [3.067, 3.909, 2.944, 1.328, 0.546])


def test_link_6_carries_flange_extension_and_blade(model):
    """Parallel axes, by hand: flange with its placeholder inertia, a tube of radius 20 mm, a disc of 76 mm."""
    length, tube, blade = 0.1743, 0.02, 0.076
    parts = [  # mass, x of the centre of mass, inertia about x, y (the disc's normal), z
        (0.137, -0.007, np.full(3, 0.001)),
        (0.25, length / 2, 0.25 * np.array([tube**2, *[length**2 / 12 + tube**2 / 2] * 2])),
        (0.14, length + blade, 0.14 * blade**2 * np.array([1 / 4, 1 / 2, 1 / 4])),
    ]
    mass = sum(m for m, _, _ in parts)
    com = sum(m * x for m, x, _ in parts) / mass
    inertia = sum(i + m * (x - com) ** 2 * np.array([0, 1, 1]) for m, x, i in parts)
    link = chain_from_model(model).links[-1]
    assert link.mass == pytest.approx(mass)
    np.testing.assert_allclose(link.com, [com, 0, 0], atol=1e-5)
    np.testing.assert_allclose(np.diag(link.inertia), inertia, rtol=1e-3)
