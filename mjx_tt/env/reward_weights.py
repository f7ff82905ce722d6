"""Weights of the built-in reward terms, by the names of their functions in ``mjx_tt.env.task``.

The paper's numbers (appendix "Rewards in Simulation and the Real World"). Imports nothing, so that a configuration is
checked against the names at once.
"""

from __future__ import annotations

SIM_WEIGHTS = {
    "state_transition": 1.0,
    "net_clearance": 1.0,
    "hit_and_land": 0.1,
    "fault": 0.0,
    "jerk": 0.3,
    "acceleration": 0.3,
    "velocity": 0.4,
    "joint_angle": 1.0,
    "collision": 1.0,
    "paddle_height": 0.5,
    "style": 1.0,
}
# What a real robot measures; the other terms weigh nothing there.
MEASURED_WEIGHTS = {"state_transition": 1.0, "net_clearance": 1.0, "hit_and_land": 0.1, "fault": 1.0}
REAL_WEIGHTS = dict.fromkeys(SIM_WEIGHTS, 0.0) | MEASURED_WEIGHTS
TERMS = tuple(SIM_WEIGHTS)
PRESETS = {"sim": SIM_WEIGHTS, "real": REAL_WEIGHTS}
