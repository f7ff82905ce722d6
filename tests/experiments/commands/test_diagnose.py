"""``mjx-tt diagnose``: what is refused before the work, and what is said after it."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from experiments.commands.diagnose import resting_pose, show
from experiments.errors import ConfigError
from mjx_tt.diagnosis import Diagnosis
from mjx_tt.diagnosis.verdict import Experiment, Verdict
from mjx_tt.sim.model import ModelFile, SimModel


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "x", ""])
def test_a_resting_pose_is_of_finite_numbers(value):
    with pytest.raises(ConfigError, match="--home joint_2=0.1,joint_1=.*: joint_1 at .*a number is wanted"):
        resting_pose(f"joint_2=0.1,joint_1={value}")


def test_a_joint_rests_at_one_place():
    with pytest.raises(ConfigError, match="joint_1 is given twice"):
        resting_pose("joint_1=0.1,joint_2=0.2,joint_1=0.1")
    assert resting_pose("joint_1=0.1,gantry_x=-2e-1") == {"joint_1": 0.1, "gantry_x": -0.2}


def said(*steps: Experiment) -> list[str]:
    """Lines of the command line about what to do next."""
    verdict = Verdict("none", (), None, None, (), (), steps)
    console = Console(file=io.StringIO(), record=True, width=200)
    show(Diagnosis(verdict, ModelFile(SimModel()), None, None, None, None), console)
    return console.export_text().splitlines()[1:]
