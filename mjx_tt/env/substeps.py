"""Robot and incoming ball through the substeps of a control period, and what the delayed sensors see of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from ballmodel import flight
from ballmodel.flight import Events
from ballmodel.state import BallState, where
from ballmodel.vec import norm, row
from mjx_tt.env.episode import EpisodeConstants, Episodes, EpisodeState, Tick
from mjx_tt.env.terms import Sensed
from mjx_tt.robot.clearance import CapsuleClearance
from mjx_tt.robot.dynamics_fused import FusedEngine
from mjx_tt.robot.kinematics import Joints, PaddleKinematics
from mjx_tt.robot.scalar_algebra import optimization_barrier
from mjx_tt.sim import actuators, latency, noise, sensors
from mjx_tt.sim.actuators import DriveState
from mjx_tt.sim.sensors import Filters

if TYPE_CHECKING:
    from mjx_tt.robot.dynamics_mjx import MjxEngine

ENGINES = ("fused", "mjx")
OUT_OF_REACH = (-2.9, -0.6)  # [m] y and z of an incoming ball below which nobody can play it


class Physics:
    """Motion of robot and ball between two control steps, and the measurements of it.

    config: a ``task.TaskConfig``
    engine: its ``step(qpos, qvel, ctrl)`` gives joint positions and velocities (n, ...) one substep later
    """

    def __init__(self, config: Any) -> None:
        robot, self.config = config.robot, config
        self.contract, self.home = robot.contract, robot.home
        self.substeps, self.period, self.timestep = config.substeps, config.period, 1.0 / config.sim_rate
        self.engine: FusedEngine | MjxEngine
        if config.engine == "mjx":
            from mjx_tt.robot.dynamics_mjx import MjxEngine  # MJX takes seconds to import

            self.engine = MjxEngine(robot.model(), self.timestep)
        else:
            self.engine = FusedEngine(robot.chain(), self.timestep)
        self.kinematics = PaddleKinematics(robot.chain(), robot.paddle())
        self.clearance = CapsuleClearance(self.kinematics, robot.capsules(), robot.file)

    def is_over(self, ball: BallState, events: Events, bounced: Bool[Array, "*batch"]) -> Bool[Array, "*batch"]:
        """Termination: the ball is touched, in the net, down a second time or on the wrong side, or out of reach.

        bounced: on the robot's side, before the substep of the events.
        """
        own_side = events.table & (events.position[1] < 0.0)
        over = (events.table & (bounced | ~own_side)) | events.net | events.paddle
        y_min, z_min = OUT_OF_REACH
        return over | (ball.position[1] < y_min) | (ball.position[2] < z_min)

    def prepare(self, episodes: Episodes) -> EpisodeConstants:
        """Splits the episodes' latencies, with what clock and drives add to them, and sorts drives and camera."""
        model, seconds, config = episodes.model, episodes.latency, self.config
        batch, axes, n = seconds.shape[1:], self.contract.carrying, self.contract.n_joints
        joints = jnp.stack([seconds[2 if i in axes else 1] for i in range(n)])
        actions = jnp.stack([seconds[4 if i in axes else 3] for i in range(n)])
        ball, drives = seconds[0], actuators.sort_by_effect(model.drives, batch, seconds.dtype, self.contract.joints)
        if model.sensing.clock_rate is not None:
            ball = jnp.clip(ball * model.sensing.clock_rate, 0.0, config.max_observation_latency)
        if drives.observation_delay is not None:
            joints = jnp.clip(joints + drives.observation_delay, 0.0, config.max_observation_latency)
        if drives.action_delay is not None:
            actions = jnp.clip(actions + drives.action_delay, 0.0, config.max_action_latency)
        return EpisodeConstants(
            latency.split_observation_delay(ball, self.period),
            latency.split_observation_delay(joints, self.period),
            latency.split_action_delay(actions, self.period),
            drives,
            sensors.make_camera(model.sensing),
        )

    def step_physics(
        self, s: EpisodeState, episodes: Episodes, constants: EpisodeConstants, commands: tuple[Joints, Joints]
    ) -> tuple[tuple, Float[Array, "captured *batch"]]:
        """Robot and ball through one control period, with what the delayed sensors capture on the way.

        commands: the older and the newer of those in force. Returns (qpos, qvel, pose, drive, filters, ball, (bounced,
        hit, live), closest) and the capture.
        """
        params, tracker, timestep = episodes.model.ball, episodes.model.sensing, self.timestep
        old, new = (actuators.limit_command(constants.drives, command) for command in commands)

        def substep(i: Tick, carry: tuple) -> tuple:
            (qpos, qvel, pose, drive, filters, ball, (bounced, hit, live), closest), captured = carry
            robot, carried, (bent, bent_velocity) = self.step_robot(
                i, (qpos, qvel, drive), (old, new), episodes, constants
            )
            qpos, qvel, drive = robot
            after = optimization_barrier(self.kinematics.pose(bent, bent_velocity))
            moved, events = optimization_barrier(flight.step(params, ball, timestep, (pose, after)))
            before, ball = ball, where(live, moved, ball)
            struck = live & (events.table | events.paddle)
            filters = filters.step(tracker, before, ball, struck, timestep - events.time, timestep)
            over = self.is_over(ball, events, bounced)
            # A ball taken before its bounce is no hit: the point would be lost.
            hit = hit | (live & events.paddle & bounced)
            bounced = bounced | (live & events.table & (events.position[1] < 0.0))
            distance = norm(ball.position - after.position)
            closest = jnp.where(live & bounced, jnp.minimum(closest, distance), closest)
            live = live & ~over
            captured = captured + self.capture(episodes, constants, i + 1, ball, filters, carried)
            return optimization_barrier(
                ((qpos, qvel, after, drive, filters, ball, (bounced, hit, live), closest), captured)
            )

        closest = s.accumulators.closest
        start = (s.qpos, s.qvel, s.pose, s.drive, s.filters, s.ball, (s.bounced, s.hit, s.live), closest)
        carried = s.qpos if s.drive.output is None else s.drive.output
        captured = self.capture(episodes, constants, 0, s.ball, s.filters, carried)
        return jax.lax.fori_loop(0, self.substeps, substep, (start, captured))

    def step_robot(
        self,
        i: Tick,
        robot: tuple[Joints, Joints, DriveState],
        commands: tuple[Joints, Joints],
        episodes: Episodes,
        constants: EpisodeConstants,
        advance: Callable[[Joints, Joints, Joints], tuple[Joints, Joints]] | None = None,
    ) -> tuple[tuple[Joints, Joints, DriveState], Joints, tuple[Joints, Joints]]:
        """The robot after substep ``i`` of a control period.

        Args:
            i: number of the substep.
            robot: positions, velocities (n, ...) and drives.
            commands: the older and the newer, as ``actuators.limit_command`` leaves them.
            episodes: whose model it is.
            constants: of the episodes.
            advance: other dynamics than the engine's.

        Returns:
            The robot's state, the joints as encoders see them, and positions and velocities of the joints that carry
            the blade.
        """
        (qpos, qvel, drive), (old, new) = robot, commands
        params, timestep = constants.drives, self.timestep
        share = latency.share_old_command(constants.action, i, timestep)
        velocity, drive = actuators.step_lag(params, drive, new + share * (old - new), timestep)
        control = jnp.asarray(optimization_barrier(row(episodes.model.actuation.velocity_gain) * velocity))
        was, (qpos, qvel) = qvel, (advance or self.engine.step)(qpos, qvel, control)
        carried, carried_velocity, drive = actuators.step_backlash(params, drive, qpos, qvel, timestep)
        drive = actuators.step_swing(params, drive, was, qvel, timestep)
        bent, bent_velocity = carried, carried_velocity
        if drive.swing is not None:
            bent, bent_velocity = carried + drive.swing[0], carried_velocity + drive.swing[1]
        return (qpos, qvel, drive), carried, (bent, bent_velocity)

    def capture(
        self,
        episodes: Episodes,
        constants: EpisodeConstants,
        i: Tick,
        ball: BallState,
        filters: Filters,
        joints: Joints,
    ) -> Float[Array, "captured *batch"]:
        """Share of the state at substep boundary ``i`` in the quantities that the delayed sensors see."""
        seen_at = latency.weigh_capture(constants.ball, i, self.timestep)[None]
        parts = [
            seen_at * filters.see(ball.position),
            latency.weigh_capture(constants.joints, i, self.timestep) * joints,
        ]
        if episodes.model.sensing.jitter is not None:
            parts.append(seen_at * ball.velocity)
        return jnp.concatenate(parts)

    def sense(self, tick: Tick, s: EpisodeState, episodes: Episodes, constants: EpisodeConstants) -> Sensed:
        """Measurements that arrive at control step ``tick``."""
        joints = slice(3, 3 + self.contract.n_joints)
        captured = [
            latency.read_ring(s.observations[:, :3], tick - constants.ball.periods),
            latency.read_ring(s.observations[:, joints], tick - constants.joints.periods),
        ]
        if episodes.model.sensing.jitter is not None:
            captured.append(latency.read_ring(s.observations[:, joints.stop :], tick - constants.ball.periods))
        return self.measure(episodes, constants, jnp.concatenate(captured), s.command, tick)

    def measure(
        self,
        episodes: Episodes,
        constants: EpisodeConstants,
        captured: Float[Array, "captured *batch"],
        command: Joints,
        tick: Tick,
    ) -> Sensed:
        """The measurements of true delayed quantities, as the ring keeps them. command: of the step before."""
        n, tracker = self.contract.n_joints, episodes.model.sensing
        ball, joints = captured[:3], captured[3 : 3 + n]
        if tracker.jitter is not None:
            late = tracker.jitter * noise.normal(episodes.seed, tick, 3).astype(ball.dtype)
            ball = ball + late[None] * captured[3 + n :]
        if constants.camera is not None:
            ball = constants.camera.project(ball)
        ball = noise.add_to_ball(ball, tracker, episodes.seed, tick)
        if constants.drives.joint_offset is not None:
            joints = joints + constants.drives.joint_offset
        return Sensed(ball, joints, command)
