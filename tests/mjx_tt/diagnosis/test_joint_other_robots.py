"""Defects of a joint of robots with other joints than the paper's, from logs that the simulator plays."""

from __future__ import annotations

import jax
import pytest

from experiments.config import build
from experiments.study.target_domain import lab_logs
from mjx_tt import diagnosis
from mjx_tt.diagnosis.logs import Logs
from mjx_tt.env.task import Task, TaskConfig
from mjx_tt.robot import robots
from mjx_tt.sim import model as models

HIDDEN = {"fr3_pedestal": ("joint4", 0.02), "ur10e_rail": ("elbow", 0.02)}


def swept(robot, values, seconds=20.0):
    """The log of a robot of these drives, and the model that knows nothing of them."""
    nominal = build.nominal_model(robot)
    task = Task(TaskConfig(robot=robot))
    return lab_logs.record_joints(task, models.with_values(nominal, values), jax.random.key(0), seconds), nominal


@pytest.mark.parametrize("name", [pytest.param("fr3_pedestal", marks=pytest.mark.slow), "ur10e_rail"])
def test_a_hidden_lag_is_named(name):
    robot, (joint, lag) = robots.load_shipped(name), HIDDEN[name]
    records, nominal = swept(robot, {f"drives.{joint}.lag": lag})
    found = diagnosis.diagnose(Logs((), records, {}), nominal)
    assert [cause.name for cause in found.verdict.causes] == [f"{joint}.lag"]
    (estimate,) = found.verdict.causes[0].parameters.values()
    assert estimate.estimate == pytest.approx(lag, rel=0.1)
    extended = models.paths(found.extended.model)
    assert extended[f"drives.{joint}.lag"] == pytest.approx(lag, rel=0.1)
    assert found.extended.model.joints == robot.contract.joints
