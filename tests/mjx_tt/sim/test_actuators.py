"""Drives against their differential equation in fine steps, alone and in front of MuJoCo's own robot."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mjx_tt.robot import mjcf
from mjx_tt.sim import actuators, model
from mjx_tt.sim.actuators import JointDrive
from robot_io.contract import JOINT_NAMES, N_JOINTS
from tests.support import scripted_episodes
from tests.support.scripted_episodes import episodes, mujoco_path, script, task

T, SUBSTEPS = 1 / 75, 4
H = T / SUBSTEPS
FINE = 100  # steps of the reference in a substep
TICKS = 40

# One episode each: the departures from nominal, by path under drives.
CASES = (
    {},
    {"gantry_x.lag": 0.05, "joint_2.lag": 0.03, "joint_6.lag": 0.001},
    {"gantry_y.acceleration_limit": 5.0, "joint_1.acceleration_limit": 20.0, "joint_1.lag": 0.02},
    {"gantry_x.velocity_gain": 1.1, "joint_3.velocity_limit": 0.5, "joint_4.velocity_gain": 0.8},
    {
        "gantry_y.coulomb_friction": 0.1,
        "gantry_y.deadband": 0.2,
        "joint_5.coulomb_friction": 0.5,
        "joint_6.deadband": 1.0,
    },
    {"gantry_x.backlash": 0.01, "joint_2.backlash": 0.03},
    {"joint_1.action_delay": 0.02, "joint_1.observation_delay": 0.015, "joint_3.joint_offset": -0.05},
    {
        "joint_2.action_delay": 0.04,
        "joint_2.observation_delay": 0.03,
        "joint_2.lag": 0.02,
        "joint_2.velocity_gain": 0.9,
        "joint_2.joint_offset": 0.02,
        "joint_2.velocity_limit": 0.8,
        "joint_2.acceleration_limit": 30.0,
        "joint_2.backlash": 0.02,
        "joint_2.coulomb_friction": 0.1,
        "joint_2.deadband": 0.15,
    },
)


UNLIMITED = {"velocity_gain": 1.0, "velocity_limit": np.inf, "acceleration_limit": np.inf}
NUMBERS = {  # (8, P) of each effect
    effect: np.array([[c.get(f"{joint}.{effect}", UNLIMITED.get(effect, 0.0)) for c in CASES] for joint in JOINT_NAMES])
    for effect in actuators.EFFECTS
}


def static(u):
    """Dead band, friction, gain and limit of commands (8, P)."""
    u = np.where(np.abs(u) < NUMBERS["deadband"], 0.0, u)
    c = NUMBERS["coulomb_friction"]
    u = np.select([u > c, u < -c], [u - c, u + c], 0.0) * NUMBERS["velocity_gain"]
    return np.minimum(np.maximum(u, -NUMBERS["velocity_limit"]), NUMBERS["velocity_limit"])


def respond(lag, a, v, u, seconds, fine=FINE):
    """Velocity and way after ``seconds`` of a constant u, by midpoint steps of dv/dt = clip((u - v) / lag, +-a)."""
    dt, way = seconds / fine, 0.0
    at_once = np.where(dt > 0, dt, 1.0)  # without a lag the rest of the way is made in one step

    def rate(v):
        return np.clip((u - v) / np.where(lag > 0, lag, at_once), -a, a)

    for _ in range(fine):
        before, v = v, v + dt * rate(v + 0.5 * dt * np.where(lag > 0, rate(v), 0.0))
        ideal = (lag == 0) & np.isinf(a)
        way = way + dt * np.where(ideal, u, 0.5 * (before + v))
    return v, way


def play_in(backlash, path):
    """Position of a part driven with play, sample by sample: it stays until the joint is half the play away."""
    out = [path[0]]
    for q in path[1:]:
        at = out[-1]
        out.append(q - backlash / 2 if q - at > backlash / 2 else q + backlash / 2 if at - q > backlash / 2 else at)
    return np.array(out)


def mean_velocities(command):
    """Velocities of the finely simulated drives under commands (TICKS, 8, P): means over substeps, (steps, 8, P)."""
    v, means = np.zeros(command.shape[1:]), []
    for step in range(TICKS * SUBSTEPS):
        # Where the command changes inside the substep, both parts one after the other.
        since = step * H - NUMBERS["action_delay"]
        tick = np.floor(since / T + 1e-9).astype(int)
        change = np.clip((tick + 1) * T - since, 0.0, H)
        way = 0.0
        for n, seconds in ((tick, change), (tick + 1, H - change)):
            held = np.take_along_axis(command, np.clip(n, 0, TICKS - 1)[None], axis=0)[0]
            u = np.where(n >= 0, static(held), 0.0)
            v, part = respond(NUMBERS["lag"], NUMBERS["acceleration_limit"], v, u, seconds)
            way = way + part
        means.append(way / H)
    return np.array(means)


def simulation():
    """The nominal model without noise and gravity, with drives that differ between the episodes."""
    changed = {name for case in CASES for name in case}
    nominal = {name: getattr(JointDrive(), name.split(".")[1]) for name in changed}
    values = {f"drives.{n}": jnp.array([case.get(n, nominal[n]) for case in CASES]) for n in changed}
    return model.with_values(scripted_episodes.model(gravity=0.0), values)


@pytest.mark.parametrize("engine", ["fused", pytest.param("mjx", marks=pytest.mark.slow)])
def test_the_robot_follows_its_drives_equations_under_both_engines(engine):
    """Joints, paddle and observation of eight episodes with different drives, against MuJoCo C behind the equations."""
    rng = np.random.default_rng(5)
    actions = np.repeat(rng.uniform(-0.3, 0.3, (TICKS // 8, N_JOINTS, 1)), 8, axis=0)
    with jax.enable_x64(True):
        batch = episodes([0.0, 1.0, 0.5], [0.0, 0.0, 0.0], simulation=simulation())
        record = scripted_episodes.play(task(engine), batch, script(actions, TICKS), TICKS)
    times, ticked = np.arange(TICKS * SUBSTEPS + 1) * H, np.arange(TICKS) * T
    mj = mjcf.load_model()
    data, velocities = mujoco.MjData(mj), mean_velocities(record.command)
    nominal = mujoco_path(velocities[..., 0])
    for i, case in enumerate(CASES):
        path = mujoco_path(velocities[..., i])
        carried = np.transpose([play_in(NUMBERS["backlash"][joint, i], path[:, joint]) for joint in range(N_JOINTS)])
        np.testing.assert_allclose(record.qpos[..., i], path[SUBSTEPS::SUBSTEPS], atol=1e-5, err_msg=str(case))
        for joint in range(N_JOINTS):
            moments = ticked - NUMBERS["observation_delay"][joint, i]
            wanted = np.interp(moments, times, carried[:, joint]) + NUMBERS["joint_offset"][joint, i]
            seen = record.controller[:, 3 + joint, i]
            # An observation without delay is read a microsecond late: up to 4e-6 rad.
            np.testing.assert_allclose(seen, wanted, atol=1e-5, err_msg=f"{case} {JOINT_NAMES[joint]}")
            if any(name.startswith(f"{JOINT_NAMES[joint]}.") for name in case):
                assert np.abs(seen - np.interp(ticked, times, nominal[:, joint])).max() > 2e-4, (case, joint)
        for tick in (10, TICKS - 1):
            data.qpos[:] = carried[SUBSTEPS * (tick + 1)]
            mujoco.mj_kinematics(mj, data)
            paddle = data.site(mjcf.PADDLE_SITE).xpos
            np.testing.assert_allclose(record.paddle[tick, :, i], paddle, atol=1e-5, err_msg=str(case))


def effects(**values) -> JointDrive:
    return JointDrive(**{name: values.get(name) for name in actuators.EFFECTS})


@pytest.mark.parametrize(
    "case",
    [
        {"lag": 0.03},
        {"lag": 1e-4},
        {"acceleration_limit": 7.0},
        {"lag": 0.02, "acceleration_limit": 40.0},
        {"lag": 0.0, "acceleration_limit": 300.0},
    ],
    ids=str,
)
def test_velocity_follows_exactly_over_a_substep_of_any_length(case):
    """Velocity and way against fine steps of the differential equation, over a substep and over half a second."""
    v, u = np.random.default_rng(0).uniform(-2, 2, (2, 40))
    lag, a = case.get("lag", 0.0), case.get("acceleration_limit", np.inf)
    with jax.enable_x64(True):
        drive = effects(**{name: jnp.full(40, value) for name, value in case.items()})
        for seconds, fine in ((H, 1000), (0.5, 50_000)):
            mean, state = actuators.step_lag(drive, actuators.DriveState(jnp.array(v), None), jnp.array(u), seconds)
            velocity, way = respond(lag, a, v, u, seconds, fine)
            np.testing.assert_allclose(state.velocity, velocity, atol=1e-3 * np.abs(u - v).max())
            np.testing.assert_allclose(mean * seconds, way, atol=1e-5)


def test_a_flexible_mount_swings_as_the_differential_equation():
    """Against SciPy, the joint's acceleration held over each step; a rigid joint beside it does not swing."""
    frequency, steps = 14.0, 60
    w, z = 2.0 * np.pi * frequency, actuators.SWING_DAMPING
    v = np.cumsum(np.random.default_rng(3).normal(0.0, 0.1, steps + 1))
    with jax.enable_x64(True):
        drive = effects(resonance=jnp.array([frequency, 0.0]))
        state = actuators.rest(drive, jnp.zeros(2))
        wanted = np.zeros(2)
        for before, after in itertools.pairwise(v):
            state = actuators.step_swing(drive, state, jnp.full(2, before), jnp.full(2, after), H)
            a = (after - before) / H

            def motion(_, y, a=a):
                return [y[1], -(w**2) * y[0] - 2 * z * w * y[1] - a]

            wanted = solve_ivp(motion, (0, H), wanted, rtol=1e-10, atol=1e-13).y[:, -1]
            np.testing.assert_allclose(state.swing[:, 0], wanted, rtol=1e-6, atol=1e-12)
    assert np.abs(wanted).max() > 0.0 and not np.any(state.swing[:, 1])
    assert actuators.rest(effects(), jnp.zeros(2)).swing is None


def test_carried_joints_stay_within_the_play_and_move_with_the_joint_at_its_end():
    t = np.arange(600) * H
    path = 0.3 * np.sin(4 * t)
    with jax.enable_x64(True):
        effect = effects(backlash=jnp.array(0.1))
        state, carried = actuators.rest(effect, jnp.array(path[:1])), [path[0]]
        for q in path[1:]:
            output, velocity, state = actuators.step_backlash(effect, state, jnp.array([q]), jnp.zeros(1), H)
            assert float(velocity[0]) == pytest.approx((float(output[0]) - carried[-1]) / H, abs=1e-12)
            carried.append(float(output[0]))
    np.testing.assert_allclose(carried, play_in(0.1, path), atol=1e-12)
    assert max(carried) == pytest.approx(0.3 - 0.05, abs=1e-4)  # the amplitude loses half the play
