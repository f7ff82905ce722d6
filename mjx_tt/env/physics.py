"""Robot and incoming ball through the substeps of a control period."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from ballmodel import flight
from ballmodel.flight import Events
from ballmodel.state import BallState, where
from ballmodel.vec import norm, row
from mjx_tt.env import observation
from mjx_tt.env.episode import EpisodeConstants, Episodes, EpisodeState, Tick
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.clearance import CapsuleClearance
from mjx_tt.robot.dynamics_fused import FusedEngine
from mjx_tt.robot.kinematics import Joints, PaddleKinematics
from mjx_tt.robot.mjcf import capsules, paddle_frame
from mjx_tt.robot.robots import Robot
from mjx_tt.robot.scalar_algebra import optimization_barrier
from mjx_tt.sim import actuators, latency, sensors
from mjx_tt.sim.actuators import DriveState
from mjx_tt.sim.sensors import Filters

ENGINES = ("fused", "mjx")


class Engine(Protocol):
    """Dynamics of the robot alone."""

    @property
    def name(self) -> str: ...

    def step(self, qpos: Joints, qvel: Joints, ctrl: Joints) -> tuple[Joints, Joints]:
        """Joint positions and velocities (n, ...) one substep later."""
        ...


class Physics(ABC):
    """Motion of robot and ball between two control steps; the task says when a ball is over."""

    def __init__(
        self, robot: Robot, engine: str, control_rate: float, sim_rate: float, longest: tuple[float, float]
    ) -> None:
        """longest: latencies of observation and action [s] for which there is memory."""
        self.contract, self.home = robot.contract, robot.home
        self.substeps, self.period, self.timestep = round(sim_rate / control_rate), 1.0 / control_rate, 1.0 / sim_rate
        self._longest = longest
        model = robot.model()
        chain = chain_from_model(model)
        self.engine: Engine
        if engine == "mjx":
            from mjx_tt.robot.dynamics_mjx import MjxEngine  # MJX takes seconds to import

            self.engine = MjxEngine(model, self.timestep)
        else:
            self.engine = FusedEngine(chain, self.timestep)
        self.kinematics = PaddleKinematics(chain, paddle_frame(model))
        self.clearance = CapsuleClearance(self.kinematics, capsules(model), robot.file)

    @abstractmethod
    def is_over(self, ball: BallState, events: Events, bounced: Bool[Array, "*batch"]) -> Bool[Array, "*batch"]:
        """True where what happened in a substep decided the ball. bounced: on the robot's side, before it."""

    def prepare(self, episodes: Episodes) -> EpisodeConstants:
        """Splits the episodes' latencies, with what clock and drives add to them, and sorts drives and camera."""
        model, seconds, (longest_observation, longest_action) = episodes.model, episodes.latency, self._longest
        batch, axes, n = seconds.shape[1:], self.contract.carrying, self.contract.n_joints
        joints = jnp.stack([seconds[2 if i in axes else 1] for i in range(n)])
        actions = jnp.stack([seconds[4 if i in axes else 3] for i in range(n)])
        ball, drives = seconds[0], actuators.sort_by_effect(model.drives, batch, seconds.dtype, self.contract.joints)
        if model.sensing.clock_rate is not None:
            ball = jnp.clip(ball * model.sensing.clock_rate, 0.0, longest_observation)
        if drives.observation_delay is not None:
            joints = jnp.clip(joints + drives.observation_delay, 0.0, longest_observation)
        if drives.action_delay is not None:
            actions = jnp.clip(actions + drives.action_delay, 0.0, longest_action)
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

        def capture(i: Tick, ball: BallState, filters: Filters, joints: Array) -> Array:
            return observation.capture(episodes, constants, self.substeps, timestep, i, ball, filters, joints)

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
            captured = captured + capture(i + 1, ball, filters, carried)
            return optimization_barrier(
                ((qpos, qvel, after, drive, filters, ball, (bounced, hit, live), closest), captured)
            )

        closest = s.accumulators.closest
        start = (s.qpos, s.qvel, s.pose, s.drive, s.filters, s.ball, (s.bounced, s.hit, s.live), closest)
        captured = capture(0, s.ball, s.filters, s.qpos if s.drive.output is None else s.drive.output)
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
