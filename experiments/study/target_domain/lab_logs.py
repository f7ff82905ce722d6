"""What a laboratory logs of the virtual reality: its joints before the first ball, and balls with hits in them.

Joints: for a minute each follows a sum of sines of its own, so that its position stays near home while its speed and
acceleration take many values (multisine: Schoukens and Ljung, IEEE Control Systems 39, 2019).

Hits: balls from the player's paddle to the robot's and back, with the joints on the same clock. Turns of a rally are
played, and each is watched: the robot's motion as the simulator of the rallies has it, step by step, the ball flown
along it once more in finer steps, so that a camera's frame needs no control period. A tracker's positions and the
encoders' come when they arrive, each as late as that episode's draw of its latency, with the errors of camera and
zeros.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import PRNGKeyArray

from ballmodel import flight
from ballmodel.constants import BALL_RADIUS
from ballmodel.flight import PaddlePose
from ballmodel.state import BallState
from ballmodel.trajectory import Dataset, Trajectory
from experiments.study.target_domain import hidden_effects
from experiments.study.target_domain.hidden_effects import CAMERA_RATE
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.env.episode import Episodes, EpisodeState, Tick
from mjx_tt.env.policy import Policy
from mjx_tt.env.policy import controller as controller_of
from mjx_tt.env.task import Task
from mjx_tt.rally.human_player import Player
from mjx_tt.rally.simulator import RallySimulator
from mjx_tt.sim import actuators, latency
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from robot_io.contract import FESTO_JOINTS
from robot_io.limits import LIMITS, JointLimits

REST = 0.5  # [s] before the first motion, in which the joints stand where they are
SINES = 6
FREQUENCIES = (0.25, 3.0)  # [Hz]
REACH = 0.04  # of a joint's range that its position leaves home by, about
SECONDS = 1.4  # of each ball that are watched
EVERY = 4.0  # [s] from ball to ball on the log's clock
SUBSTEPS = 4  # of the ball per camera frame
AWAY = 0.3  # [m] beyond the player's contact at which a return is out of sight
RALLIES, TURNS = 12, 10  # side by side, and of each


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sweeps:
    """Actions by tick as a ``Controller``."""

    actions: Array  # (ticks, n)

    @property
    def mean(self) -> Array:
        return jnp.zeros(3 + self.actions.shape[1])

    def start(self, observation: Array) -> tuple:
        return ()

    def act(self, tick: Tick, state: tuple, observation: Array) -> tuple[Array, tuple]:
        return jnp.broadcast_to(self.actions[tick][:, None], (self.actions.shape[1], *observation.shape[1:])), ()


def multisine(rng: np.random.Generator, ticks: int, period: float, limits: JointLimits = LIMITS) -> np.ndarray:
    """Actions (ticks, n) in [-1, 1]: derivatives of sums of sines that begin and end softly, after a rest."""
    time = np.arange(ticks) * period - REST
    (low, high), n = np.log(FREQUENCIES), len(limits.joints)
    frequency = np.exp(rng.uniform(low, high, (SINES, n)))
    phase = rng.uniform(0.0, 2.0 * np.pi, (SINES, n))
    reach = REACH * (np.asarray(limits.upper) - np.asarray(limits.lower))
    rate = 2.0 * np.pi * frequency
    speed = rate * np.cos(rate * time[:, None, None] + phase) / np.maximum(frequency, 1.0)
    velocity = reach * speed.sum(axis=1) / np.sqrt(SINES)
    soft = np.clip(time / 0.5, 0.0, 1.0) * np.clip((time[-1] - time) / 0.5, 0.0, 1.0)
    return np.clip(velocity * soft[:, None] / np.asarray(limits.policy_velocity), -1.0, 1.0)


def record_joints(task: Task, model: SimModel, key: PRNGKeyArray, seconds: float = 60.0) -> tuple[JointRecord, ...]:
    """The log of a robot of that model which was swept for so many seconds, a record for each joint."""
    ticks, period = round(seconds / task.config.period), task.config.period
    actions = multisine(np.random.default_rng(int(jax.random.bits(key))), ticks, period, task.contract.limits)
    commands, positions = _swept(model, Sweeps(jnp.asarray(actions, jnp.float32)), task=task)
    time = np.arange(ticks) * period
    numbers = [np.asarray(values, np.float64).T for values in (commands, positions)]
    return tuple(
        JointRecord(name, time, command, time, position, task.config.robot)
        for name, command, position in zip(task.contract.joints, *numbers, strict=True)
    )


@partial(jax.jit, static_argnames="task")
def _swept(model: SimModel, sweeps: Sweeps, task: Task) -> tuple[Array, Array]:
    """Commands and measured positions (ticks, n)."""
    # Over a minute what an episode's latency is off its mean averages out.
    delays = jnp.stack([jnp.full((1,), getattr(model.latency, name)) for name in models.LATENCIES])
    still = jnp.zeros((3, 1))
    episodes = Episodes(
        ball=BallState(jnp.array([[0.0], [0.0], [1.0]]), still, still),
        latency=delays,
        seed=jnp.zeros((1,), jnp.uint32),
        model=model,
    )
    constants = task.prepare(episodes)

    def advance(s: EpisodeState, tick: Tick) -> tuple[EpisodeState, tuple[Array, Array]]:
        seen = task.observe(tick, s, episodes, constants)
        s = task.step(tick, s, episodes, constants, sweeps)
        kept = replace(s, ball=episodes.ball, live=jnp.ones_like(s.live))  # no ball is played
        return kept, (s.command[:, 0], seen[3:, 0])

    ticks = jnp.arange(sweeps.actions.shape[0])
    _, found = jax.lax.scan(advance, task.reset(episodes, sweeps), ticks)
    return found


@dataclass(frozen=True)
class HitLog:
    """Tracks of balls with hits and returns in them, and the joints' records over all of them, by one clock."""

    balls: Dataset
    joints: tuple[JointRecord, ...]


def record_hits(
    simulator: RallySimulator,
    model: SimModel,
    player: Player,
    policy: Policy,
    key: PRNGKeyArray,
    session: str,
    noise: float,
    believed: float,
) -> HitLog:
    """RALLIES x TURNS balls of rallies of a player with a policy, one after the other on the log's clock.

    model: the reality, without what is nominal; noise: [m] of the camera; believed: [s] by which the camera is late as
    far as one knows, which its stamps are put right by.
    """
    start_key, play_key, camera_key = jax.random.split(key, 3)
    policy = jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[..., None], RALLIES, axis=-1), policy)
    state, task = simulator.start(player, model, start_key, RALLIES), simulator.task
    balls: list[Trajectory] = []
    states: list[_States] = []
    for turn in range(TURNS):
        turn_key = jax.random.fold_in(play_key, turn)
        episodes = simulator.episodes(turn_key, model, state)
        watched = jax.tree.map(np.asarray, _watched(policy, episodes, task=task))
        state, _ = simulator.shots(policy, player, model, state, turn_key)
        seen = hidden_effects.observe(model, watched[0], noise, jax.random.fold_in(camera_key, turn))
        late_by = np.asarray(episodes.latency)
        for rally in range(RALLIES):
            begin = EVERY * (turn * RALLIES + rally)
            late = float(late_by[0, rally]) - believed
            count = count_visible(watched[0][..., rally])
            time = begin + late + np.arange(count) / CAMERA_RATE
            balls.append(Trajectory(session, str(len(balls)), np.asarray(time), seen[:, :count, rally]))
            commands, encoders = (np.asarray(x)[..., rally] for x in watched[1:])
            states.append(_States(begin, late_by[:, rally], commands, encoders))
    return HitLog(Dataset(tuple(balls), session), _records(task, model, states))


@dataclass(frozen=True)
class _States:
    """The joints during one ball."""

    begin: float  # [s] on the log's clock
    latency: np.ndarray  # (5,) [s]
    command: np.ndarray  # (ticks, 8) by control period
    encoder: np.ndarray  # (8, T) true positions at the simulator's steps


def count_visible(position: np.ndarray) -> int:
    """Frames of a ball's positions (3, T) [m] until it falls low, passes the robot or comes back to where it was hit.

    A person behind the table may strike below its height: such a ball rises first.
    """
    x, y, z = position
    falls = np.diff(z, prepend=z[0]) < 0.0
    gone = (falls & (z < BALL_RADIUS - 0.05)) | (y < -2.3) | (y > y[0] + AWAY)
    return int(np.argmax(gone)) if gone.any() else len(gone)


def _records(task: Task, model: SimModel, states: list[_States]) -> tuple[JointRecord, ...]:
    """Positions that encoders reported over all balls, and the commands, of each joint."""
    period, records = task.config.period, []
    for i, name in enumerate(task.contract.joints):
        zero = 0.0 if model.drives is None else getattr(model.drives, name).joint_offset or 0.0
        late = 2 if i in FESTO_JOINTS else 1
        # After its ball the robot is stopped: a command holds until the next one.
        command_time = np.concatenate([one.begin + period * np.arange(len(one.command) + 1) for one in states])
        ticks = [
            np.arange(one.encoder.shape[1]) / task.config.sim_rate + one.begin + one.latency[late] for one in states
        ]
        command = np.concatenate([np.append(one.command[:, i], 0.0) for one in states])
        position = np.concatenate([one.encoder[i] + zero for one in states])
        records.append(JointRecord(name, command_time, command, np.concatenate(ticks), position, task.config.robot))
    return tuple(records)


@partial(jax.jit, static_argnames="task")
def _watched(policy: Policy, episodes: Episodes, task: Task) -> tuple[Array, Array, Array]:
    """Positions of balls (3, T, L) at the camera's rate, commands (ticks, 8, L), and what encoders see, (8, T', L), at
    the simulator's own steps: positions between them would be another robot's."""
    controller, constants = controller_of(policy), task.prepare(episodes)
    ticks = round(SECONDS / task.config.period) + 1

    def advance(s: EpisodeState, tick: Tick) -> tuple[EpisodeState, tuple]:
        after = task.step(tick, s, episodes, constants, controller)
        sent = (
            latency.read_ring(after.commands, tick - constants.action.periods - 1),
            latency.read_ring(after.commands, tick - constants.action.periods),
        )
        old, new = (actuators.limit_command(constants.drives, command) for command in sent)

        def substep(robot: tuple, i: Tick) -> tuple[tuple, tuple]:
            robot, carried, (bent, bent_velocity) = task.step_robot(i, robot, (old, new), episodes, constants)
            return robot, (carried, bent, bent_velocity)

        _, states = jax.lax.scan(substep, (s.qpos, s.qvel, s.drive), jnp.arange(task.config.substeps))
        return after, (states, after.command)

    first = task.reset(episodes, controller)
    _, (states, commands) = jax.lax.scan(advance, first, jnp.arange(ticks))
    at_rest = (first.qpos, first.qpos, jnp.zeros_like(first.qpos))
    encoders, q, v = (
        jnp.concatenate([a[None], jnp.reshape(x, (-1, *x.shape[2:]))]) for a, x in zip(at_rest, states, strict=True)
    )
    frames, rate = round(SECONDS * CAMERA_RATE), CAMERA_RATE * SUBSTEPS
    time = jnp.arange(frames * SUBSTEPS + 1) / rate
    carried = _between(q, v, time, 1.0 / task.config.sim_rate)
    pose = task.kinematics.pose(*(jnp.moveaxis(x, 0, 1) for x in carried))  # each (3, K, L)

    def substep(ball: BallState, pair: tuple[PaddlePose, PaddlePose]) -> tuple[BallState, Array | np.ndarray]:
        new, _ = flight.step(episodes.model.ball, ball, 1.0 / rate, pair)
        return new, ball.position

    poses = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), pose)
    pairs = (jax.tree.map(lambda x: x[:-1], poses), jax.tree.map(lambda x: x[1:], poses))
    _, path = jax.lax.scan(substep, episodes.ball, pairs)
    return jnp.moveaxis(path[::SUBSTEPS], 0, 1), commands, jnp.moveaxis(encoders, 0, 1)


def _between(q: Array, v: Array, time: ArrayLike, h: float) -> tuple[Array, Array]:
    """Positions and velocities (K, 8, L) at times (K,) [s] from those every ``h`` [s], by cubic pieces."""
    n = jnp.minimum((jnp.asarray(time) / h).astype(int), q.shape[0] - 2)
    s = (jnp.asarray(time) / h - n)[:, None, None]
    a, b, va, vb = q[n], q[n + 1], h * v[n], h * v[n + 1]
    c2, c3 = 3.0 * (b - a) - 2.0 * va - vb, 2.0 * (a - b) + va + vb
    return a + s * (va + s * (c2 + s * c3)), (va + s * (2.0 * c2 + 3.0 * s * c3)) / h
