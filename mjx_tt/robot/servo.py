"""Velocity loops of the simulated joints, and the motion of the robot that they drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from mjx_tt.robot.robots import Robot


@dataclass(frozen=True)
class Servo:
    """First-order response of a joint's velocity to its command."""

    time_constant: float  # [s]
    gain: float  # velocity reached over commanded


@cache
def servos(robot: Robot) -> tuple[Servo, ...]:
    """The joints' servos with the robot in its home pose: (M_ii + armature) / (kv + damping)."""
    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    mujoco.mj_forward(model, data)
    found = []
    for i, unit in enumerate(np.eye(model.nv)):
        inertia = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, inertia, unit)
        gain, resistance = model.actuator_gainprm[i, 0], model.dof_damping[i] - model.actuator_biasprm[i, 2]
        found.append(Servo(float(inertia[i] / resistance), float(gain / resistance)))
    return tuple(found)


def follow(
    robot: Robot, start: Float[np.ndarray, " joints"], velocity: Float[np.ndarray, "n joints"]
) -> tuple[Float[np.ndarray, "n+1 joints"], float]:
    """Positions of the robot, from rest at ``start``, after each step of these commands, and the step [s].

    MuJoCo's own steps, without the ends of the joints' ranges: [m], [rad], [m/s], [rad/s].
    """
    model = robot.model()
    model.jnt_limited[:] = 0
    data = mujoco.MjData(model)
    data.qpos[:] = start
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros(size)
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    control = np.zeros((1, len(velocity), model.nu))
    control[0] = velocity
    states, _ = rollout.rollout(model, data, state, control)
    position = states[0, :, 1 : 1 + model.nq]  # behind the time
    return np.concatenate([np.asarray(start, float)[None], position]), model.opt.timestep
