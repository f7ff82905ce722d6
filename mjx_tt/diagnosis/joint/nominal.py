"""The robot's side of a diagnosis, against what a SimModel believes about its drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

from mjx_tt.diagnosis.joint.diagnose import diagnose_robot
from mjx_tt.diagnosis.joint.findings import RobotFindings
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.records import JointRecord
from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES


def nominal_response(model: SimModel, joint: str) -> JointResponse:
    """What the model believes about a joint: its mean latencies, and its drive where the model has one."""
    axis = "festo" if JOINT_NAMES.index(joint) in FESTO_JOINTS else "abb"
    values = {
        "action_delay": float(getattr(model.latency, f"{axis}_action")),
        "observation_delay": float(getattr(model.latency, f"{axis}_observation")),
        "velocity_gain": float(model.actuation.velocity_gain),
    }
    if model.drives is not None:
        drive = getattr(model.drives, joint)
        for field in fields(JointResponse):
            value = float(getattr(drive, field.name))
            if field.name.endswith("_delay"):
                values[field.name] += value
            elif field.name == "velocity_gain":
                values[field.name] *= value
            else:
                values[field.name] = value
    return JointResponse(**values)


def diagnose_joints(
    records: Sequence[JointRecord], model: SimModel, seed: int, without: Sequence[str], say: Callable[[str], None]
) -> RobotFindings:
    """``diagnose_robot`` with the model's own responses as the nominal ones."""
    nominal = {r.joint: nominal_response(model, r.joint) for r in records}
    return diagnose_robot(
        records, nominal, seed, lambda joint, done, count: say(f"joint {done} of {count}: {joint}"), without
    )
