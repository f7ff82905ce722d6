"""A lower bound on what can be returned: motions optimised ball by ball.

For every ball the cross-entropy method (Rubinstein 1999) searches an open-loop motion, joint velocities at a few knots
with straight lines between them, through the same episodes as training: actuation limits and delays included, but
without observation noise and with the whole future known. A ball that it returns can be returned; one that it misses may
still be returned by a better motion, so the rate is a lower bound on the best, and no policy is promised to reach it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.pool import BallPool
from mjx_tt.model import SimModel
from mjx_tt.rollout import AXIS, Simulator
from mjx_tt.task import RETURNED
from robot_io.contract import N_JOINTS, N_OBSERVATION

KNOTS = 5
LONGEST = 1.5  # [s] after which a motion repeats its last knot
CANDIDATES = 128  # motions per ball and iteration
ELITES = 12
ITERATIONS = 50
FIRST_STD = 0.5  # of an action


@dataclass(frozen=True)
class MotionController:
    """Open-loop motions: knots (KNOTS, 8, P) of actions, evenly spaced over ``duration`` (P,) seconds."""

    knots: jax.Array
    duration: jax.Array
    period: float
    mean: jax.Array

    def start(self, observation):
        return ()

    def act(self, tick, state, observation):
        place = jnp.clip(tick * self.period / self.duration, 0.0, 1.0) * (KNOTS - 1)
        action = sum(jnp.maximum(1.0 - jnp.abs(place - i), 0.0) * self.knots[i] for i in range(KNOTS))
        return jnp.clip(action, -1.0, 1.0), state


@dataclass(frozen=True)
class Reachable:
    """``returned`` of ``balls`` balls by optimised motions; a lower bound of the reachable return rate."""

    returned: int
    balls: int

    @property
    def rate(self) -> float:
        return self.returned / self.balls


def reachable(simulator: Simulator, pool: BallPool, model: SimModel, key, balls: int = 128) -> Reachable:
    """Optimises a motion for each of ``balls`` balls drawn from the pool. About a minute for 128 balls on two cores."""
    if balls < 1:
        raise ValueError(f"balls is {balls}, at least 1 is needed")
    balls = -(-balls // simulator.devices) * simulator.devices
    spread = simulator.on_devices(partial(_search, simulator, balls, model), out_specs=jax.sharding.PartitionSpec(None))
    found = jax.jit(spread)(key, simulator.replicate(pool))
    return Reachable(int(np.asarray(found).sum()), balls)


def _search(simulator: Simulator, balls: int, model: SimModel, key, pool: BallPool):
    draw_key, search_key = jax.random.split(key)
    quiet = replace(model, sensing=replace(model.sensing, ball_noise=0.0))
    episodes = simulator.local(simulator.draw(draw_key, pool, quiet, (), 1, balls))
    mine = episodes.seed.shape[-1]
    search_key = jax.random.fold_in(search_key, jax.lax.axis_index(AXIS))

    def spread(x):  # (..., 1, balls) -> (..., 1, CANDIDATES x balls)
        return jnp.tile(x, CANDIDATES) if x.ndim >= 2 else x

    many = jax.tree.map(spread, episodes)
    # The ball's speed along the table tells when it is there: 1.4 covers drag and the bounce.
    flight_time = 1.4 * (episodes.ball.position[1] + 1.8) / -episodes.ball.velocity[1]
    duration = jnp.minimum(flight_time[0] + 0.1, LONGEST)

    def searching(carry):
        iteration, _, _, solved = carry
        return (iteration < ITERATIONS) & ~jnp.all(solved)

    def iterate(carry):
        iteration, mean, std, solved = carry
        noise = jax.random.normal(jax.random.fold_in(search_key, iteration), (KNOTS, N_JOINTS, CANDIDATES, mine))
        knots = mean[:, :, None] + std[:, :, None] * noise
        knots = jnp.clip(knots, -1.0, 1.0).at[:, :, 0].set(mean)
        controller = MotionController(
            knots.reshape(KNOTS, N_JOINTS, -1), jnp.tile(duration, CANDIDATES), simulator.config.period,
            jnp.zeros(N_OBSERVATION),
        )  # fmt: skip
        result = simulator.play(controller, many)
        score = jnp.nan_to_num(result.returns, nan=-1e3).reshape(CANDIDATES, mine)
        returned = (result.outcome == RETURNED).reshape(CANDIDATES, mine)
        _, elite = jax.lax.top_k(score.T, ELITES)  # (mine, ELITES)
        chosen = jnp.take_along_axis(knots, elite.T[None, None], axis=2)
        mean, std = chosen.mean(axis=2), chosen.std(axis=2) + 0.02
        return iteration + 1, mean, std, solved | returned.any(axis=0)

    knots = (KNOTS, N_JOINTS, mine)
    start = (jnp.int32(0), jnp.zeros(knots), jnp.full(knots, FIRST_STD), jnp.zeros(mine, bool))
    *_, solved = jax.lax.while_loop(searching, iterate, start)
    return jax.lax.all_gather(solved, AXIS, tiled=True)
