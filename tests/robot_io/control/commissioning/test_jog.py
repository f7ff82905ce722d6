"""Small motions by hand through bridge, gate and emulated devices, measured in MuJoCo's world."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.control.bridge import BridgeConfig
from robot_io.control.commissioning.jog import blade_step, joint_step
from robot_io.errors import RefusedError
from tests.support.lockstep_play import lockstep


@pytest.fixture
def rig():
    rig = lockstep(config=BridgeConfig(jog=True))
    with pytest.raises(RefusedError, match="the state is disarmed"):
        rig.bridge.jog(np.zeros(8))
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
        rig.bridge.jog(blade_step(rig.bridge.gate.geometry, rig.bridge.gate.reference, step))
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


def test_large_steps_and_balls_are_refused(rig):
    for step in (0.021 * np.eye(8)[0], 0.06 * np.eye(8)[4], np.full(8, np.nan), np.zeros(7)):
        with pytest.raises(RefusedError, match="at most 0.02 m and 0.05 rad"):
            joint_step(step)
    with pytest.raises(RefusedError, match="at most 0.02 m"):
        blade_step(rig.bridge.gate.geometry, rig.bridge.gate.reference, np.array([0.0, 0.0, 0.03]))
    rig.throwing = True
    rig.run(1.5)
    assert rig.thrower.thrown >= 1 and not rig.summaries and rig.bridge.counts.balls == 0
