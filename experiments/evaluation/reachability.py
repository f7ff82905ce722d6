"""A lower bound on what can be returned: motions optimised ball by ball.

For every ball the cross-entropy method (Rubinstein 1999) searches an open-loop motion, joint velocities at a few knots
with straight lines between them, through the same episodes as training: actuation limits and delays included, but
without observation noise and with the whole future known. What a policy at hand returns under the same conditions
needs no search. A ball that is returned either way can be returned; one that is missed may still be returned by a
better motion, so the rate is a lower bound on the best, and no policy is promised to reach it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PRNGKeyArray

from ballmodel.sampling import BallPool
from mjx_tt.env.episode import RETURNED, Episodes, Tick
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import AXIS, RESULT_SPECS, RolloutResult, Simulator
from mjx_tt.sim.model import SimModel

BATCH = 32  # balls searched at a time
KNOTS = 5
LONGEST = 1.5  # [s] after which a motion repeats its last knot
CANDIDATES = 256  # motions per ball and iteration
ELITES = 24
ITERATIONS = 150
FIRST_STD = 0.5  # of an action


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionController:
    """Open-loop motions: knots (KNOTS, 8, P) of actions, evenly spaced over ``duration`` (1, P) seconds."""

    knots: Array  # (KNOTS, n, P)
    duration: Array  # (1, P) [s]
    period: float = field(metadata={"static": True})  # [s]
    mean: Array  # (observed,)

    def start(self, observation: Array) -> tuple[()]:
        return ()

    def act(self, tick: Tick, state: tuple[()], observation: Array) -> tuple[Array, tuple[()]]:
        seconds = jnp.asarray(tick).astype(self.duration.dtype) * self.period
        place = jnp.clip(seconds / self.duration[0], 0.0, 1.0) * (KNOTS - 1)
        action = jnp.zeros_like(self.knots[0])
        for i in range(KNOTS):
            action = action + jnp.maximum(1.0 - jnp.abs(place - i), 0.0)[None] * self.knots[i]
        return jnp.clip(action, -1.0, 1.0), state


@dataclass(frozen=True)
class Reachable:
    """``returned`` of ``balls`` balls, ``by_policy`` of them by the policy and the others by optimised motions."""

    returned: int
    balls: int
    by_policy: int

    @property
    def rate(self) -> float:
        return self.returned / self.balls


def reachable(
    simulator: Simulator,
    pool: BallPool,
    model: SimModel,
    key: PRNGKeyArray,
    balls: int = 128,
    policy: Policy | None = None,
) -> Reachable:
    """A lower bound of the return rate on balls of the pool: optimises a motion for each that the policy misses.

    policy: one policy, whose misses are searched; None: every ball is searched.
    About 20 s on two cores for every ``BATCH`` balls that are searched. Raises ValueError for less than one ball.
    """
    if balls < 1:
        raise ValueError(f"balls is {balls}, at least 1 is needed")
    balls = -(-balls // simulator.devices) * simulator.devices
    quiet = replace(model, sensing=replace(model.sensing, ball_noise=0.0))
    draw_key, search_key = jax.random.split(key)
    episodes = jax.jit(lambda key, pool: simulator.draw(key, pool, quiet, (), 1, balls))(draw_key, pool)
    found = np.zeros(balls, bool) if policy is None else _played(simulator, policy, episodes)
    by_policy = int(found.sum())
    missed = np.flatnonzero(~found)
    search = jax.jit(simulator.on_devices(partial(_search, simulator), out_specs=jax.sharding.PartitionSpec(AXIS)))
    batch = -(-BATCH // simulator.devices) * simulator.devices  # one size, one compilation
    for start in range(0, missed.size, batch):
        chosen = np.resize(missed[start : start + batch], batch)
        some = jax.tree.map(partial(_taken, chosen), episodes)
        found[chosen] = simulator.gather(search(*simulator.replicate((jax.random.fold_in(search_key, start), some))))
    return Reachable(int(found.sum()), balls, by_policy)


def _taken(index: np.ndarray, x: Array) -> Array:
    return x[..., index] if x.ndim >= 2 else x


def _played(simulator: Simulator, policy: Policy, episodes: Episodes) -> np.ndarray:
    """True for those of the episodes (1, P) that the policy returns: (P,)."""

    def play(policy: Policy, episodes: Episodes) -> RolloutResult:
        mine = simulator.local(episodes)
        copies = jnp.repeat(policy.theta[:, None], mine.seed.shape[-1], axis=1)
        return simulator.rollout(replace(policy, theta=copies), mine)

    spread = jax.jit(simulator.on_devices(play, out_specs=RESULT_SPECS))
    return simulator.gather(spread(*simulator.replicate((policy, episodes))).outcome)[0] == RETURNED


def _search(simulator: Simulator, key: PRNGKeyArray, episodes: Episodes) -> Array:
    """True (P,) for those of this device's share of episodes (1, P) that an optimised motion returns."""
    episodes = simulator.local(episodes)
    mine, contract = episodes.seed.shape[-1], simulator.task.contract
    n = contract.n_joints
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))

    def spread(x: Array) -> Array:  # (..., 1, balls) -> (..., 1, CANDIDATES x balls)
        return jnp.tile(x, CANDIDATES) if x.ndim >= 2 else x

    many = jax.tree.map(spread, episodes)
    # The ball's speed along the table tells when it is there: 1.4 covers drag and the bounce.
    flight_time = 1.4 * (episodes.ball.position[1] + 1.8) / -episodes.ball.velocity[1]
    duration = jnp.minimum(flight_time[0] + 0.1, LONGEST)

    def searching(carry: tuple[Array, Array, Array, Array]) -> Array:
        iteration, _, _, solved = carry
        return (iteration < ITERATIONS) & ~jnp.all(solved)

    def iterate(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        iteration, mean, std, solved = carry
        noise = jax.random.normal(jax.random.fold_in(key, iteration), (KNOTS, n, CANDIDATES, mine))
        knots = mean[:, :, None] + std[:, :, None] * noise
        knots = jnp.clip(knots, -1.0, 1.0).at[:, :, 0].set(mean)
        controller = MotionController(
            knots.reshape(KNOTS, n, -1),
            jnp.tile(duration, CANDIDATES)[None],
            simulator.config.period,
            jnp.zeros(simulator.config.n_observation),
        )
        result = simulator.play(controller, many)
        score = jnp.nan_to_num(result.returns, nan=-1e3).reshape(CANDIDATES, mine)
        returned = (result.outcome == RETURNED).reshape(CANDIDATES, mine)
        _, elite = jax.lax.top_k(score.T, ELITES)  # (mine, ELITES)
        chosen = jnp.take_along_axis(knots, elite.T[None, None], axis=2)
        mean, std = chosen.mean(axis=2), chosen.std(axis=2) + 0.02
        return iteration + 1, mean, std, solved | returned.any(axis=0)

    knots = (KNOTS, n, mine)
    start = (jnp.int32(0), jnp.zeros(knots), jnp.full(knots, FIRST_STD), jnp.zeros(mine, bool))
    *_, solved = jax.lax.while_loop(searching, iterate, start)
    return solved
