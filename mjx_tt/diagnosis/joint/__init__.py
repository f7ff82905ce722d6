"""Diagnosis of the joints: drive effects that the nominal model gets wrong about a joint's answer to its commands.

One joint at a time. A candidate model is the nominal response with a few effects changed; its parameters are fitted
with a free offset in every window of the log, so that neither the unknown start nor a slow drift of the integrated
velocity speaks for an effect. An effect is named when dropping it costs far more than the noise, as correlated as it
is, could explain, and when it moves the joint by more than a floor. What the catalogue leaves over is held against
functions that carry no name; when one of them explains it, the answer is "unexplained", and names that it could replace
are dropped.

The constants were set on logs of another simulator, 60 s a joint; tests/mjx_tt/diagnosis/test_joint.py has it.
"""

from __future__ import annotations

from mjx_tt.diagnosis.joint.diagnose import diagnose_joints
from mjx_tt.diagnosis.joint.findings import JointFinding, JointFindings, JointGain, JointResidual, Undecided
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.log import JointRecord, read_robot_csv

__all__ = [
    "JointFinding",
    "JointFindings",
    "JointGain",
    "JointRecord",
    "JointResidual",
    "JointResponse",
    "Undecided",
    "diagnose_joints",
    "read_robot_csv",
]
