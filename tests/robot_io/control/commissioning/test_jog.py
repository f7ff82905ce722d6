"""Small motions by hand through bridge, gate and emulated devices, measured in MuJoCo's world."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.control.bridge import BridgeConfig
from robot_io.control.commissioning.jog import blade_step, joint_step
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS
from robot_io.safety.clearance import BLADE, RobotGeometry
from tests.support.lockstep_play import lockstep

RANDOM = np.random.default_rng(3)


@pytest.fixture
def rig():
    rig = lockstep(config=BridgeConfig(jog=True))
    for step in (np.zeros(8), np.zeros(3)):  # where the reference is not known yet
        with pytest.raises(RefusedError, match="the state is disarmed; arm it first"):
            rig.bridge.jog(step)
    rig.start()
    return rig


def blade(rig):
    data, site = rig.world.data, rig.world.model.site("paddle").id
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy()


def test_a_step_moves_one_joint_or_the_blade_as_asked(rig):
    before = rig.world.qpos.copy()
    rig.bridge.jog(joint_step(0.05 * np.eye(8)[3]))
    rig.run(3.0)
    np.testing.assert_allclose(rig.world.qpos - before, 0.05 * np.eye(8)[3], atol=2e-3)
    for step in 0.008 * np.array([[0.5, -0.3, 0.8]]):
        place, axes = blade(rig)
        rig.bridge.jog(step)
        rig.run(4.0)  # EGM corrects positions with 1/s
        now, turned = blade(rig)
        np.testing.assert_allclose(now - place, step, atol=2e-3)
        assert np.arccos(min(1.0, (np.trace(axes.T @ turned) - 1) / 2)) < 0.01


def test_no_step_leads_into_the_table_and_none_is_fast(rig):
    fastest, geometry = 0.0, rig.bridge.gate.geometry
    for _ in range(25):
        rig.bridge.jog(joint_step(np.array([0.0, 0.02, 0.0, 0.05, 0.05, 0.0, 0.0, 0.0])))
        rig.run(0.3)
        fastest = max(fastest, float(np.abs(rig.world.qvel).max()))
    assert rig.world.collisions == 0 and rig.bridge.state.value == "ready"
    assert 0.015 < geometry.gaps(rig.world.qpos[:, None]).min() < 0.03 and 0.01 < fastest < 0.35


@pytest.mark.parametrize("size", [0.001, 0.005, 0.02])
def test_a_stretched_arm_is_not_jogged_upwards(size):
    """From there it moves nothing, or something else than the blade along z."""
    geometry = RobotGeometry.load()
    q = geometry.home.copy()
    q[3:5] = 0.0, -np.arctan2(0.302, 0.07)  # wrist above elbow above shoulder
    with pytest.raises(RefusedError, match="the blade cannot move like that"):
        blade_step(geometry, q, np.array([0.0, 0.0, size]))
    assert np.abs(blade_step(geometry, q, np.array([size, 0.0, 0.0]))).max() > 0.2 * size


def test_steps_from_anywhere_are_along_what_was_asked():
    geometry = RobotGeometry.load()
    for _ in range(300):
        q, step = RANDOM.uniform(LIMITS.lower, LIMITS.upper), RANDOM.normal(size=3)
        step *= 0.019 / np.linalg.norm(step)
        try:
            found = blade_step(geometry, q, step)
        except RefusedError as error:
            assert "cannot move like that" in str(error)
            continue
        moved = geometry.middle(BLADE, q + found) - geometry.middle(BLADE, q)
        assert np.linalg.norm(moved - step * (moved @ step) / 0.019**2) < 0.45 * 0.019


def test_large_steps_and_balls_are_refused(rig):
    for step in (0.021 * np.eye(8)[0], 0.06 * np.eye(8)[4], np.full(8, np.nan), np.zeros(7)):
        with pytest.raises(RefusedError, match="at most 0.02 m and 0.05 rad"):
            joint_step(step)
    with pytest.raises(RefusedError, match="at most 0.02 m"):
        blade_step(rig.bridge.gate.geometry, rig.bridge.gate.reference, np.array([0.0, 0.0, 0.03]))
    rig.throwing = True
    rig.run(1.5)
    assert rig.thrower.thrown >= 1 and not rig.summaries and rig.bridge.counts.balls == 0
