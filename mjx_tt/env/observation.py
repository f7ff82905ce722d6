"""Observations of the policy: delayed, filtered, distorted, noisy positions of ball and joints."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ballmodel.state import BallState
from mjx_tt.env.episode import Episodes, EpisodeState, Prepared, TaskConfig, Tick
from mjx_tt.robot.scalar_algebra import materialise
from mjx_tt.sim import latency, noise
from mjx_tt.sim.sensors import Filters


def measured(
    episodes: Episodes, prepared: Prepared, captured: Float[Array, "captured *batch"], tick: Tick
) -> Float[Array, "observed *batch"]:
    """Observation from the true delayed quantities, as the ring keeps them."""
    tracker, joints = episodes.model.sensing, captured[3 : 3 + _joints(prepared)]
    ball = captured[:3]
    if tracker.jitter is not None:
        late = tracker.jitter * noise.normal(episodes.seed, tick, 3).astype(ball.dtype)
        ball = ball + late[None] * captured[3 + _joints(prepared) :]
    if prepared.camera is not None:
        ball = prepared.camera.seen(ball)
    u = noise.symmetric_uniform(episodes.seed, tick, 3).astype(captured.dtype)
    offset = (tracker.ball_offset_x, tracker.ball_offset_y, tracker.ball_offset_z)
    ball = jnp.stack([ball[i] + tracker.ball_noise * u[i] + offset[i] for i in range(3)])
    if prepared.drives.joint_offset is not None:
        joints = joints + prepared.drives.joint_offset
    return jnp.concatenate([ball, joints])


def observe(tick: Tick, s: EpisodeState, episodes: Episodes, prepared: Prepared) -> Float[Array, "observed *batch"]:
    """The policy's input at control step ``tick``."""
    joints = slice(3, 3 + _joints(prepared))
    captured = [
        latency.ring_read(s.observations[:, :3], tick - prepared.ball.periods),
        latency.ring_read(s.observations[:, joints], tick - prepared.joints.periods),
    ]
    if episodes.model.sensing.jitter is not None:
        captured.append(latency.ring_read(s.observations[:, joints.stop :], tick - prepared.ball.periods))
    return materialise(measured(episodes, prepared, jnp.concatenate(captured), tick))


def capture(
    episodes: Episodes,
    prepared: Prepared,
    config: TaskConfig,
    i: Tick,
    ball: BallState,
    filters: Filters,
    joints: Float[Array, "joints *batch"],
) -> Float[Array, "captured *batch"]:
    """Share of the state at substep boundary ``i`` in the quantities that the delayed sensors see."""
    n, timestep = config.substeps, 1.0 / config.sim_rate
    seen_at = latency.capture_weight(prepared.ball, i, n, timestep)[None]
    parts = [
        seen_at * filters.seen(ball.position),
        latency.capture_weight(prepared.joints, i, n, timestep) * joints,
    ]
    if episodes.model.sensing.jitter is not None:
        parts.append(seen_at * ball.velocity)
    return jnp.concatenate(parts)


def _joints(prepared: Prepared) -> int:
    """Number of the robot's joints."""
    return prepared.joints.periods.shape[0]
