"""Velocity loops of the simulated joints, and the motion of the robot that they drive."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import rollout

from mjx_tt.robot.model import home_qpos, load_model
from robot_io.contract import N_JOINTS


@dataclass(frozen=True)
class Servo:
    """First-order response of a joint's velocity to its command."""

    time_constant: float  # [s]
    gain: float  # velocity reached over commanded


@cache
def servos() -> tuple[Servo, ...]:
    """The eight joints' servos with the arm in its home pose: (M_ii + armature) / (kv + damping)."""
    model = load_model()
    data = mujoco.MjData(model)
    data.qpos[:N_JOINTS] = home_qpos(model)
    mujoco.mj_forward(model, data)
    found = []
    for i, unit in enumerate(np.eye(model.nv)[:N_JOINTS]):
        inertia = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, inertia, unit)
        gain, resistance = model.actuator_gainprm[i, 0], model.dof_damping[i] - model.actuator_biasprm[i, 2]
        found.append(Servo(float(inertia[i] / resistance), float(gain / resistance)))
    return tuple(found)


def follow(start: Float[np.ndarray, 8], velocity: Float[np.ndarray, "n 8"]) -> tuple[Float[np.ndarray, "n+1 8"], float]:
    """Positions of the robot, from rest at ``start``, after each step of these commands, and the step [s].

    MuJoCo's own steps, without the ends of the joints' ranges: [m], [rad], [m/s], [rad/s].
    """
    model = load_model()
    model.jnt_limited[:] = 0
    data = mujoco.MjData(model)
    data.qpos[:N_JOINTS] = start
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros(size)
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    control = np.zeros((1, len(velocity), model.nu))
    control[0, :, :N_JOINTS] = velocity
    states, _ = rollout.rollout(model, data, state, control)
    position = states[0, :, 1 : 1 + N_JOINTS]  # behind the time
    return np.concatenate([np.asarray(start, float)[None], position]), model.opt.timestep
