"""Sensor model: delayed, filtered, distorted, noisy positions of ball and joints."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ballmodel.state import BallState
from mjx_tt.env.episode import EpisodeConstants, Episodes, EpisodeState, Tick
from mjx_tt.env.terms import Sensed
from mjx_tt.sim import latency, noise
from mjx_tt.sim.sensors import Filters


def measure(
    episodes: Episodes,
    constants: EpisodeConstants,
    captured: Float[Array, "captured *batch"],
    command: Float[Array, "joints *batch"],
    tick: Tick,
) -> Sensed:
    """The measurements of true delayed quantities, as the ring keeps them. command: of the step before [m/s, rad/s]."""
    n = count_joints(constants)
    tracker, ball, joints = episodes.model.sensing, captured[:3], captured[3 : 3 + n]
    if tracker.jitter is not None:
        late = tracker.jitter * noise.normal(episodes.seed, tick, 3).astype(ball.dtype)
        ball = ball + late[None] * captured[3 + n :]
    if constants.camera is not None:
        ball = constants.camera.project(ball)
    u = noise.symmetric_uniform(episodes.seed, tick, 3).astype(captured.dtype)
    offset = (tracker.ball_offset_x, tracker.ball_offset_y, tracker.ball_offset_z)
    ball = jnp.stack([ball[i] + tracker.ball_noise * u[i] + offset[i] for i in range(3)])
    if constants.drives.joint_offset is not None:
        joints = joints + constants.drives.joint_offset
    return Sensed(ball, joints, command)


def sense(tick: Tick, s: EpisodeState, episodes: Episodes, constants: EpisodeConstants) -> Sensed:
    """Measurements that arrive at control step ``tick``."""
    joints = slice(3, 3 + count_joints(constants))
    captured = [
        latency.read_ring(s.observations[:, :3], tick - constants.ball.periods),
        latency.read_ring(s.observations[:, joints], tick - constants.joints.periods),
    ]
    if episodes.model.sensing.jitter is not None:
        captured.append(latency.read_ring(s.observations[:, joints.stop :], tick - constants.ball.periods))
    return measure(episodes, constants, jnp.concatenate(captured), s.command, tick)


def capture(
    episodes: Episodes,
    constants: EpisodeConstants,
    substeps: int,
    timestep: float,
    i: Tick,
    ball: BallState,
    filters: Filters,
    joints: Float[Array, "joints *batch"],
) -> Float[Array, "captured *batch"]:
    """Share of the state at substep boundary ``i`` in the quantities that the delayed sensors see."""
    seen_at = latency.weigh_capture(constants.ball, i, substeps, timestep)[None]
    parts = [
        seen_at * filters.see(ball.position),
        latency.weigh_capture(constants.joints, i, substeps, timestep) * joints,
    ]
    if episodes.model.sensing.jitter is not None:
        parts.append(seen_at * ball.velocity)
    return jnp.concatenate(parts)


def count_joints(constants: EpisodeConstants) -> int:
    """Number of the robot's joints."""
    return constants.joints.periods.shape[0]
