"""Diagnosis of the joints: drive effects that the nominal model gets wrong about a joint's answer to its commands.

One joint at a time. A candidate model is the nominal response with a few effects changed; its parameters are fitted
with a free offset in every window of the log, so that neither the unknown start nor a slow drift of the integrated
velocity speaks for an effect. Effects are chosen as those of the balls are (``mjx_tt.diagnosis.inclusion``): by their
evidence beside functions that carry no name, and by the share of the joint's error that each takes away. An effect is
named when most halves of the log show it and it moves the joint by more than a floor. A joint is "unexplained" when a
fifth of its error is left.
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
