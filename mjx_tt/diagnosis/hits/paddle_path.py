"""Pose of the paddle over time from the measured joints of a log, for balls on the same clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ballmodel.flight import PaddlePose
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.joint.forward_model import nominal_response
from mjx_tt.diagnosis.joint.log import JointRecord
from mjx_tt.robot import mjcf
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.kinematics import PaddleKinematics
from mjx_tt.sim.model import SimModel
from robot_io.contract import JOINT_NAMES

HALF_WINDOW = 0.010  # [s] of the central difference that gives joint velocities: a few encoder samples
FAR = 1e3  # [m] where the blade is parked for a ball that nobody watched the joints of


@dataclass(frozen=True)
class JointPath:
    """Positions of all joints over time."""

    time: tuple[Float[np.ndarray, " m"], ...]  # [s], of each of the eight joints
    position: tuple[Float[np.ndarray, " m"], ...]

    def covers(self, start: float, end: float) -> bool:
        """True if every joint was measured over this time."""
        return all(t[0] <= start and t[-1] >= end for t in self.time)

    def at(self, time: Float[np.ndarray, "#8 ..."]) -> Float[np.ndarray, "8 ..."]:
        """Positions of all joints, each at times of its own, (8, ...), or all at the same, (1, ...)."""
        each = np.broadcast_to(time, (len(self.time), *time.shape[1:]))
        return np.stack([np.interp(now, t, q) for now, t, q in zip(each, self.time, self.position, strict=True)])


def joint_path(records: Sequence[JointRecord], model: SimModel) -> JointPath | None:
    """The path of a log that has all eight joints, None otherwise.

    A position is as old as the model says that joint's measurement is when it is reported.
    """
    by_name = {r.joint: r for r in records}
    if set(by_name) != set(JOINT_NAMES):
        return None
    mine = [by_name[name] for name in JOINT_NAMES]
    time = tuple(r.state_time - nominal_response(model, r.joint, r.robot).observation_delay for r in mine)
    return JointPath(time, tuple(r.state_position for r in mine))


def watched(trajectory: Trajectory, path: JointPath | None) -> bool:
    """True if the joints were measured all along a trajectory."""
    return path is not None and path.covers(trajectory.time[0] - HALF_WINDOW, trajectory.time[-1] + HALF_WINDOW)


def poses(
    trajectories: Sequence[Trajectory],
    steps: Float[np.ndarray, "L n"],
    path: JointPath | None,
    late: Float[np.ndarray, "8 n"] | None = None,
) -> PaddlePose | None:
    """The blade at the ends of all steps, each quantity (3, L + 1, n); None where no ball's joints were watched.

    steps: [s] of measured time from each trajectory's first sample on. late: [s] by which a ball is stamped late
    against each joint: it was where it is measured when the joint was where it had been so much before.
    """
    seen = np.array([watched(t, path) for t in trajectories])
    if path is None or not seen.any():
        return None
    begin = np.array([t.time[0] for t in trajectories])
    time = (begin + np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)]))[None]
    before = 0.0 if late is None else late[:, None]
    q = path.at(time - before)
    qd = (path.at(time - before + HALF_WINDOW) - path.at(time - before - HALF_WINDOW)) / (2.0 * HALF_WINDOW)
    with jax.enable_x64(True):
        pose = jax.tree.map(np.asarray, _pose(q, qd))
    return PaddlePose(pose.position + np.where(seen, 0.0, FAR), pose.normal, pose.velocity, pose.angular_velocity)


@cache
def _kinematics() -> PaddleKinematics:
    model = mjcf.load_model()
    return PaddleKinematics(chain_from_model(model), mjcf.paddle_frame(model))


@jax.jit
def _pose(q: Array, qd: Array) -> PaddlePose:
    return _kinematics().pose(jnp.asarray(q), jnp.asarray(qd))
