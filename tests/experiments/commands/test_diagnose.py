"""``mjx-tt diagnose``: what is refused before the work, and what is said after it."""

from __future__ import annotations

import pytest

from experiments.commands.diagnose import resting_pose
from experiments.errors import ConfigError


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "x", ""])
def test_a_resting_pose_is_of_finite_numbers(value):
    with pytest.raises(ConfigError, match="--home joint_2=0.1,joint_1=.*: joint_1 at .*a number is wanted"):
        resting_pose(f"joint_2=0.1,joint_1={value}")
