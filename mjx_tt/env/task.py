"""One ball, one return: the episode as pure functions over a batch of any shape.

Phase 1 runs robot, policy and incoming ball at the control rate until the paddle touches the ball or it is out of
reach. Phase 2 flies the outgoing ball alone: as at the real robot, the policy's part ends with the contact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel import flight
from ballmodel.flight import PaddlePose
from ballmodel.state import BallState, where
from ballmodel.vec import norm
from mjx_tt.env import rewards
from mjx_tt.robot import model as robot
from mjx_tt.robot.clearance import CapsuleClearance
from mjx_tt.robot.dynamics_fused import FusedEngine
from mjx_tt.robot.kinematics import PaddleKinematics
from mjx_tt.robot.scalar_algebra import materialise
from mjx_tt.sim import actuators as drives
from mjx_tt.sim import latency, noise, sensors
from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS, LIMITS, N_JOINTS, N_OBSERVATION
from robot_io.limits import limit_velocity

ENGINES = ("fused", "mjx")
MISSED, HIT, RETURNED = range(3)  # outcomes; HIT: touched after the bounce, but not returned
OUT_OF_REACH = (-2.9, -0.6)  # [m] y and z of an incoming ball below which nobody can play it
FLOOR = -0.76  # [m]


@dataclass(frozen=True)
class TaskConfig:
    """What an episode is. Rates in Hz, times in seconds.

    Raises ValueError for an unknown engine, a substep count that is not whole, or weights that do not match the terms.
    """

    engine: str = "fused"
    control_rate: float = 75.0
    sim_rate: float = 300.0
    max_steps: int = 200  # control steps, both phases together
    max_observation_latency: float = 0.1  # longer draws are cut: mean + 7 deviations of the ball's
    max_action_latency: float = 0.13
    reward_weights: tuple[float, ...] = field(default=tuple(rewards.SIM_WEIGHTS.values()))

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise ValueError(f"engine {self.engine!r} is not one of {ENGINES}")
        ratio = self.sim_rate / self.control_rate
        if self.control_rate <= 0 or abs(ratio - round(ratio)) > 1e-9 or round(ratio) < 1:
            raise ValueError(
                f"sim_rate {self.sim_rate} Hz is not a whole multiple of control_rate {self.control_rate} Hz"
            )
        if self.max_steps < 1:
            raise ValueError(f"max_steps is {self.max_steps}, at least 1 is needed")
        if len(self.reward_weights) != len(rewards.TERMS):
            raise ValueError(f"reward_weights has {len(self.reward_weights)} numbers, the terms are {rewards.TERMS}")

    @property
    def substeps(self) -> int:
        return round(self.sim_rate / self.control_rate)

    @property
    def period(self) -> float:
        """Control period [s]."""
        return 1.0 / self.control_rate


class Controller(Protocol):
    """What decides about the robot's velocities; batch axes last."""

    mean: jax.Array  # (11,) or (11, ...) about which the observations' statistics are summed

    def start(self, observation):
        """State before the first control step, from the first observation (11, ...)."""

    def act(self, tick, state, observation):
        """Action (8, ...) in [-1, 1] at control step ``tick`` and the next state."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """What chance decides about a batch of episodes."""

    ball: BallState  # (3, ...)
    latency: jax.Array  # (5, ...) [s], order of model.LATENCIES
    seed: jax.Array  # (...) uint32, of the observation noise
    model: SimModel  # leaves scalar or (...)
    start: jax.Array | None = None  # (8, ...) joint positions at which the robot rests at first; None: at home


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Prepared:
    """What the loop needs of the episodes' delays, drives and tracker: computed once, before it."""

    ball: latency.Delay
    joints: latency.Delay  # (8, ...)
    action: latency.Delay  # (8, ...)
    drives: drives.Drives
    camera: sensors.Camera | None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sums:
    """Running quantities of phase 1; all (...) unless noted."""

    closest: jax.Array  # [m] least distance of ball and blade centre after the bounce
    jerk: jax.Array  # means over joints, summed over steps, each step in [0, 1]
    acceleration: jax.Array
    velocity: jax.Array
    safe_angle: jax.Array  # steps with every joint well inside its range
    collision: jax.Array  # steps in contact
    low_paddle: jax.Array
    bad_style: jax.Array
    steps: jax.Array
    peak_velocity: jax.Array  # (8, ...) [m/s], [rad/s] highest commanded speed
    observation: jax.Array  # (11, ...) sum of (x - shift)
    observation_sq: jax.Array  # (11, ...) sum of (x - shift)^2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EpisodeState:
    """State of phase 1 between control steps."""

    qpos: jax.Array  # (8, ...)
    qvel: jax.Array  # (8, ...)
    pose: PaddlePose
    command: jax.Array  # (8, ...) velocity commanded in the period before
    command_acceleration: jax.Array  # (8, ...)
    reference: jax.Array  # (8, ...) sum of commands
    commands: jax.Array  # (depth, 8, ...) ring by control period
    # (depth, 11, ...) ring by control period, captured at the delays' phases; with jitter also the ball's velocity
    observations: jax.Array
    controller: object  # pytree, whatever the controller remembers
    drive: drives.DriveState
    filtered: jax.Array | None  # (3, ...) [m] the ball's position as the tracker smooths it; None: it does not
    ball: BallState
    bounced: jax.Array  # (...) bool
    hit: jax.Array  # (...) bool
    live: jax.Array  # (...) bool
    finite: jax.Array  # (...) bool
    sums: Sums


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Return:
    """Outcome of phase 2; all (...)."""

    crossed: jax.Array  # bool, over the net plane
    net_height: jax.Array  # [m] of the ball's centre there
    returned: jax.Array  # bool
    landing: jax.Array  # (2, ...) [m] where it came down to the table's height


class Task:
    """Episodes of one robot under one configuration."""

    def __init__(self, config: TaskConfig) -> None:
        self.config = config
        model = robot.load_model()
        chain = robot.chain_from_model(model)
        timestep = 1.0 / config.sim_rate
        if config.engine == "mjx":
            from mjx_tt.robot.dynamics_mjx import MjxEngine

            self.engine = MjxEngine(model, timestep)
        else:
            self.engine = FusedEngine(chain, timestep)
        self.home = robot.home_qpos(model)
        self.kinematics = PaddleKinematics(chain, robot.paddle_frame(model))
        self.clearance = CapsuleClearance(self.kinematics, robot.capsules(model))
        self._observation_depth = latency.ring_depth(config.max_observation_latency, config.period)
        self._action_depth = latency.ring_depth(config.max_action_latency, config.period)

    def prepare(self, episodes: Episodes) -> Prepared:
        """Splits the episodes' latencies, with what clock and drives add to them, and sorts drives and camera."""
        config, model, seconds = self.config, episodes.model, episodes.latency
        period, batch = config.period, seconds.shape[1:]
        joints = jnp.stack([seconds[2 if i in FESTO_JOINTS else 1] for i in range(N_JOINTS)])
        actions = jnp.stack([seconds[4 if i in FESTO_JOINTS else 3] for i in range(N_JOINTS)])
        ball, by_effect = seconds[0], drives.by_effect(model.drives, batch, seconds.dtype)
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
        """Robot at rest, at home or where the episodes say, ball at its start; before that everything was so."""
        batch, dtype = episodes.ball.position.shape[1:], episodes.ball.position.dtype

        def full(value, *leading):
            return jnp.broadcast_to(jnp.asarray(value, dtype), leading + batch)

        zeros = full(0.0, N_JOINTS)
        home = jnp.asarray(self.home, dtype).reshape((N_JOINTS,) + (1,) * len(batch))
        home = jnp.broadcast_to(home if episodes.start is None else episodes.start, zeros.shape)
        seen = jnp.concatenate([episodes.ball.position, home])
        zero, false = full(0.0), jnp.broadcast_to(False, batch)
        prepared, tracker = self.prepare(episodes), episodes.model.sensing
        captured = seen if tracker.jitter is None else jnp.concatenate([seen, episodes.ball.velocity])
        first = self._measured(episodes, prepared, captured, 0)
        return EpisodeState(
            qpos=home,
            qvel=zeros,
            pose=self.kinematics.pose(home, zeros),
            command=zeros,
            command_acceleration=zeros,
            reference=home,
            commands=full(0.0, self._action_depth, N_JOINTS),
            observations=jnp.broadcast_to(captured, (self._observation_depth, *captured.shape)),
            controller=controller.start(first),
            drive=drives.at_rest(prepared.drives, home),
            filtered=None if tracker.smoothing is None else episodes.ball.position,
            ball=episodes.ball,
            bounced=false,
            hit=false,
            live=~false,
            finite=~false,
            sums=Sums(full(3.0), *[zero] * 8, zeros, full(0.0, N_OBSERVATION), full(0.0, N_OBSERVATION)),
        )

    def _measured(self, episodes: Episodes, prepared: Prepared, captured, tick):
        """The observation (11, ...) from the true delayed quantities, as the ring keeps them."""
        tracker, joints = episodes.model.sensing, captured[3 : 3 + N_JOINTS]
        ball = captured[:3]
        if tracker.jitter is not None:
            late = tracker.jitter * noise.normal(episodes.seed, tick, 3).astype(ball.dtype)
            ball = ball + late * captured[3 + N_JOINTS :]
        if prepared.camera is not None:
            ball = prepared.camera.seen(ball)
        u = noise.symmetric_uniform(episodes.seed, tick, 3).astype(captured.dtype)
        offset = (tracker.ball_offset_x, tracker.ball_offset_y, tracker.ball_offset_z)
        ball = jnp.stack([ball[i] + tracker.ball_noise * u[i] + offset[i] for i in range(3)])
        if prepared.drives.joint_offset is not None:
            joints = joints + prepared.drives.joint_offset
        return jnp.concatenate([ball, joints])

    def observe(self, tick, s: EpisodeState, episodes: Episodes, prepared: Prepared):
        """What the policy sees at control step ``tick``: (11, ...)."""
        joints = slice(3, 3 + N_JOINTS)
        captured = [
            latency.ring_read(s.observations[:, :3], tick - prepared.ball.periods),
            latency.ring_read(s.observations[:, joints], tick - prepared.joints.periods),
        ]
        if episodes.model.sensing.jitter is not None:
            captured.append(latency.ring_read(s.observations[:, joints.stop :], tick - prepared.ball.periods))
        return materialise(self._measured(episodes, prepared, jnp.concatenate(captured), tick))

    def control_step(self, tick, s: EpisodeState, episodes: Episodes, prepared: Prepared, controller: Controller):
        """One control period: observe, act, advance robot and ball by the substeps."""
        period = self.config.period
        observation = self.observe(tick, s, episodes, prepared)
        action, controller_state = controller.act(tick, s.controller, observation)
        scale = np.asarray(LIMITS.policy_velocity, action.dtype).reshape((-1,) + (1,) * (action.ndim - 1))
        # After the contact the robot is only braked: what the real one does before it returns home.
        request = jnp.where(s.live, action * scale, 0.0)
        command = materialise(limit_velocity(request, s.command, s.reference, period, xp=jnp))
        reference = s.reference + command * period
        commands = latency.ring_write(s.commands, tick, command)
        old = latency.ring_read(commands, tick - prepared.action.periods - 1)
        new = latency.ring_read(commands, tick - prepared.action.periods)
        (qpos, qvel, pose, drive, filtered, ball, flags, closest), captured = self._substeps(
            s, episodes, prepared, old, new
        )
        bounced, hit, live = flags
        command_acceleration = (command - s.command) / period
        carried = qpos if drive.output is None else drive.output
        sums = self._accumulate(s, observation, controller.mean, command, command_acceleration, carried, pose, closest)
        ok = jnp.isfinite(sum(qpos[i] for i in range(N_JOINTS)) + sum(ball.position[i] for i in range(3)))
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
            filtered,
            ball,
            bounced,
            hit,
            live & ok,
            s.finite & (ok | ~s.live),
            sums,
        )

    def _substeps(self, s: EpisodeState, episodes: Episodes, prepared: Prepared, old, new):
        """Robot and ball through one control period, with what the delayed sensors capture on the way."""
        n, timestep = self.config.substeps, 1.0 / self.config.sim_rate
        params, gain = episodes.model.ball, episodes.model.actuation.velocity_gain
        tracker, drive_params = episodes.model.sensing, prepared.drives
        old, new = drives.reachable(drive_params, old), drives.reachable(drive_params, new)

        def capture(i, ball, filtered, joints):
            """Share of the state at substep boundary i in what the delayed sensors see: (11, ...), or (14, ...)."""
            seen_at = latency.capture_weight(prepared.ball, i, n, timestep)
            parts = [
                seen_at * (ball.position if filtered is None else filtered),
                latency.capture_weight(prepared.joints, i, n, timestep) * joints,
            ]
            if tracker.jitter is not None:
                parts.append(seen_at * ball.velocity)
            return jnp.concatenate(parts)

        def substep(i, carry):
            (qpos, qvel, pose, drive, filtered, ball, (bounced, hit, live), closest), captured = carry
            share = latency.old_command_share(prepared.action, i, timestep)
            velocity, drive = drives.follow(drive_params, drive, new + share * (old - new), timestep)
            control = materialise(gain * velocity)
            qpos, qvel = self.engine.step(qpos, qvel, control)
            carried, carried_velocity, drive = drives.carry(drive_params, drive, qpos, qvel, timestep)
            after = materialise(self.kinematics.pose(carried, carried_velocity))
            moved, events = flight.step(params, ball, timestep, (pose, after))
            moved, events = materialise((moved, events))
            before, ball = ball, where(live, moved, ball)
            if filtered is not None:
                filtered = sensors.smoothed(tracker.smoothing, filtered, before.position, ball.position, timestep)
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
            captured = captured + capture(i + 1, ball, filtered, carried)
            return materialise(((qpos, qvel, after, drive, filtered, ball, (bounced, hit, live), closest), captured))

        start = (s.qpos, s.qvel, s.pose, s.drive, s.filtered, s.ball, (s.bounced, s.hit, s.live), s.sums.closest)
        captured = capture(0, s.ball, s.filtered, s.qpos if s.drive.output is None else s.drive.output)
        return jax.lax.fori_loop(0, n, substep, (start, captured))

    def _accumulate(self, s, observation, shift, command, command_acceleration, qpos, pose, closest) -> Sums:
        sums, alive = s.sums, s.live.astype(command.dtype)
        period = self.config.period

        def relative(values, limit):  # mean over the joints of |value| / limit, at most 1 each
            parts = [jnp.minimum(jnp.abs(values[i]) / limit[i], 1.0) for i in range(N_JOINTS)]
            return sum(parts) / N_JOINTS

        jerk = (command_acceleration - s.command_acceleration) / period
        lower, upper = np.asarray(LIMITS.lower), np.asarray(LIMITS.upper)
        soft = rewards.SOFT_RANGE * (upper - lower)
        inside = [(qpos[i] > lower[i] + soft[i]) & (qpos[i] < upper[i] - soft[i]) for i in range(N_JOINTS)]
        safe = inside[0]
        for each in inside[1:]:
            safe = safe & each
        gaps = materialise(self.clearance(materialise(self.kinematics.links(qpos)), qpos[0]))
        centred = observation - shift.reshape(shift.shape + (1,) * (observation.ndim - shift.ndim))
        return Sums(
            closest=closest,
            jerk=sums.jerk + alive * relative(jerk, 2.0 * np.asarray(LIMITS.acceleration) / period),
            acceleration=sums.acceleration + alive * relative(command_acceleration, LIMITS.acceleration),
            velocity=sums.velocity + alive * relative(command, LIMITS.velocity),
            safe_angle=sums.safe_angle + alive * safe,
            collision=sums.collision + alive * ((gaps.table <= 0.0) | (gaps.own <= 0.0)),
            low_paddle=sums.low_paddle + alive * (gaps.blade < rewards.BLADE_CLEARANCE),
            bad_style=sums.bad_style + alive * (pose.normal[1] < rewards.FACING),
            steps=sums.steps + alive,
            peak_velocity=jnp.maximum(sums.peak_velocity, alive * jnp.abs(command)),
            observation=sums.observation + alive * centred,
            observation_sq=sums.observation_sq + alive * centred * centred,
        )

    def fly_out(self, ball: BallState, hit, model: SimModel) -> Return:
        """Phase 2: flies the balls that were hit until they come down.

        Alone in the air the ball needs no substeps: one second-order step per control period moves its landing point
        by less than a millimetre.
        """
        params = replace(model.ball, flight=replace(model.ball.flight, integrator="midpoint"))
        zero = jnp.zeros_like(ball.position[0])
        outcome = Return(zero > 1.0, zero, zero > 1.0, ball.position[:2])

        def flying(carry):
            tick, _, live, _ = carry
            return (tick < self.config.max_steps) & jnp.any(live)

        def advance(carry):
            tick, ball, live, outcome = carry
            new, outcome, live = self.fly_out_step(params, ball, live, outcome)
            return tick + 1, new, live, outcome

        return jax.lax.while_loop(flying, advance, (0, ball, hit, outcome))[3]

    def fly_out_step(self, params, ball: BallState, live, outcome: Return):
        """One control period of phase 2: the ball, the outcome so far and who still flies."""
        new, events = materialise(flight.step(params, ball, self.config.period))
        y0, y1 = ball.position[1], new.position[1]
        crossing = live & (y0 < 0.0) & (y1 >= 0.0)
        w = jnp.clip(-y0 / jnp.where(y1 > y0, y1 - y0, 1.0), 0.0, 1.0)
        height = ball.position[2] * (1.0 - w) + new.position[2] * w
        table = live & events.table
        down = live & ~events.table & (ball.position[2] > 0.0) & (new.position[2] <= 0.0)
        lost = live & (new.position[2] < FLOOR)
        w = jnp.clip(ball.position[2] / jnp.where(down, ball.position[2] - new.position[2], 1.0), 0.0, 1.0)
        ground = ball.position[:2] * (1.0 - w) + new.position[:2] * w
        landing = jnp.where(table, events.position[:2], jnp.where(down, ground, outcome.landing))
        outcome = Return(
            crossed=outcome.crossed | crossing,
            net_height=jnp.where(crossing, height, outcome.net_height),
            returned=outcome.returned | (table & (events.position[1] > 0.0)),
            landing=jnp.where(lost, new.position[:2], landing),
        )
        return where(live, new, ball), outcome, live & ~(table | down | lost)

    def reward_terms(self, s: EpisodeState, back: Return):
        """The eleven unweighted terms (11, ...) in the order of ``rewards.TERMS``."""
        sums, steps = s.sums, jnp.maximum(s.sums.steps, 1.0)
        returned = back.returned & s.hit
        terms = {
            "state_transition": rewards.state_transition(sums.closest, s.hit, back.crossed, returned, back.landing),
            "net_clearance": rewards.net_clearance(s.hit, back.crossed, back.net_height),
            "hit_and_land": returned.astype(steps.dtype),
            "fault": jnp.zeros_like(steps),  # only a real robot faults
            "jerk": 1.0 - sums.jerk / steps,
            "acceleration": 1.0 - sums.acceleration / steps,
            "velocity": 1.0 - sums.velocity / steps,
            "joint_angle": sums.safe_angle / steps,
            "collision": -sums.collision,
            "paddle_height": -sums.low_paddle,
            "style": -sums.bad_style,
        }
        return jnp.stack([terms[name] for name in rewards.TERMS])
