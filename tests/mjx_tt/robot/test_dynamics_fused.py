"""The fused engine against MuJoCo C's implicitfast step, and against MJX over whole episodes."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from mjx_tt.env.policy import PolicyController, initial_theta
from mjx_tt.robot import mjcf, robots
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.dynamics_fused import FusedEngine
from mjx_tt.robot.dynamics_mjx import MjxEngine
from mjx_tt.sim.model import LATENCIES, LatencyParams
from robot_io.contract import N_OBSERVATION, unflatten
from tests.oracles.chains import CART, CRANE, SKEW, pendulum
from tests.support import scripted_episodes

FLUID = '<option integrator="implicitfast" {}="1.2"><flag contact="disable" constraint="disable"/></option>'


def step_in_c(model, qpos, qvel, ctrl):
    """mj_step from every column of qpos (nq, n), qvel, ctrl: the next qpos and qvel."""
    data, after = mujoco.MjData(model), []
    for q, v, u in zip(qpos.T, qvel.T, ctrl.T, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_step(model, data)
        after.append(np.concatenate([data.qpos, data.qvel]))
    return np.split(np.array(after).T, 2)


def a_pendulum():
    return pendulum(body='gravcomp=".7"', actuator='<position joint="hinge" kp="5" kv=".3"/>')


@pytest.mark.parametrize(
    ("model", "timestep"),
    [
        *(pytest.param(robots.load_shipped(name).model(), None, id=name) for name in robots.names()),
        pytest.param(mujoco.MjModel.from_xml_string(SKEW), 1 / 300, id="skew"),
        pytest.param(mujoco.MjModel.from_xml_string(CRANE), None, id="crane"),
        pytest.param(mujoco.MjModel.from_xml_string(CART), 1 / 300, id="cart"),
        pytest.param(a_pendulum(), 0.01, id="pendulum"),
        pytest.param(pendulum(joint='type="slide" axis="1 2 3" damping="2"'), 0.01, id="slide"),
    ],
)
def test_fused_equals_mujoco_c_in_float64(model, timestep):
    """1,000 random states, at speeds where Coriolis forces and the implicit damping both matter."""
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-2, 2, (model.nq, 1000)), rng.uniform(-6, 6, (model.nv, 1000))
    ctrl = rng.uniform(-6, 6, (model.nu, 1000))
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        engine = FusedEngine(chain_from_model(model), timestep)
        ours = jax.jit(engine.step)(qpos, qvel, ctrl)
    model.opt.timestep = timestep or model.opt.timestep
    exact = step_in_c(model, qpos, qvel, ctrl)
    for mine, theirs, before in zip(ours, exact, (qpos, qvel), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
        assert np.median(np.abs(theirs - before)) > 1e-3  # a step that moves nothing would prove nothing


def test_fused_in_float32_stays_within_its_rounding():
    model = mjcf.load_model()
    rng = np.random.default_rng(1)
    qpos, qvel, ctrl = rng.uniform(-2, 2, (3, model.nq, 1000))
    single = [x.astype(np.float32) for x in (qpos, qvel, ctrl)]
    after = jax.jit(FusedEngine(chain_from_model(model)).step)(*single)
    assert all(x.dtype == np.float32 for x in after)
    for mine, theirs in zip(after, step_in_c(model, *(x.astype(float) for x in single)), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-5)


@pytest.mark.optimised
@pytest.mark.slow
def test_whole_episodes_agree_with_mjx_in_float32():
    """200 control steps of four random policies in closed loop, with noise and the paper's latencies. The ball flies
    slowly, without gravity, so that the episode lasts; the paddle travels decimetres and stays within 0.5 mm."""
    theta = np.stack([initial_theta(jax.random.key(i)) for i in range(4)], axis=1)
    policy = PolicyController(unflatten(theta), np.zeros(N_OBSERVATION, np.float32), np.ones(N_OBSERVATION, np.float32))
    delays = {name: getattr(LatencyParams(), name) for name in LATENCIES}
    batch = scripted_episodes.episodes(
        [0.2, 1.2, 0.4], [0.0, -1.2, 0.0], delays, scripted_episodes.model(ball_noise=0.04, gravity=0.0), p=4
    )
    fused, mjx = (
        scripted_episodes.play(scripted_episodes.task(engine), batch, policy, ticks=200) for engine in ("fused", "mjx")
    )
    assert fused.paddle.dtype == mjx.paddle.dtype == np.float32
    assert fused.live.all() and mjx.live.all()
    assert np.linalg.norm(fused.paddle - mjx.paddle, axis=1).max() < 0.5e-3
    np.testing.assert_allclose(fused.qpos, mjx.qpos, rtol=0, atol=1e-3)
    assert np.ptp(fused.paddle, axis=0).max(axis=0).min() > 0.2


@pytest.mark.parametrize("option", ["density", "viscosity"])
def test_fluid_forces_are_refused_by_both_engines(option):
    """MJX computes only MuJoCo's inertia-box drag and drops a ball's Magnus force without a word."""
    model = pendulum(option=FLUID.format(option))
    for build in (lambda: FusedEngine(chain_from_model(model)), lambda: MjxEngine(model)):
        with pytest.raises(ValueError, match=f"option {option}: must be 0"):
            build()
