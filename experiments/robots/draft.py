"""A first YAML for the MJCF of a robot: what can be read off it, and marked guesses for what cannot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from experiments.errors import ConfigError
from mjx_tt.robot.mjcf import PADDLE_SITE, Capsule, capsules

SPEED = {"m": 1.5, "rad": 2.5}  # [m/s], [rad/s] guessed
ACCELERATION = {"m": 10.0, "rad": 10.0}  # [m/s^2], [rad/s^2] guessed
MARGIN = {"m": 0.01, "rad": 0.02}  # [m], [rad]
RANGE = {"m": (-1.0, 1.0), "rad": (-3.1, 3.1)}  # where the MJCF has none
MOUNT = (0.0, -2.0, -0.3)  # [m] behind the table, below its top
GUESS = "guess: see the data sheet"
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True)
class _Joint:
    name: str
    unit: str
    low: float
    high: float
    limited: bool

    @property
    def home(self) -> float:
        """The middle of the range, inside its margins; 0 where that is allowed."""
        inside = self.low + MARGIN[self.unit] < 0.0 < self.high - MARGIN[self.unit]
        return 0.0 if inside else 0.5 * (self.low + self.high)


def text(mjcf: Path) -> str:
    """The YAML's text. Raises ConfigError where MuJoCo cannot compile the MJCF or it has no joints."""
    try:
        model = mujoco.MjModel.from_xml_path(str(mjcf))
    except ValueError as error:
        raise ConfigError(f"{mjcf}: MuJoCo cannot compile it: {' '.join(str(error).split())}") from None
    if not model.njnt:
        raise ConfigError(f"{mjcf}: has no joints; a robot needs some")
    joints = [_joint(model, i) for i in range(model.njnt)]
    sites = [model.site(i).name for i in range(model.nsite)]
    paddle = PADDLE_SITE if PADDLE_SITE in sites or not sites else sites[-1]
    found = capsules(model)
    blade = _blade(model, found)
    return "\n".join(
        [
            f"# A first draft for {mjcf.name}. Every number marked as a guess wants another one.",
            f"name: {mjcf.stem.replace(' ', '_')}",
            f"mjcf: {mjcf.name}",
            f"paddle: {paddle}{'' if paddle in sites else '   # the MJCF has no such site yet'}",
            f"carrying: [{', '.join(joint.name for joint in joints if joint.unit == 'm')}]",
            f"mount: {{position: {list(MOUNT)}, yaw: 1.5708}}   # guess: [m] of the MJCF's origin, [rad] about z",
            "joints:",
            *(line for joint in joints for line in _lines(joint)),
            "latencies:   # [s] mean and deviation; guesses: measure them",
            "  arm_observation: [0.02, 0.005]",
            "  arm_action: [0.05, 0.005]",
            "clearance:   # capsules of the MJCF whose names start with col_",
            f"  table: [{', '.join(c.name for c in found if c.link > 0)}]",
            f"  blade: [{', '.join(blade)}]",
            "  pairs:" if list(_pairs(model, found)) else "  pairs: []",
            *(f"    - [{first}, {second}]" for first, second in _pairs(model, found)),
            "",
        ]
    )


def _joint(model: mujoco.MjModel, index: int) -> _Joint:
    unit = "m" if model.jnt_type[index] == SLIDE else "rad"
    limited = bool(model.jnt_limited[index])
    low, high = model.jnt_range[index] if limited else RANGE[unit]
    return _Joint(model.joint(index).name, unit, round(float(low), 4), round(float(high), 4), limited)


def _lines(joint: _Joint) -> list[str]:
    return [
        f"  {joint.name}:",
        f"    range: [{joint.low:g}, {joint.high:g}]" + ("" if joint.limited else f"   # {GUESS}"),
        f"    velocity: {SPEED[joint.unit]:g}   # {GUESS}",
        f"    acceleration: {ACCELERATION[joint.unit]:g}   # {GUESS}",
        f"    margin: {MARGIN[joint.unit]:g}",
        f"    policy_velocity: {SPEED[joint.unit]:g}   # as velocity, or less",
        f"    home: {joint.home:g}   # mjx-tt robot place finds a better one",
    ]


def _blade(model: mujoco.MjModel, found: list[Capsule]) -> list[str]:
    """Capsules of the last link with "blade" or "paddle" in their name, or all that it carries."""
    last = [c.name for c in found if c.link == model.njnt - 1]
    return [name for name in last if "blade" in name or "paddle" in name] or last


def _pairs(model: mujoco.MjModel, found: list[Capsule]) -> Iterator[tuple[str, str]]:
    """Capsules at least two joints apart that do not touch with all joints in the middle of their ranges."""
    data = mujoco.MjData(model)
    joints = [_joint(model, i) for i in range(model.njnt)]
    data.qpos[:] = [joint.home for joint in joints] if model.nq == model.njnt else model.qpos0
    mujoco.mj_kinematics(model, data)
    for i, first in enumerate(found):
        for second in found[i + 1 :]:
            pair = [model.geom(capsule.name).id for capsule in (first, second)]
            gap = mujoco.mj_geomDistance(model, data, pair[0], pair[1], 1.0, np.zeros(6))
            if abs(first.link - second.link) > 1 and gap > 0.0:
                yield first.name, second.name
