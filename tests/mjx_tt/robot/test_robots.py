"""Robots from a folder: the paper's is what its contract says, and the others follow from their YAML and MJCF."""

from __future__ import annotations

import json

import jax
import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf, robots
from mjx_tt.robot.clearance import CapsuleClearance
from mjx_tt.robot.kinematics import PaddleKinematics
from robot_io import contract
from robot_io.contract import PAPER
from robot_io.safety.clearance import RobotGeometry
from tests.support.clearances import clearances

NAMES = robots.names()
OTHERS = [name for name in NAMES if name != robots.DEFAULT]


def test_the_papers_robot_is_its_folder():
    """Limits and network of the YAML, and dynamics put at the table as any other robot's, are the constants'."""
    paper, scene = robots.paper(), mjcf.load_model()
    assert paper.contract is PAPER and paper.file.contract == PAPER
    assert robots.chain_from_model(paper.model()) == robots.chain_from_model(scene)
    np.testing.assert_array_equal(paper.home, mjcf.home_qpos(scene))
    assert contract.n_parameters() == 976
    assert contract.describe(PAPER) == contract.describe() and "robot" not in contract.describe()


@pytest.mark.parametrize("name", NAMES)
def test_the_scene_file_holds_the_robot_at_home(name):
    """The file for programs that want one is the model in memory, to the digits that MuJoCo writes."""
    robot = robots.load_shipped(name)
    written, model = mujoco.MjModel.from_xml_path(str(robot.scene())), robot.model()
    data = [mujoco.MjData(m) for m in (written, model)]
    for d, m in zip(data, (written, model), strict=True):
        d.qpos[:] = m.key("home").qpos
        mujoco.mj_forward(m, d)
    np.testing.assert_allclose(data[0].qpos, robot.home, atol=1e-5)
    np.testing.assert_allclose(data[0].site("paddle").xpos, data[1].site("paddle").xpos, atol=1e-5)
    inertia = np.zeros((2, model.nv, model.nv))
    for matrix, d, m in zip(inertia, data, (written, model), strict=True):
        mujoco.mj_fullM(m, d, matrix)
    np.testing.assert_allclose(*inertia, rtol=1e-4, atol=1e-5)
    assert not written.geom_contype.any() and not written.geom_conaffinity.any()


@pytest.mark.parametrize("name", OTHERS)
def test_the_base_stands_where_the_mount_says(name):
    robot = robots.load_shipped(name)
    moved = robot.mounted((0.1, -2.0, -0.25), robot.file.yaw + 0.5, robot.file.home)
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
    blades = []
    for one in (robot, moved):
        data = mujoco.MjData(model := one.model())
        data.qpos[:] = one.home
        mujoco.mj_kinematics(model, data)
        blades.append(data.site("paddle").xpos - one.file.position)
    np.testing.assert_allclose(blades[1], turn @ blades[0], atol=1e-12)


@pytest.mark.parametrize("name", OTHERS)
def test_the_gates_geometry_is_the_simulations_and_mujocos(name):
    """Gaps in random poses: the robot's side from the contract alone, the simulation, and MuJoCo C."""
    robot = robots.load_shipped(name)
    limits, model = robot.contract.limits, robot.model()
    lower, upper = np.array(limits.lower)[:, None], np.array(limits.upper)[:, None]
    q = np.random.default_rng(0).uniform(lower, upper, (len(lower), 400))
    ours = RobotGeometry.of(contract.from_description(json.loads(json.dumps(contract.describe(robot.contract)))))
    with jax.enable_x64(True):
        kinematics = PaddleKinematics(robot.chain(), robot.paddle())
        clearance = CapsuleClearance(kinematics, robot.capsules(), robot.file)
        simulated = jax.tree.map(np.asarray, jax.jit(lambda q: clearance(kinematics.links(q), q[0]))(q))
    found = clearances(ours, q)
    for name, mine in found.items():
        np.testing.assert_allclose(mine, getattr(simulated, name), atol=1e-4)  # the simulation bisects
    data = mujoco.MjData(model)
    for i in range(100):
        data.qpos[:] = q[:, i]
        mujoco.mj_kinematics(model, data)
        own = min(
            mujoco.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 5.0, None)
            for a, b in robot.file.pairs
        )
        if own > 0.0:
            assert found["own"][i] == pytest.approx(own, abs=1e-6)
    np.testing.assert_allclose(ours.home, robot.home, atol=1e-12)
    assert (ours.gaps(robot.home[:, None]) > 0.0).all()


@pytest.mark.parametrize("name", OTHERS)
def test_a_contract_survives_its_description(name):
    """The contract in an artefact's manifest is read again without the MJCF."""
    own = robots.load_shipped(name).contract
    again = contract.from_description(json.loads(json.dumps(contract.describe(own))))
    assert again == own and hash(again) == hash(own)
    shapes = contract.parameter_shapes(own.n_joints)
    inputs, outputs = shapes["conv1/kernel"][1], shapes["conv3/kernel"][2]
    assert (inputs, outputs) == (own.n_observation, own.n_joints) == (3 + len(own.joints), len(own.joints))
    theta = np.arange(contract.n_parameters(own.n_joints))
    assert sum(part.size for part in contract.unflatten(theta, shapes).values()) == theta.size
    with pytest.raises(ValueError, match=f"theta has {theta.size} parameters, expected 976"):
        contract.unflatten(theta)
