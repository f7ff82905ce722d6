"""World poses and velocities against MuJoCo."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf, robots
from mjx_tt.robot.chain import chain_from_model, site_frame
from mjx_tt.robot.kinematics import PaddleKinematics
from tests.oracles.chains import CART, CRANE, SKEW

MODELS = [
    *(pytest.param(robots.load_shipped(name).model(), mjcf.PADDLE_SITE, id=name) for name in robots.names()),
    pytest.param(mujoco.MjModel.from_xml_string(SKEW), "tip", id="skew"),
    pytest.param(mujoco.MjModel.from_xml_string(CRANE), "tip", id="crane"),
    pytest.param(mujoco.MjModel.from_xml_string(CART), "tip", id="cart"),
]


def site_in_mujoco(model, name, q, qd):
    """Position, z axis, velocity and angular velocity of a site in the world, each (3,)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, qd
    mujoco.mj_forward(model, data)
    twist = np.zeros(6)  # rotational part first
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site(name).id, twist, 0)
    site = data.site(name)
    return site.xpos.copy(), site.xmat.reshape(3, 3)[:, 2], twist[3:], twist[:3]


def random_states(model, n, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(-2, 2, (model.nq, n)), rng.uniform(-6, 6, (model.nv, n))


@pytest.mark.parametrize(("model", "site"), MODELS)
@pytest.mark.parametrize(("x64", "atol"), [(True, 1e-12), (False, 2e-5)], ids=["float64", "float32"])
def test_pose_and_velocity_of_a_site_match_mujoco(model, site, x64, atol):
    q, qd = random_states(model, 50, 0)
    with jax.enable_x64(x64):
        if not x64:
            q, qd = q.astype(np.float32), qd.astype(np.float32)
        kinematics = PaddleKinematics(chain_from_model(model), site_frame(model, site))
        pose = jax.tree.map(np.asarray, jax.jit(kinematics.pose)(q, qd))
    for i in range(q.shape[1]):
        exact = site_in_mujoco(model, site, q[:, i], qd[:, i])
        for name, wanted in zip(("position", "normal", "velocity", "angular_velocity"), exact, strict=True):
            found = getattr(pose, name)
            assert found.dtype == q.dtype
            np.testing.assert_allclose(found[:, i], wanted, atol=atol * max(1.0, np.abs(wanted).max()), err_msg=name)
