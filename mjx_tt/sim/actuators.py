"""Actuator model of a joint: delay, dead band, friction, gain, saturation, first-order lag, backlash.

The velocity command u passes steps 1 to 7 before the simulated servo follows it; 9 and 10 act on the position:

    1. u is held for a control period and arrives ``action_delay`` later than the joint's drawn latency says
    2. dead band: 0 where |u| < deadband
    3. Coulomb friction, as the velocity it costs: u - c sign(u) where |u| > c, else 0
    4. times velocity_gain
    5. clipped to +-velocity_limit
    6. first-order lag: dv/dt = (u - v) / lag
    7. |dv/dt| <= acceleration_limit
    8. the servo of the MJCF follows v: dq/dt = v but for the arm's dynamics
    9. backlash b: what the joint carries follows q with play, and moves only when |q - output| reaches b / 2
   10. measured is output(t - observation delay) + joint_offset
   11. on a flexible mount what the joint carries swings about the output: d'' = -w^2 d - 2 z w d' - q'', with
       w = 2 pi resonance; neither the encoder nor the check for contact with the table sees it

Steps 2 to 5 have no memory and act on the commands, 6 and 7 are solved exactly over a substep in which u is constant.
A model without drives (``SimModel.drives`` None), or an effect that no joint departs from, costs nothing.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import field
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from ballmodel.io.ranges import Within
from ballmodel.partial_params import optional, value_or
from ballmodel.vec import Scalars
from mjx_tt.pytrees import pytree
from robot_io.contract import JOINT_NAMES
from robot_io.limits import LIMITS

# "No limit" as numbers that no drive reaches: ten times the fastest joint's speed, and up to it within 10 microseconds.
NO_VELOCITY_LIMIT = 10.0 * max(LIMITS.velocity)  # [m/s], [rad/s]
NO_ACCELERATION_LIMIT = 1e5 * NO_VELOCITY_LIMIT  # [m/s^2], [rad/s^2]
SHORTEST = 1e-9  # [s], keeps exponents finite
SWING_DAMPING = 0.1  # ratio z of a flexible mount, estimate: bolted metal without a damper


@pytree
class JointDrive:
    """One joint's drive; nominal it does nothing. Every field is a scalar or has the episodes' batch shape.

    Units are those of the joint: [m] for the gantry's axes, [rad] for the arm's joints.
    """

    # [s] more than latency.abb_action or festo_action draws
    action_delay: Annotated[Scalars, Within(0.0, 1.0, "s")] | None = optional(0.0)
    # [s] more than latency.*_observation draws
    observation_delay: Annotated[Scalars, Within(0.0, 1.0, "s")] | None = optional(0.0)
    lag: Annotated[Scalars, Within(0.0, 1.0, "s")] | None = optional(0.0)  # [s]
    # reached over commanded, beside actuation.velocity_gain
    velocity_gain: Annotated[Scalars, Within(-3.0, 3.0)] | None = optional(1.0)
    joint_offset: Annotated[Scalars, Within(-3.2, 3.2)] | None = optional(0.0)  # [m], [rad] measured less true position
    velocity_limit: Annotated[Scalars, Within(0.0)] | None = optional(NO_VELOCITY_LIMIT)  # [m/s], [rad/s]
    acceleration_limit: Annotated[Scalars, Within(0.0)] | None = optional(NO_ACCELERATION_LIMIT)  # [m/s^2], [rad/s^2]
    backlash: Annotated[Scalars, Within(0.0)] | None = optional(0.0)  # [m], [rad] width of the play
    coulomb_friction: Annotated[Scalars, Within(0.0)] | None = optional(0.0)  # [m/s], [rad/s] that friction costs
    deadband: Annotated[Scalars, Within(0.0)] | None = optional(0.0)  # [m/s], [rad/s]
    resonance: Annotated[Scalars, Within(0.0)] | None = optional(0.0)  # [Hz] of a flexible mount; 0: it is rigid


EFFECTS = tuple(f.name for f in dataclasses.fields(JointDrive))


@functools.cache
def drive_params(joints: tuple[str, ...]) -> Any:
    """The class that holds the drives of these joints, a ``JointDrive`` by each one's name."""
    fields = [(joint, JointDrive, field(default_factory=JointDrive)) for joint in joints]
    made = dataclasses.make_dataclass("DriveParams", fields, frozen=True, namespace={"__module__": __name__})
    return jax.tree_util.register_dataclass(made, data_fields=list(joints), meta_fields=[])


DriveParams = drive_params(JOINT_NAMES)  # of the paper's robot


@pytree
class DriveState:
    """State of the drives; None where an effect has none."""

    velocity: Float[Array, "joints *batch"] | None  # [m/s], [rad/s] v of steps 6 and 7
    output: Float[Array, "joints *batch"] | None  # [m], [rad] position behind the play
    swing: Float[Array, "2 joints *batch"] | None = None  # [m], [rad] of a flexible mount about it, and its velocity


def sort_by_effect(
    params: Any | None, shape: tuple[int, ...], dtype: DTypeLike, joints: tuple[str, ...] = JOINT_NAMES
) -> JointDrive:
    """The numbers of drives, as ``drive_params`` of the joints holds them, as arrays (n, *shape).

    An effect that no joint has is None: it costs nothing in the loop.
    """
    nominal = dataclasses.asdict(JointDrive())

    def column(effect: str) -> Array | None:
        values = [getattr(getattr(params, joint), effect) for joint in joints] if params is not None else [None]
        if all(value is None for value in values):
            return None
        return jnp.stack([jnp.broadcast_to(jnp.asarray(value_or(v, nominal[effect]), dtype), shape) for v in values])

    return JointDrive(**{effect: column(effect) for effect in EFFECTS})


def rest(drives: JointDrive, qpos: Float[Array, "joints *batch"]) -> DriveState:
    """The drives of a robot that stands at qpos (n, ...), in the middle of every play."""
    at_once = drives.lag is None and drives.acceleration_limit is None  # the velocity is what is commanded
    return DriveState(
        None if at_once else jnp.zeros_like(qpos),
        qpos if drives.backlash is not None else None,
        jnp.zeros((2, *qpos.shape), qpos.dtype) if drives.resonance is not None else None,
    )


def limit_command(drives: JointDrive, command: Float[Array, "joints *batch"]) -> Float[Array, "joints *batch"]:
    """Steps 2 to 5: the velocity (n, ...) that a delayed command (n, ...) asks of the drive in the end."""
    u = command
    if drives.deadband is not None:
        u = jnp.where(jnp.abs(u) < drives.deadband, 0.0, u)
    if drives.coulomb_friction is not None:
        u = jnp.sign(u) * jnp.maximum(jnp.abs(u) - drives.coulomb_friction, 0.0)
    if drives.velocity_gain is not None:
        u = u * drives.velocity_gain
    if drives.velocity_limit is not None:
        u = jnp.clip(u, -drives.velocity_limit, drives.velocity_limit)
    return u


def step_lag(
    drives: JointDrive, state: DriveState, u: Float[Array, "joints *batch"], timestep: float
) -> tuple[Float[Array, "joints *batch"], DriveState]:
    """Steps 6 and 7 over one substep [s] of constant u (n, ...): the mean velocity in it, and the state at its end.

    As long as the lag asks for more than the acceleration limit a, v moves at a; that ends at |u - v| = a lag, and from
    there on the difference decays exponentially. The servo gets the mean, with which its way is exact.
    """
    v = state.velocity
    if v is None:
        return u, state
    lag = jnp.zeros_like(v) if drives.lag is None else jnp.maximum(drives.lag, 0.0)
    gap = u - v
    if drives.acceleration_limit is None:
        limited, speed_up = jnp.zeros_like(v), jnp.zeros_like(v)
    else:
        a = drives.acceleration_limit
        limited = jnp.clip((jnp.abs(gap) - a * lag) / a, 0.0, timestep)  # [s] spent at the limit
        speed_up = jnp.sign(gap) * a * limited
    rest = timestep - limited
    left = gap - speed_up  # u - v when the limit is left
    decay = jnp.exp(-rest / jnp.maximum(lag, SHORTEST))
    way = (v + 0.5 * speed_up) * limited + u * rest - left * lag * (1.0 - decay)
    return way / timestep, dataclasses.replace(state, velocity=u - left * decay)


def step_backlash(
    drives: JointDrive,
    state: DriveState,
    qpos: Float[Array, "joints *batch"],
    qvel: Float[Array, "joints *batch"],
    timestep: float,
) -> tuple[Float[Array, "joints *batch"], Float[Array, "joints *batch"], DriveState]:
    """Step 9 over one substep: position and velocity (n, ...) of what the joints carry, and the state.

    qpos, qvel: of the joints at the substep's end.
    """
    if drives.backlash is None or state.output is None:
        return qpos, qvel, state
    half = 0.5 * drives.backlash
    output = jnp.clip(state.output, qpos - half, qpos + half)
    return output, (output - state.output) / timestep, dataclasses.replace(state, output=output)


def step_swing(
    drives: JointDrive,
    state: DriveState,
    before: Float[Array, "joints *batch"],
    after: Float[Array, "joints *batch"],
    timestep: float,
) -> DriveState:
    """Step 11 over one substep: the state with the swing of flexible mounts at its end.

    before, after: velocity (n, ...) of the joints at the substep's ends. Between them the acceleration is taken as
    constant, for which the damped oscillator is solved exactly.
    """
    if drives.resonance is None or state.swing is None:
        return state
    flexible, zeta = drives.resonance > 0.0, SWING_DAMPING
    w = 2.0 * jnp.pi * jnp.where(flexible, drives.resonance, 1.0)
    rest = -(after - before) / timestep / w**2  # about which it swings
    x, v = state.swing[0] - rest, state.swing[1]
    damped = w * (1.0 - zeta**2) ** 0.5
    decay, cos, sin = jnp.exp(-zeta * w * timestep), jnp.cos(damped * timestep), jnp.sin(damped * timestep)
    position = rest + decay * (x * cos + (v + zeta * w * x) / damped * sin)
    velocity = decay * (v * cos - (w**2 * x + zeta * w * v) / damped * sin)
    return dataclasses.replace(state, swing=jnp.where(flexible, jnp.stack([position, velocity]), 0.0))
