"""The robot's MJCF and the chain constants read from it, against MuJoCo C, the contract and the data sheet."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf
from mjx_tt.robot.chain import chain_from_model, site_frame
from robot_io.contract import JOINT_NAMES, LIMITS
from tests.oracles.chains import CART, CRANE, SKEW, pendulum


@pytest.fixture(scope="module")
def model():
    return mjcf.load_model()


def link_frames(chain, q):
    """World pose (origin, rotation) of every link, by the formula in ``Link``'s docstring and Rodrigues' rotation."""
    origin, rotation = np.zeros(3), np.eye(3)
    frames = []
    for link, angle in zip(chain.links, q, strict=True):
        axis, anchor, rot = np.array(link.axis), np.array(link.anchor), np.array(link.rot)
        k = np.cross(np.eye(3), axis)  # k @ v = axis x v
        turn = np.eye(3) if link.slide else np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
        shift = axis * angle if link.slide else anchor - turn @ anchor
        origin, rotation = origin + rotation @ (np.array(link.pos) + rot @ shift), rotation @ rot @ turn
        frames.append((origin, rotation))
    return frames


def chain_models():
    return [
        pytest.param(mjcf.load_model(), mjcf.PADDLE_SITE, id="robot"),
        pytest.param(mujoco.MjModel.from_xml_string(SKEW), "tip", id="skew"),
        pytest.param(mujoco.MjModel.from_xml_string(CRANE), "tip", id="crane"),
        pytest.param(mujoco.MjModel.from_xml_string(CART), "tip", id="cart"),
        pytest.param(pendulum(child='<body pos="0 .1 0" euler="0 9 0"><geom size=".1"/></body>'), "end", id="pendulum"),
    ]


@pytest.mark.parametrize(("model", "site"), chain_models())
def test_chain_poses_match_mujoco(model, site):
    chain, frame, data = chain_from_model(model), site_frame(model, site), mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = rng.uniform(-2, 2, model.nq)
        mujoco.mj_kinematics(model, data)
        origin, rotation = link_frames(chain, data.qpos)[frame.link]
        np.testing.assert_allclose(origin + rotation @ frame.pos, data.site(site).xpos, atol=1e-13)
        np.testing.assert_allclose(rotation @ frame.rot, data.site(site).xmat.reshape(3, 3), atol=1e-13)


@pytest.mark.parametrize(("model", "site"), chain_models())
def test_chain_inertias_and_forces_match_mujoco(model, site):
    """The kinetic energy of the links, each from its own motion by central differences, and the gravity and actuator
    forces of the chain equal what MuJoCo computes from the bodies."""
    chain, data = chain_from_model(model), mujoco.MjData(model)
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, qd, ctrl = rng.uniform(-1, 1, (3, model.nv))
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, qd, ctrl[: model.nu]
        mujoco.mj_forward(model, data)
        mass_matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass_matrix)
        np.testing.assert_allclose(qd @ mass_matrix @ qd / 2, kinetic_energy(chain, q, qd), rtol=1e-7)
        slope = [
            (potential_energy(chain, q + dq) - potential_energy(chain, q - dq)) / 2e-5 for dq in 1e-5 * np.eye(model.nv)
        ]
        still = mujoco.MjData(model)
        still.qpos[:] = q
        mujoco.mj_forward(model, still)
        np.testing.assert_allclose(slope, still.qfrc_bias - still.qfrc_gravcomp, atol=1e-6)
        force = [
            link.gain * ctrl[link.ctrl_index] + link.bias0 + link.bias_qpos * q[i] + link.bias_qvel * qd[i]
            for i, link in enumerate(chain.links)
        ]
        np.testing.assert_allclose(force, data.qfrc_actuator, rtol=1e-12, atol=1e-12)
        friction = [-link.damping * v for link, v in zip(chain.links, qd, strict=True)]
        np.testing.assert_allclose(friction, data.qfrc_damper, atol=1e-12)


def kinetic_energy(chain, q, qd, eps=1e-5):
    ahead, behind, now = (link_frames(chain, q + s * eps * qd) for s in (1, -1, 0))
    energy = 0.0
    for link, speed, (p1, r1), (p0, r0), (_, rotation) in zip(chain.links, qd, ahead, behind, now, strict=True):
        velocity = (p1 + r1 @ np.array(link.com) - p0 - r0 @ np.array(link.com)) / (2 * eps)
        spin = rotation.T @ (r1 - r0) / (2 * eps)  # skew matrix of the angular velocity in the link's frame
        omega = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
        energy += link.mass * velocity @ velocity / 2 + omega @ np.array(link.inertia) @ omega / 2
        energy += link.armature * speed**2 / 2
    return energy


def potential_energy(chain, q):
    """Of the weight that gravity compensation leaves."""
    return -sum(
        (1 - link.gravcomp) * link.mass * np.array(chain.gravity) @ (origin + rotation @ np.array(link.com))
        for link, (origin, rotation) in zip(chain.links, link_frames(chain, q), strict=True)
    )


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


def test_capsules_are_the_collision_geoms(model):
    data = mujoco.MjData(model)
    data.qpos[:] = np.random.default_rng(2).uniform(LIMITS.lower, LIMITS.upper)
    mujoco.mj_forward(model, data)
    frames = link_frames(chain_from_model(model), data.qpos)
    found = mjcf.capsules(model)
    named = [model.geom(i).name for i in range(model.ngeom)]
    assert [c.name for c in found] == [n for n in named if n.startswith("col_") and n != "col_table"]
    for capsule in found:
        geom = data.geom(capsule.name)
        origin, rotation = frames[capsule.link]
        ends = [origin + rotation @ p for p in (capsule.p0, capsule.p1)]
        half = geom.xmat.reshape(3, 3)[:, 2] * model.geom(capsule.name).size[1]
        np.testing.assert_allclose(ends, [geom.xpos - half, geom.xpos + half], atol=1e-12)
        assert capsule.radius == model.geom(capsule.name).size[0]
