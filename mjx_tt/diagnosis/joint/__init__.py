"""What a joint does with its velocity commands: which drive effects the nominal model gets wrong, and how sure.

One joint at a time. A candidate model is the nominal response with a few effects changed; its parameters are fitted
with a free offset in every window of the log, so that neither the unknown start nor a slow drift of the integrated
velocity speaks for an effect. An effect is named when dropping it costs far more than the noise, as correlated as it
is, could explain, and when it moves the joint by more than a floor. What the catalogue leaves over is held against
functions that carry no name; when one of them explains it, the answer is "unexplained", and names that it could replace
are dropped.

The constants were set on logs of another simulator, 60 s a joint; tests/mjx_tt/diagnosis/test_joint.py has it.
"""

from __future__ import annotations

from mjx_tt.diagnosis.joint.diagnose import diagnose_robot
from mjx_tt.diagnosis.joint.findings import JointResidual, RobotCause, RobotFindings, RobotGain, Undecided
from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.records import JointRecord, read_robot_csv

__all__ = [
    "JointRecord",
    "JointResidual",
    "JointResponse",
    "RobotCause",
    "RobotFindings",
    "RobotGain",
    "Undecided",
    "diagnose_robot",
    "read_robot_csv",
]
