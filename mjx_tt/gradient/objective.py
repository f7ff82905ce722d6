"""A smooth measure of play, whose derivatives lead where the paper's rewards only tell.

Most of the eleven terms of ``mjx_tt.env.task`` are steps: a ball that is missed by a hand says nothing of where the
blade should have been. Here a miss counts by its distance and by where the ball would have gone, a hit by where the
ball goes. What the rewards have as means over time (jerk, acceleration, velocity) is taken over as it is. Contacts with
table and robot, a low blade and bad style, which the rewards count by control steps, are counted as well, and weighed
by how bad their worst moment is. Of a missed ball until it is out of play: there is where a policy that nothing holds
back does them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from ballmodel import constants as c
from ballmodel.flight import PaddlePose
from mjx_tt.env.episode import Episodes
from mjx_tt.env.task import BLADE_CLEARANCE, FACING, Task
from mjx_tt.gradient.incoming import fly_incoming
from mjx_tt.gradient.motion import Motion, Servos, simulate_motion
from mjx_tt.gradient.network import differentiable
from mjx_tt.gradient.strike import Landing, Meeting, Strike, find_landing, find_meeting, simulate_strike
from mjx_tt.pytrees import pytree
from mjx_tt.robot.kinematics import Joints
from robot_io.policy.policy import Policy

# Lengths in metres at which a term begins to saturate: beyond, only its logarithm grows, so that no ball outshouts the
# others. The blade's radius is 76 mm.
NEAR = 0.06  # of the ball from the blade's middle, past it or on it
FAR = 0.15  # from here on a miss says little about where the ball would have gone
# Landings within these half sizes about TARGET are alike, and returns this high over the net's plane: a policy that is
# free to choose among them touches more balls.
TARGET, INSIDE, BEYOND = (
    (0.0, 0.75),
    (0.45, 0.25),
    0.3,
)  # [m]; a little behind the half's middle: short balls hit the net
HIGH, LOW = 0.28, 0.1
NO_CROSSING = 2.0  # of a ball that does not reach the net: as one 0.25 m too low
FACING_MARGIN = 0.1  # of the normal's y component
MARGIN = 0.03  # to table and robot, and below the blade's clearance, at which a moment begins to count


@pytree
class Played:
    """Measures of episodes (L,): cost is to be small.

    substep: of the hit, or of the nearest moment; ends: control periods up to it
    steps: control periods of the episode, of a miss until the ball is out of play
    faults: of these, how many have a contact, a low blade, bad style, added up
    observations, seen: what the policy acted on up to ``ends``
    """

    cost: Float[Array, " L"]
    hit: Bool[Array, " L"]
    returned: Bool[Array, " L"]
    substep: Int[Array, " L"]
    ends: Int[Array, " L"]
    steps: Int[Array, " L"]
    faults: Float[Array, " L"]
    observations: Float[Array, "T observed L"]
    seen: Bool[Array, "T L"]


class Objective:
    """The smooth measure for one task.

    ticks: control periods that are looked at; a ball that takes longer counts as it stands
    """

    def __init__(self, task: Task, ticks: int) -> None:
        self.task, self.ticks = task, ticks
        self._servos = Servos(task)
        self._weights = dict(zip(task.config.terms, task.config.reward_weights, strict=True))

    def play(self, policy: Policy, episodes: Episodes) -> Played:
        """Plays P policies, theta (size, P), on episodes (L,), L = R x P with P the faster index."""
        task, params = self.task, episodes.model.ball
        constants = task.prepare(episodes)
        ball = jax.lax.stop_gradient(fly_incoming(task, episodes, constants, self.ticks))
        moving = simulate_motion(task, self._servos, differentiable(policy), episodes, constants, ball)
        met = find_meeting(task, moving, ball, params)
        ends, steps = (substep // task.config.substeps + 1 for substep in (met.substep, met.last))
        worst, times, done = self._worst(moving, steps)
        # Three moments in one: what has derivatives is compiled once.
        substeps = jnp.stack([met.substep, met.substep + 1, worst])
        joints, velocities = (_take(x, substeps) for x in (moving.joints, moving.velocities))
        before, after, then = _split(task.kinematics.pose(joints, velocities))
        struck = simulate_strike(met, ball, params, (before, after), 1.0 / task.config.sim_rate)
        out = find_landing(params, struck.ball)
        faults = times * self._weighted(self._shortfalls(joints[:, 2], then))
        cost = _play_cost(met, struck, out) + self._steadiness(moving, ends) + jnp.log1p(faults)
        seen = jnp.arange(self.ticks)[:, None] < ends[None]
        returned = met.hit & _inside(out)
        return Played(cost, met.hit, returned, met.substep, ends, steps, done, moving.observations, seen)

    def _steadiness(self, moving: Motion, ends: Array) -> Array:
        """The rewards' terms of jerk, acceleration and velocity of the commands until the hit."""
        limits, period = self.task.contract.limits, self.task.config.period
        before = jnp.concatenate([jnp.zeros_like(moving.commands[:1]), moving.commands[:-1]])
        acceleration = (moving.commands - before) / period
        earlier = jnp.concatenate([jnp.zeros_like(acceleration[:1]), acceleration[:-1]])
        jerk = (acceleration - earlier) / period
        counted = (jnp.arange(self.ticks)[:, None] < ends[None]).astype(jerk.dtype) / ends[None].astype(jerk.dtype)
        most = {"velocity": limits.velocity, "acceleration": limits.acceleration}
        most["jerk"] = tuple(2.0 * a / period for a in limits.acceleration)
        values = {"velocity": moving.commands, "acceleration": acceleration, "jerk": jerk}
        total = jnp.zeros_like(counted[0])
        for name, value in values.items():
            share = jnp.minimum(jnp.abs(value) / jnp.asarray(most[name], value.dtype)[None, :, None], 1.0).mean(1)
            total = total + self._weights[name] * (share * counted).sum(0)
        return total

    def _worst(self, moving: Motion, steps: Array) -> tuple[Int[Array, " L"], Float[Array, " L"], Float[Array, " L"]]:
        """The substep of the worst moment at the end of an episode's control periods, how many come near a fault, and
        how many faults there are."""
        every = self.task.config.substeps
        joints, velocities = (
            jax.lax.stop_gradient(jnp.moveaxis(x[every::every], 1, 0)) for x in (moving.joints, moving.velocities)
        )
        counted = jnp.arange(self.ticks)[:, None] < steps[None]
        table, own, blade, facing = self._shortfalls(joints, self.task.kinematics.pose(joints, velocities))
        near = jnp.where(counted, self._weighted((table, own, blade, facing)), 0.0)
        done = sum((counted & (short > 1.0)).sum(0) for short in (jnp.maximum(table, own), blade, facing))
        dtype = near.dtype
        return (jnp.argmax(near, 0) + 1) * every, (near > 0.0).sum(0).astype(dtype), jnp.asarray(done, dtype)

    def _shortfalls(self, joints: Joints, blade: PaddlePose) -> tuple[Array, Array, Array, Array]:
        """Shortfalls of a moment (...): of a margin to the table, among the links, under and behind the blade.

        From 0, with a margin, to 1 where the rewards count a fault, and on.
        """
        gaps = self.task.clearance(self.task.kinematics.links(joints), joints[0])
        wanted = ((gaps.table, 0.0), (gaps.own, 0.0), (gaps.blade, BLADE_CLEARANCE))
        table, own, low = (jax.nn.relu(least + MARGIN - gap) / MARGIN for gap, least in wanted)
        return table, own, low, jax.nn.relu(1.0 + (FACING - blade.normal[1]) / FACING_MARGIN)

    def _weighted(self, shortfalls: tuple[Array, Array, Array, Array]) -> Array:
        """By the weights of the rewards that count them."""
        names = ("collision", "collision", "paddle_height", "style")
        terms = (self._weights[name] * short for name, short in zip(names, shortfalls, strict=True))
        return sum(terms, jnp.zeros_like(shortfalls[0]))


def _take(x: Float[Array, "S+1 n L"], substeps: Int[Array, "k L"]) -> Float[Array, "n k L"]:
    """Values at k substeps of each episode."""
    found = jnp.take_along_axis(x, jnp.broadcast_to(substeps[:, None], (substeps.shape[0], *x.shape[1:])), 0)
    return jnp.moveaxis(found, 1, 0)


def _split(poses: PaddlePose) -> list[PaddlePose]:
    """Poses (3, k, L) as k poses (3, L)."""
    return [jax.tree.map(lambda x, i=i: x[:, i], poses) for i in range(poses.position.shape[1])]


def _play_cost(met: Meeting, struck: Strike, out: Landing) -> Array:
    """Nearing the ball, and where it goes."""
    near = jnp.log1p(struck.distance / NEAR**2)
    wide, long_ = (jax.nn.relu(jnp.abs(out.position[i] - TARGET[i]) - INSIDE[i]) / BEYOND for i in (0, 1))
    low = jax.nn.relu(HIGH - out.height) / LOW
    aim = jnp.log1p(wide**2 + long_**2) + jnp.where(out.crossed, jnp.log1p(low**2), NO_CROSSING)
    told = jnp.where(met.hit, 1.0, jax.lax.stop_gradient(1.0 / (1.0 + struck.distance / FAR**2)))
    return jnp.where(met.playable, near + told * aim, 0.0)


def _inside(out: Landing) -> Array:
    """Over the net and on the human's half."""
    x, y = out.position
    table = (jnp.abs(x) <= c.TABLE_WIDTH / 2) & (y > 0.0) & (y <= c.TABLE_LENGTH / 2)
    return out.crossed & out.down & (out.height > c.NET_HEIGHT + c.BALL_DIAMETER / 2) & table
