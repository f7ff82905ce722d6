"""Reward terms of an episode: sums over its control steps, and the terms from sums and outcome."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from mjx_tt.env import rewards
from mjx_tt.env.episode import EpisodeState, Return, Sums
from mjx_tt.env.own import ControlStep, PlayedBall, Term
from robot_io.contract import LIMITS, JointLimits


def accumulate(
    s: EpisodeState,
    step: ControlStep,
    period: float,
    shift: Float[Array, "observed *#batch"],
    closest: Float[Array, "*batch"],
    own: tuple[Term, ...] = (),
    limits: JointLimits = LIMITS,
) -> Sums:
    """The sums after one more control period [s].

    shift: value about which observations are summed; closest: least distance [m] so far; own: the user's terms;
    limits: of the robot.
    """
    sums, alive = s.sums, s.live.astype(step.command.dtype)
    n = len(limits.joints)

    # Mean over the joints of |value| / limit, at most 1 each.
    def relative(values: Array, limit: np.ndarray | tuple[float, ...]) -> Array:
        parts = [jnp.minimum(jnp.abs(values[i]) / limit[i], 1.0) for i in range(n)]
        return jnp.asarray(sum(parts)) / n

    jerk = (step.acceleration - s.command_acceleration) / period
    lower, upper = np.asarray(limits.lower), np.asarray(limits.upper)
    soft = rewards.SOFT_RANGE * (upper - lower)
    inside = [(step.joints[i] > lower[i] + soft[i]) & (step.joints[i] < upper[i] - soft[i]) for i in range(n)]
    safe = inside[0]
    for each in inside[1:]:
        safe = safe & each
    centred = step.observation - shift.reshape(shift.shape + (1,) * (step.observation.ndim - shift.ndim))
    return Sums(
        closest=closest,
        jerk=sums.jerk + alive * relative(jerk, 2.0 * np.asarray(limits.acceleration) / period),
        acceleration=sums.acceleration + alive * relative(step.acceleration, limits.acceleration),
        velocity=sums.velocity + alive * relative(step.command, limits.velocity),
        safe_angle=sums.safe_angle + alive * safe.astype(alive.dtype),
        collision=sums.collision + alive * ((step.table_gap <= 0.0) | (step.own_gap <= 0.0)).astype(alive.dtype),
        low_paddle=sums.low_paddle + alive * (step.blade_gap < rewards.BLADE_CLEARANCE).astype(alive.dtype),
        bad_style=sums.bad_style + alive * (step.blade.normal[1] < rewards.FACING).astype(alive.dtype),
        steps=sums.steps + alive,
        peak_velocity=jnp.maximum(sums.peak_velocity, alive[None] * jnp.abs(step.command)),
        observation=sums.observation + alive[None] * centred,
        observation_sq=sums.observation_sq + alive[None] * centred * centred,
        own=_own_sums(s, step, own),
    )


def _own_sums(s: EpisodeState, step: ControlStep, own: tuple[Term, ...]) -> tuple[Array, ...]:
    """The sums of the user's terms per control step, those of others untouched."""
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
