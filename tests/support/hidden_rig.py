"""Points that a person would measure on an emulated installation with hidden errors, by MuJoCo's kinematics."""

from __future__ import annotations

import mujoco
import numpy as np

from robot_io.contract import ABB_JOINTS
from robot_io.emulator.hidden import HiddenErrors
from tests.support.lockstep_play import world

HIDDEN = HiddenErrors(
    camera_position=(0.008, -0.007, 0.0055),  # 12 mm
    camera_angles=(0.005, -0.005, 0.0037),  # 8 mrad
    joint_zeros=(0.012, -0.012, 0.012, -0.012, 0.012, -0.012),
    clock_offset=0.0,
    clock_drift=4e-5,
)


def grid(hidden=HIDDEN, noise=0.003, frames=125, seed=0, spread=None):
    """Ball's centre at 15 places of the table, three of them on a stand, and the mean of what the tracker gives."""
    random = np.random.default_rng(seed)
    table = np.array([[x, y, 0.02] for x in (-0.6, 0.0, 0.6) for y in (-1.2, -0.5, 0.5, 1.2)])
    table = np.concatenate([table, [[-0.4, -0.9, 0.32], [0.4, 0.0, 0.32], [0.0, 0.9, 0.32]]])
    placed = table + random.normal(size=table.shape) * 5e-4  # by tape measure
    draw = spread or (lambda shape: random.normal(size=shape))
    seen = [hidden.seen(p) + (noise * draw((frames, 3))).mean(0) for p in placed]
    return table, np.array(seen)


TIPS = np.array([[0.3263, 0.0, 0.0], [0.25, 0.0, 0.08], [0.25, 0.05, -0.08]])  # [m] in the paper's last joint's frame
SPREAD = np.array([0.5, 0.25, 0.6, 0.4, 0.5, 1.0, 0.7, 1.2])  # [m], [rad] of the poses around home


def touches(hidden=HIDDEN, count=40, noise=5e-4, seed=0, rig=None, arm=ABB_JOINTS, spread=SPREAD, tips=TIPS):
    """Pins that a tip clamped to the paddle touches: places, what axes and controller report, the tip's place.

    rig  the world of another robot, with the indices of its arm's joints, spread of its poses and tips
    """
    random, rig = np.random.default_rng(seed), rig or world()
    data, site = mujoco.MjData(rig.model), rig.model.site("paddle")
    table, joints, paddle = [], [], []
    while len(table) < count:
        q = rig.home + random.uniform(-1, 1, len(spread)) * spread
        data.qpos[rig._q] = q
        mujoco.mj_kinematics(rig.model, data)
        hand = data.xmat[site.bodyid[0]].reshape(3, 3), data.xpos[site.bodyid[0]]
        tip = tips[len(table) % 3]
        place = hand[0] @ tip + hand[1]
        if place[2] < 0.05:
            continue
        reported = q.copy()
        reported[list(arm)] = hidden.counted(q[list(arm)])
        table.append(place + noise * random.normal(size=3))
        joints.append(reported)
        paddle.append(tip)
    return np.array(table), np.array(joints), np.array(paddle)
