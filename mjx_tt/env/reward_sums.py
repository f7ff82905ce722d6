"""Reward terms of an episode: sums over its control steps, and the terms from sums and outcome."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ballmodel.flight import PaddlePose
from ballmodel.state import BallState
from mjx_tt.env import rewards
from mjx_tt.env.episode import EpisodeState, Return, Sums
from mjx_tt.env.own import ControlStep, PlayedBall, Term
from mjx_tt.robot.clearance import Clearances
from robot_io.contract import LIMITS, N_JOINTS


def accumulate(
    s: EpisodeState,
    period: float,
    observation: Float[Array, "11 *batch"],
    shift: Float[Array, "11 *#batch"],
    command: Float[Array, "8 *batch"],
    command_acceleration: Float[Array, "8 *batch"],
    qpos: Float[Array, "8 *batch"],
    pose: PaddlePose,
    gaps: Clearances,
    closest: Float[Array, "*batch"],
    own: tuple[Term, ...] = (),
    ball: BallState | None = None,
    bounced: Bool[Array, "*batch"] | None = None,
) -> Sums:
    """The sums after one more control period [s].

    shift: value about which observations are summed; qpos, pose, gaps: of the robot at the period's end. own: the
    user's terms, for which ball and bounced say how it flies then.
    """
    sums, alive = s.sums, s.live.astype(command.dtype)

    # Mean over the joints of |value| / limit, at most 1 each.
    def relative(values: Array, limit: np.ndarray | tuple[float, ...]) -> Array:
        parts = [jnp.minimum(jnp.abs(values[i]) / limit[i], 1.0) for i in range(N_JOINTS)]
        return jnp.asarray(sum(parts)) / N_JOINTS

    jerk = (command_acceleration - s.command_acceleration) / period
    lower, upper = np.asarray(LIMITS.lower), np.asarray(LIMITS.upper)
    soft = rewards.SOFT_RANGE * (upper - lower)
    inside = [(qpos[i] > lower[i] + soft[i]) & (qpos[i] < upper[i] - soft[i]) for i in range(N_JOINTS)]
    safe = inside[0]
    for each in inside[1:]:
        safe = safe & each
    centred = observation - shift.reshape(shift.shape + (1,) * (observation.ndim - shift.ndim))
    return Sums(
        closest=closest,
        jerk=sums.jerk + alive * relative(jerk, 2.0 * np.asarray(LIMITS.acceleration) / period),
        acceleration=sums.acceleration + alive * relative(command_acceleration, LIMITS.acceleration),
        velocity=sums.velocity + alive * relative(command, LIMITS.velocity),
        safe_angle=sums.safe_angle + alive * safe.astype(alive.dtype),
        collision=sums.collision + alive * ((gaps.table <= 0.0) | (gaps.own <= 0.0)).astype(alive.dtype),
        low_paddle=sums.low_paddle + alive * (gaps.blade < rewards.BLADE_CLEARANCE).astype(alive.dtype),
        bad_style=sums.bad_style + alive * (pose.normal[1] < rewards.FACING).astype(alive.dtype),
        steps=sums.steps + alive,
        peak_velocity=jnp.maximum(sums.peak_velocity, alive[None] * jnp.abs(command)),
        observation=sums.observation + alive[None] * centred,
        observation_sq=sums.observation_sq + alive[None] * centred * centred,
        own=_own_sums(s, own, observation, command, command_acceleration, qpos, pose, gaps, ball, bounced),
    )


def _own_sums(
    s: EpisodeState,
    own: tuple[Term, ...],
    observation: Array,
    command: Array,
    acceleration: Array,
    qpos: Array,
    pose: PaddlePose,
    gaps: Clearances,
    ball: BallState | None,
    bounced: Array | None,
) -> tuple[Array, ...]:
    """The sums of the user's terms per control step, those of others untouched."""
    if not any(term.per == "step" for term in own):
        return s.sums.own
    assert ball is not None and bounced is not None
    position, velocity = jnp.asarray(ball.position), jnp.asarray(ball.velocity)
    step = ControlStep(
        observation, command, acceleration, qpos, pose, position, velocity, bounced, gaps.table, gaps.own
    )
    # What a term says of a ball that is over, perhaps no number, must not reach the sum.
    values = [jnp.where(s.live, jnp.asarray(term.function(step)), 0.0) for term in own if term.per == "step"]
    return tuple(before + value.astype(before.dtype) for before, value in zip(s.sums.own, values, strict=True))


def reward_terms(s: EpisodeState, back: Return, own: tuple[Term, ...] = ()) -> Float[Array, "terms *batch"]:
    """The eleven unweighted terms in the order of ``rewards.TERMS``, and the user's after them."""
    sums, steps = s.sums, jnp.maximum(s.sums.steps, 1.0)
    returned = back.returned & s.hit
    values = {
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
    defined = []
    if own:
        sums_per_step = iter(sums.own)
        ball = PlayedBall(
            s.hit, back.crossed, returned, back.net_height, back.landing, sums.closest, sums.steps, sums.peak_velocity
        )
        for term in own:
            number = next(sums_per_step) / steps if term.per == "step" else jnp.asarray(term.function(ball))
            defined.append(jnp.broadcast_to(number.astype(steps.dtype), steps.shape))
    return jnp.stack([*(values[name] for name in rewards.TERMS), *defined])
