"""One ball, one return: the episode as pure functions over a batch of any shape.

Phase 1 runs robot, policy and incoming ball at the control rate until the paddle touches the ball or it is out of
reach. Phase 2 flies the outgoing ball alone: as at the real robot, the policy's part ends with the contact.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from ballmodel import flight
from ballmodel.state import BallState, where
from ballmodel.vec import norm, row
from mjx_tt.env import observation
from mjx_tt.env.episode import HIT as HIT
from mjx_tt.env.episode import MISSED as MISSED
from mjx_tt.env.episode import RETURNED as RETURNED
from mjx_tt.env.episode import Controller as Controller
from mjx_tt.env.episode import Episodes as Episodes
from mjx_tt.env.episode import EpisodeState as EpisodeState
from mjx_tt.env.episode import Prepared as Prepared
from mjx_tt.env.episode import Return as Return
from mjx_tt.env.episode import Sums as Sums
from mjx_tt.env.episode import TaskConfig as TaskConfig
from mjx_tt.env.episode import Tick as Tick
from mjx_tt.env.own import ControlStep
from mjx_tt.env.reward_sums import accumulate
from mjx_tt.lanes.loop import while_any
from mjx_tt.robot.chain import chain_from_model
from mjx_tt.robot.clearance import CapsuleClearance
from mjx_tt.robot.dynamics_fused import FusedEngine
from mjx_tt.robot.kinematics import Joints, PaddleKinematics
from mjx_tt.robot.model import capsules, paddle_frame
from mjx_tt.robot.scalar_algebra import materialise
from mjx_tt.sim import actuators as drives
from mjx_tt.sim import latency, sensors
from mjx_tt.sim.actuators import DriveState
from mjx_tt.sim.sensors import Filters
from robot_io.limits import limit_velocity

OUT_OF_REACH = (-2.9, -0.6)  # [m] y and z of an incoming ball below which nobody can play it


class Engine(Protocol):
    """Dynamics of the robot alone."""

    @property
    def name(self) -> str: ...

    def step(self, qpos: Joints, qvel: Joints, ctrl: Joints) -> tuple[Joints, Joints]:
        """Joint positions and velocities (n, ...) one substep later."""
        ...


class Task:
    """Episodes of one robot under one configuration."""

    def __init__(self, config: TaskConfig) -> None:
        self.config, self.contract = config, config.robot.contract
        model = config.robot.model()
        chain = chain_from_model(model)
        timestep = 1.0 / config.sim_rate
        self.engine: Engine
        if config.engine == "mjx":
            from mjx_tt.robot.dynamics_mjx import MjxEngine  # MJX takes seconds to import

            self.engine = MjxEngine(model, timestep)
        else:
            self.engine = FusedEngine(chain, timestep)
        self.home = config.robot.home
        self.kinematics = PaddleKinematics(chain, paddle_frame(model))
        self.clearance = CapsuleClearance(self.kinematics, capsules(model), config.robot.file)
        self._observation_depth = latency.ring_depth(config.max_observation_latency, config.period)
        self._action_depth = latency.ring_depth(config.max_action_latency, config.period)

    def prepare(self, episodes: Episodes) -> Prepared:
        """Splits the episodes' latencies, with what clock and drives add to them, and sorts drives and camera."""
        config, model, seconds = self.config, episodes.model, episodes.latency
        period, batch = config.period, seconds.shape[1:]
        axes, n = self.contract.carrying, self.contract.n_joints
        joints = jnp.stack([seconds[2 if i in axes else 1] for i in range(n)])
        actions = jnp.stack([seconds[4 if i in axes else 3] for i in range(n)])
        ball, by_effect = seconds[0], drives.by_effect(model.drives, batch, seconds.dtype, self.contract.joints)
        if model.sensing.clock_rate is not None:
            ball = jnp.clip(ball * model.sensing.clock_rate, 0.0, config.max_observation_latency)
        if by_effect.observation_delay is not None:
            joints = jnp.clip(joints + by_effect.observation_delay, 0.0, config.max_observation_latency)
        if by_effect.action_delay is not None:
            actions = jnp.clip(actions + by_effect.action_delay, 0.0, config.max_action_latency)
        return Prepared(
            latency.observation_delay(ball, period),
            latency.observation_delay(joints, period),
            latency.action_delay(actions, period),
            by_effect,
            sensors.camera(model.sensing),
        )

    def reset(self, episodes: Episodes, controller: Controller) -> EpisodeState:
        """Initial state: robot at rest at home (or ``episodes.start``), ball at its launch.

        History buffers hold these values.
        """
        batch, dtype = episodes.ball.position.shape[1:], episodes.ball.position.dtype
        n = self.contract.n_joints

        def full(value: float, *leading: int) -> Array:
            return jnp.broadcast_to(jnp.asarray(value, dtype), leading + batch)

        zeros = full(0.0, n)
        home = jnp.asarray(self.home, dtype).reshape((n,) + (1,) * len(batch))
        home = jnp.broadcast_to(home if episodes.start is None else episodes.start, zeros.shape)
        seen = jnp.concatenate([episodes.ball.position, home])
        zero, false = full(0.0), jnp.broadcast_to(False, batch)
        prepared, tracker = self.prepare(episodes), episodes.model.sensing
        captured = seen if tracker.jitter is None else jnp.concatenate([seen, episodes.ball.velocity])
        first = observation.measured(episodes, prepared, captured, 0)
        return EpisodeState(
            qpos=home,
            qvel=zeros,
            pose=self.kinematics.pose(home, zeros),
            command=zeros,
            command_acceleration=zeros,
            reference=home,
            commands=full(0.0, self._action_depth, n),
            observations=jnp.broadcast_to(captured, (self._observation_depth, *captured.shape)),
            controller=controller.start(first),
            drive=drives.at_rest(prepared.drives, home),
            filters=Filters.at(tracker, episodes.ball.position, 1.0 / self.config.sim_rate),
            ball=episodes.ball,
            bounced=false,
            hit=false,
            live=~false,
            finite=~false,
            sums=Sums(
                closest=full(3.0),
                jerk=zero,
                acceleration=zero,
                velocity=zero,
                safe_angle=zero,
                collision=zero,
                low_paddle=zero,
                bad_style=zero,
                steps=zero,
                peak_velocity=zeros,
                observation=full(0.0, self.contract.n_observation),
                observation_sq=full(0.0, self.contract.n_observation),
                own=tuple(zero for term in self.config.own_terms if term.per == "step"),
            ),
        )

    def play(self, controller: Controller, episodes: Episodes) -> EpisodeState:
        """The last state of episodes with one batch axis (L,).

        Of an episode that ended before others the robot may have moved on; ball, outcome and sums are those of its end.
        """
        prepared = self.prepare(episodes)

        def step(
            tick: Array, s: EpisodeState, by_lane: tuple[Episodes, Prepared], by_column: Controller
        ) -> EpisodeState:
            return self.control_step(tick, s, *by_lane, by_column)

        return while_any(
            lambda s: s.live,
            step,
            self.reset(episodes, controller),
            (episodes, prepared),
            controller,
            limit=self.config.max_steps,
            lanes=self.config.lanes and self.config.engine == "fused",
        )

    def control_step(
        self, tick: Tick, s: EpisodeState, episodes: Episodes, prepared: Prepared, controller: Controller
    ) -> EpisodeState:
        """One control period: observe, act, advance robot and ball by the substeps."""
        period = self.config.period
        seen = observation.observe(tick, s, episodes, prepared)
        action, controller_state = controller.act(tick, s.controller, seen)
        limits = self.contract.limits
        scale = np.asarray(limits.policy_velocity, action.dtype).reshape((-1,) + (1,) * (action.ndim - 1))
        # After the contact the robot is only braked: what the real one does before it returns home.
        request = jnp.where(s.live, action * scale, 0.0)
        command = materialise(limit_velocity(request, s.command, s.reference, period, limits, xp=jnp))
        reference = s.reference + command * period
        commands = latency.ring_write(s.commands, tick, command)
        old = latency.ring_read(commands, tick - prepared.action.periods - 1)
        new = latency.ring_read(commands, tick - prepared.action.periods)
        (qpos, qvel, pose, drive, filters, ball, flags, closest), captured = self._substeps(
            s, episodes, prepared, old, new
        )
        bounced, hit, live = flags
        command_acceleration = (command - s.command) / period
        carried = qpos if drive.output is None else drive.output
        gaps = materialise(self.clearance(materialise(self.kinematics.links(carried)), carried[0]))
        step = ControlStep(
            observation=seen,
            command=command,
            acceleration=command_acceleration,
            joints=carried,
            blade=pose,
            ball_position=jnp.asarray(ball.position),
            ball_velocity=jnp.asarray(ball.velocity),
            bounced=bounced,
            table_gap=gaps.table,
            own_gap=gaps.own,
            blade_gap=gaps.blade,
        )
        sums = accumulate(s, step, period, controller.mean, closest, self.config.own_terms, limits)
        ok = jnp.isfinite(sum(qpos[i] for i in range(self.contract.n_joints)) + sum(ball.position[i] for i in range(3)))
        return EpisodeState(
            qpos,
            qvel,
            pose,
            command,
            command_acceleration,
            reference,
            commands,
            latency.ring_write(s.observations, tick, captured),
            controller_state,
            drive,
            filters,
            ball,
            bounced,
            hit,
            live & ok,
            s.finite & (ok | ~s.live),
            sums,
        )

    def _substeps(
        self,
        s: EpisodeState,
        episodes: Episodes,
        prepared: Prepared,
        old: Float[Array, "joints *batch"],
        new: Float[Array, "joints *batch"],
    ) -> tuple[tuple, Float[Array, "captured *batch"]]:
        """Robot and ball through one control period, with what the delayed sensors capture on the way."""
        n, timestep = self.config.substeps, 1.0 / self.config.sim_rate
        params, tracker = episodes.model.ball, episodes.model.sensing
        old, new = (drives.reachable(prepared.drives, command) for command in (old, new))

        def captured_at(i: Tick, ball: BallState, filters: Filters, joints: Array) -> Array:
            return observation.capture(episodes, prepared, self.config, i, ball, filters, joints)

        def substep(i: Tick, carry: tuple) -> tuple:
            (qpos, qvel, pose, drive, filters, ball, (bounced, hit, live), closest), captured = carry
            robot, carried, (bent, bent_velocity) = self.moved(i, (qpos, qvel, drive), (old, new), episodes, prepared)
            qpos, qvel, drive = robot
            after = materialise(self.kinematics.pose(bent, bent_velocity))
            moved, events = flight.step(params, ball, timestep, (pose, after))
            moved, events = materialise((moved, events))
            before, ball = ball, where(live, moved, ball)
            struck = live & (events.table | events.paddle)
            filters = filters.stepped(tracker, before, ball, struck, timestep - events.time, timestep)
            own_side = events.table & (events.position[1] < 0.0)
            over = (events.table & (bounced | ~own_side)) | events.net | events.paddle
            y_min, z_min = OUT_OF_REACH
            over = over | (ball.position[1] < y_min) | (ball.position[2] < z_min)
            # A ball taken before its bounce is no hit: the point would be lost.
            hit = hit | (live & events.paddle & bounced)
            bounced = bounced | (live & own_side)
            distance = norm(ball.position - after.position)
            closest = jnp.where(live & bounced, jnp.minimum(closest, distance), closest)
            live = live & ~over
            captured = captured + captured_at(i + 1, ball, filters, carried)
            return materialise(((qpos, qvel, after, drive, filters, ball, (bounced, hit, live), closest), captured))

        start = (s.qpos, s.qvel, s.pose, s.drive, s.filters, s.ball, (s.bounced, s.hit, s.live), s.sums.closest)
        captured = captured_at(0, s.ball, s.filters, s.qpos if s.drive.output is None else s.drive.output)
        return jax.lax.fori_loop(0, n, substep, (start, captured))

    def moved(
        self,
        i: Tick,
        robot: tuple[Joints, Joints, DriveState],
        commands: tuple[Joints, Joints],
        episodes: Episodes,
        prepared: Prepared,
        advance: Callable[[Joints, Joints, Joints], tuple[Joints, Joints]] | None = None,
    ) -> tuple[tuple[Joints, Joints, DriveState], Joints, tuple[Joints, Joints]]:
        """The robot after substep ``i`` of a control period: its state, the joints as encoders see them, and positions
        and velocities of the joints that carry the blade.

        robot: positions, velocities (n, ...) and drives; commands: the older and the newer, as ``drives.reachable``;
        advance: other dynamics than the engine's
        """
        (qpos, qvel, drive), (old, new) = robot, commands
        params, timestep = prepared.drives, 1.0 / self.config.sim_rate
        share = latency.old_command_share(prepared.action, i, timestep)
        velocity, drive = drives.follow(params, drive, new + share * (old - new), timestep)
        control = jnp.asarray(materialise(row(episodes.model.actuation.velocity_gain) * velocity))
        was, (qpos, qvel) = qvel, (advance or self.engine.step)(qpos, qvel, control)
        carried, carried_velocity, drive = drives.carry(params, drive, qpos, qvel, timestep)
        drive = drives.swung(params, drive, was, qvel, timestep)
        bent, bent_velocity = carried, carried_velocity
        if drive.swing is not None:
            bent, bent_velocity = carried + drive.swing[0], carried_velocity + drive.swing[1]
        return (qpos, qvel, drive), carried, (bent, bent_velocity)
