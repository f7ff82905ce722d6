"""Robot to table from touches that MuJoCo's kinematics made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_io.calibration import robot
from tests.support.hidden_rig import HIDDEN, touches

ZEROS = (0.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_hidden_zeros_are_found_within_2_mrad(seed):
    fit = robot.fit(*touches(seed=seed), ZEROS, "2026-11-22")
    np.testing.assert_allclose(fit.calibration.joint_zeros, HIDDEN.joint_zeros, atol=0.002)
    assert np.linalg.norm(fit.calibration.base_position) < 0.002 and fit.unknown == ()
    away = np.array(fit.calibration.joint_zeros) - HIDDEN.joint_zeros
    assert (np.abs(away) < 3.5 * fit.deviation[:6]).all()


def test_a_moved_base_is_found():
    table, joints, paddle = touches()
    fit = robot.fit(table + [0.009, -0.004, 0.006], joints, paddle, ZEROS, "2026-11-22")
    np.testing.assert_allclose(fit.calibration.base_position, [0.009, -0.004, 0.006], atol=0.002)
    np.testing.assert_allclose(fit.calibration.joint_zeros, HIDDEN.joint_zeros, atol=0.002)


def test_mis_touched_points_are_named_and_bend_nothing():
    table, joints, paddle = touches()
    table[5] += [0.03, 0.0, -0.02]
    joints[17, 4] += 0.1
    fit = robot.fit(table, joints, paddle, ZEROS, "2026-11-22")
    assert np.flatnonzero(~fit.used).tolist() == [5, 17]
    np.testing.assert_allclose(fit.calibration.joint_zeros, HIDDEN.joint_zeros, atol=0.002)


def test_combinations_that_poses_do_not_separate_are_said_and_stay_near_zero():
    """With a tip on the last joint's axis nothing tells that joint's zero."""
    table, joints, _ = touches(replace(HIDDEN, joint_zeros=(0.0,) * 6), count=60)
    on_axis = np.arange(0, 60, 3)  # every third touch is the blade's end
    fit = robot.fit(table[on_axis], joints[on_axis], np.tile([0.3263, 0.0, 0.0], (20, 1)), ZEROS, "2026-11-22")
    assert any("zero of joint_6" in text for text in fit.unknown)
    assert abs(fit.calibration.joint_zeros[5]) < 0.005 and fit.deviation[5] > 0.01


def test_too_few_touches_are_refused():
    table, joints, paddle = touches(count=7)
    with pytest.raises(ValueError, match="7 touched points .* at least 8"):
        robot.fit(table, joints, paddle, ZEROS, "2026-11-22")
