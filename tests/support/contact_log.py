"""A log of contacts whose blade MuJoCo moved and whose ball flew and bounced off by hand."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np

from robot_io.contract import PAPER
from tests.support.lockstep_play import world

AMPLITUDE = np.array([0.1, 0.05, 0.3, 0.1, 0.1, 0.1, 0.2, 0.1])
REACH = 0.02 + 0.006  # [m] ball's radius and half the paddle


def place(t, rig, data=None, swing=1.0):
    """The joints at t, and with MuJoCo's data the blade's centre and normal towards the human."""
    n = len(rig.home)
    q = rig.home + swing * AMPLITUDE[-n:] * np.sin(
        2 * np.pi * np.array([0.7, 0.5, 1.3, 0.9, 1.1, 0.6, 1.2, 0.8])[-n:] * t
    )
    if data is None:
        return q
    data.qpos[rig._q] = q
    mujoco.mj_kinematics(rig.model, data)
    site = rig.model.site("paddle").id
    normal = data.site_xmat[site].reshape(3, 3)[:, 2]
    return data.site_xpos[site].copy(), normal * np.sign(normal[1])


def made_up(lag, noise=0.003, gap=0.0, count=30, seed=0, rig=None, robot=PAPER, swing=1.0):
    """A log of ``count`` contacts, one a second.

    rig  the world of another robot, whose contract is ``robot``; swing: how far its joints go
    """
    rig, random = rig or world(), np.random.default_rng(seed)
    data, gravity = mujoco.MjData(rig.model), np.array([0.0, 0.0, -9.81])
    times, balls, numbers = [], [], []
    for k in range(count):
        speed = 0.0
        while speed < 1.0:  # as a player does, the robot moves its blade forward
            contact = random.uniform(1.0, count + 1.0)
            (before, _), (centre, normal) = (place(t, rig, data, swing) for t in (contact - 1e-3, contact))
            speed = (centre - before) @ normal / 1e-3
        at = centre + (REACH + gap) * normal
        before, after = np.array([0.2, -5.0, 0.5]), np.array([0.1, 4.0, 1.5])
        for t in np.arange(contact - 0.2, contact + 0.2, 0.008) + random.uniform(0, 0.008):
            dt = t - contact
            times.append(t)
            balls.append(at + (before if dt < 0 else after) * dt + 0.5 * gravity * dt**2)
            numbers.append(k)
    moments = np.arange(0.5, count + 2.0, 0.004)
    ball = np.array(balls).T + noise * random.normal(size=(3, len(balls)))
    return SimpleNamespace(
        robot=robot,
        path="made up",
        ball=SimpleNamespace(capture_time=np.array(times), position=ball, id=np.array(numbers)),
        joints=SimpleNamespace(time=moments + lag, position=np.array([place(t, rig, None, swing) for t in moments]).T),
    )
