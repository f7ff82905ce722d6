"""Ranges of what may be wrong of the simulation before anything is measured: ``randomise: prior`` in a model.

``randomise: dynamics`` has those of table, paddle and drives alone: the paper randomises dynamics and gives no ranges.
"""

from __future__ import annotations

from typing import Any

from robot_io.contract import JOINT_NAMES

_LAGS = {name: (0.0, 0.04 if name.startswith("gantry") else 0.025) for name in JOINT_NAMES}  # [s]
_ZEROS = {name: 0.007 if name.startswith("gantry") else 0.015 for name in JOINT_NAMES}  # [m], [rad]
# What a laboratory that has measured nothing may expect: about the same measured values as those of the virtual reality
# (``target_domain.hidden_effects``, with the sources), and a little wider.
PRIOR: dict[str, Any] = {
    "ball.paddle.restitution": [0.83, 1.0],
    "ball.paddle.tangential_gain": [0.5, 0.86],
    "ball.table.restitution": [0.88, 0.98],
    "ball.table.friction": [0.12, 0.38],
    "ball.flight.drag_coefficient": [0.42, 0.52],  # 0.46 to 0.49 of several sources, air from 0 to 30 degrees
    "ball.flight.magnus_coefficient": [0.0, 1.5],
    "ball.flight.spin_decay": [0.0, 0.12],
    **{f"sensing.ball_offset_{axis}": [-0.015, 0.015] for axis in "xyz"},
    **{f"sensing.camera_rotation_{axis}": [-0.01, 0.01] for axis in "xyz"},
    "sensing.camera_scale": [0.994, 1.006],
    "sensing.ball_noise": [0.002, 0.015],  # of a tracker; training's own 40 mm is a precaution
    "latency.ball_observation": [0.024, 0.056],
    "latency.abb_observation": [0.013, 0.045],
    "latency.festo_observation": [0.015, 0.051],
    "latency.abb_action": [0.050, 0.078],
    "latency.festo_action": [0.027, 0.075],
    **{f"drives.{name}.lag": list(ends) for name, ends in _LAGS.items()},
    **{f"drives.{name}.velocity_gain": [0.93, 1.07] for name in JOINT_NAMES},
    **{f"drives.{name}.joint_offset": [-size, size] for name, size in _ZEROS.items()},
}
DYNAMICS = {
    path: ends
    for path, ends in PRIOR.items()
    if path.startswith(("ball.paddle.", "ball.table.")) or path.endswith((".lag", ".velocity_gain"))
}
NAMED = {"prior": PRIOR, "dynamics": DYNAMICS}
