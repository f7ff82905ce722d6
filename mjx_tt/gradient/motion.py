"""The robot's motion under a policy, with derivatives by the policy's parameters.

The motion is the engine's; its derivatives are those of the joints' velocity loops alone, each a first-order lag. What
is left out, that joints disturb each other and that the load changes a loop, is small: the loops settle within 8 to
20 ms. It costs a tenth of the dynamics' derivatives.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_tt.env.episode import Controller, EpisodeConstants, Episodes
from mjx_tt.env.task import Task, compose_observation
from mjx_tt.gradient.incoming import Incoming
from mjx_tt.pytrees import pytree
from mjx_tt.robot.kinematics import Joints
from mjx_tt.sim import actuators, latency
from robot_io.limits import limit_velocity


@pytree
class Motion:
    """The robot under a policy while nothing is hit, through T control periods of S substeps in all.

    joints, velocities  of what carries the blade, at the substeps' ends: [m], [rad], [m/s], [rad/s]
    commands            velocities commanded in each control period
    observations        that the policy acted on
    """

    joints: Float[Array, "S+1 n L"]
    velocities: Float[Array, "S+1 n L"]
    commands: Float[Array, "T n L"]
    observations: Float[Array, "T observed L"]


class Servos:
    """The engine's step with the derivatives of independent velocity loops."""

    def __init__(self, task: Task) -> None:
        self._engine, self._timestep = task.engine, 1.0 / task.config.sim_rate
        self._gain = measure_response(task)

    def step(self, qpos: Joints, qvel: Joints, control: Joints) -> tuple[Joints, Joints]:
        exact = jax.lax.stop_gradient(self._engine.step(*jax.lax.stop_gradient((qpos, qvel, control))))
        gain = self._gain.astype(qvel.dtype).reshape(-1, *(1,) * (qvel.ndim - 1))
        velocity = qvel + gain * (control - qvel)
        loops = (qpos + self._timestep * velocity, velocity)
        # The loops' own numbers cancel: exactly the engine's are left, with the loops' derivatives.
        return jax.tree.map(lambda there, loop: there + (loop - jax.lax.stop_gradient(loop)), exact, loops)


def measure_response(task: Task) -> np.ndarray:
    """Share (n,) of a step of the commanded velocity that each joint reaches within a substep, at home."""
    n, tiny = task.contract.n_joints, 1e-3
    with jax.ensure_compile_time_eval():
        home = jnp.broadcast_to(jnp.asarray(task.home, jnp.float32)[:, None], (n, n + 1))
        asked = jnp.concatenate([tiny * jnp.eye(n), jnp.zeros((n, 1))], 1)
        _, velocity = jax.jit(task.engine.step)(home, jnp.zeros_like(home), asked)
        moved = np.asarray(velocity)
    return np.clip((np.diag(moved[:, :n]) - moved[:, n]) / tiny, 0.0, 1.0)


def simulate_motion(
    task: Task, servos: Servos, controller: Controller, episodes: Episodes, constants: EpisodeConstants, ball: Incoming
) -> Motion:
    """The motion of the robot in episodes (L,), as ``Task.play`` has it until a ball is hit."""
    config, limits, n = task.config, task.contract.limits, task.substeps
    period, timestep, dtype = task.period, task.timestep, episodes.ball.position.dtype
    scale = jnp.asarray(np.asarray(limits.policy_velocity)[:, None], dtype)
    start = jnp.asarray(task.home, dtype)[:, None] if episodes.start is None else episodes.start
    home = jnp.broadcast_to(start, (task.contract.n_joints, *episodes.seed.shape))
    zero = jnp.zeros_like(home)

    def observe(tick: Array | int, seen: Array, joints: Array, command: Array) -> Array:
        captured = jnp.concatenate([seen[:3], joints, seen[3:]])
        return compose_observation(config.observations, task.measure(episodes, constants, captured, command, tick))

    def capture(i: int, joints: Array) -> Array:
        return latency.weigh_capture(constants.joints, i, timestep) * joints

    def step(carry: tuple, now: tuple[Array, Array]) -> tuple[tuple, tuple]:
        robot, command, reference, commands, measured, policy = carry
        tick, seen = now
        input_ = observe(tick, seen, _read(measured, tick - constants.joints.periods), command)
        action, policy = controller.act(tick, policy, input_)
        command = limit_velocity(action * scale, command, reference, period, limits, xp=jnp)
        reference = reference + command * period
        commands = latency.write_ring(commands, tick, command)
        asked = [_read(commands, tick - constants.action.periods - late) for late in (1, 0)]
        old, new = (actuators.limit_command(constants.drives, each) for each in asked)
        drive = robot[2]
        at_encoders, passed = capture(0, robot[0] if drive.output is None else drive.output), []
        for i in range(n):
            robot, carried, bent = task.step_robot(i, robot, (old, new), episodes, constants, servos.step)
            at_encoders = at_encoders + capture(i + 1, carried)
            passed.append(bent)
        measured = latency.write_ring(measured, tick, at_encoders)
        return (robot, command, reference, commands, measured, policy), (
            *(jnp.stack(x) for x in zip(*passed, strict=True)),
            command,
            input_,
        )

    seen = jnp.concatenate([episodes.ball.position, episodes.ball.velocity])[: ball.seen.shape[1]]
    depth = [latency.count_slots(x, period) for x in (config.max_action_latency, config.max_observation_latency)]
    carry = (
        (home, zero, actuators.rest(constants.drives, home)),
        zero,
        home,
        jnp.zeros((depth[0], *home.shape), dtype),
        jnp.broadcast_to(home, (depth[1], *home.shape)),
        controller.start(observe(0, seen, home, zero)),
    )
    _, (joints, velocities, commands, inputs) = jax.lax.scan(step, carry, (jnp.arange(ball.seen.shape[0]), ball.seen))
    return Motion(_with_start(home, joints), _with_start(zero, velocities), commands, inputs)


def _with_start(first: Array, by_tick: Array) -> Array:
    """(S + 1, n, L) from the start (n, L) and what was passed in each control period, (T, substeps, n, L)."""
    return jnp.concatenate([first[None], by_tick.reshape(-1, *by_tick.shape[2:])])


def _read(ring: Float[Array, "depth n L"], tick: Array) -> Float[Array, "n L"]:
    """As ``latency.read_ring``; one selection, whose derivative is one selection as well."""
    slots = jnp.arange(ring.shape[0]).reshape(-1, *(1,) * (ring.ndim - 1))
    return jnp.where(slots == jnp.mod(tick, ring.shape[0])[None], ring, 0.0).sum(0)
