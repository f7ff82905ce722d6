"""The task as a brax environment: one control step per step, for learners that look inside an episode.

Batches are native: the keys given to ``reset`` decide the batch axes (B,), which stand last inside and first in what
brax sees. A finished episode is followed at once by another one with a fresh ball, so no wrapper of brax is needed;
those that repeat the first episode would train on one ball per place.

Rewards. R(t) is the task's weighted return of an episode that stopped after control step t, the ball not yet flown out;
the reward of a step is R(t) - R(t - 1), and at the last step R holds what became of the ball. An episode's rewards
therefore add up to the return that ``rollout.Simulator`` computes, whatever its terms: counts such as collisions are
paid when they happen, nearing the ball as it is neared, means over the steps as they move.
"""

from __future__ import annotations

import contextlib
import io
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ballmodel.sampling import BallPool
from mjx_tt.env.episode import Episodes, EpisodeState, FixedAction, Return, reshape_episodes
from mjx_tt.env.return_flight import fly_return
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import add_weighted, evaluate_rewards
from mjx_tt.pytrees import pytree
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Randomised
from robot_io.contract import HISTORY, N_OBSERVATION

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that Warp, an optional engine, is not installed
    from brax.envs import register_environment as register_environment
    from brax.envs.base import Env, State

T = TypeVar("T")

OBSERVATION_SIZE = HISTORY * N_OBSERVATION  # of the paper's robot
FEWEST_FLOWN = 16  # balls flown out together, at least


@pytree
class EnvState:
    """State of an environment between steps; batch axes last."""

    tick: Int[Array, ""]  # common to the batch: where its rings stand
    key: PRNGKeyArray  # of the episodes to come
    episodes: Episodes
    state: EpisodeState
    history: Float[Array, "8 observed *batch"]  # observations, oldest first
    earned: Float[Array, "*batch"]  # R so far


class TableTennis(Env):
    """Episodes of one simulator on balls of a pool, as ``Simulator.draw`` draws them.

    Observation (..., 88): the last eight observations of the contract, oldest first, not normalised. Action (..., 8) in
    [-1, 1]. ``done`` is 1 at the step that decided the episode; the state is then already that of the next one.
    ``metrics`` at such a step, 0 at others: "hit" and "returned", 1 where the ball was, and "episode_return". Nothing
    is ever truncated: an episode that reaches ``max_steps`` is over, as in the simulator.
    """

    def __init__(
        self, simulator: Simulator, pool: BallPool, model: SimModel, randomise: tuple[Randomised, ...] = ()
    ) -> None:
        self._simulator, self._pool, self._model, self._randomise = simulator, pool, model, randomise
        self._task = simulator.task
        self._unseen = jnp.zeros(self._task.config.n_observation)

    @property
    def observation_size(self) -> int:
        return HISTORY * self._task.config.n_observation

    @property
    def action_size(self) -> int:
        return self._task.contract.n_joints

    @property
    def backend(self) -> str:
        return self._task.config.engine

    def reset(self, rng: Array) -> State:
        """``rng``: one key, or keys (B,); raw ones have a last axis of their own."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        batch = rng.shape if typed else rng.shape[:-1]
        first = rng.reshape(-1)[0] if typed else rng.reshape(-1, rng.shape[-1])[0]
        draw_key, key = jax.random.split(first)
        return self.begin(self.draw(draw_key, batch), key)

    def draw(self, key: PRNGKeyArray, batch: tuple[int, ...]) -> Episodes:
        """Fresh episodes of the batch shape."""
        drawn = self._simulator.draw(key, self._pool, self._model, self._randomise, 1, int(np.prod(batch)))
        return reshape_episodes(drawn, *batch)

    def begin(self, episodes: Episodes, key: PRNGKeyArray) -> State:
        """The state before the first step of given episodes (...); ``key`` is for those that follow."""
        state, tick = self._start(episodes), jnp.int32(0)
        seen = self._task.observe(tick, state, episodes, self._task.prepare(episodes))
        history = jnp.broadcast_to(seen, (HISTORY, *seen.shape))
        zero = jnp.zeros(episodes.seed.shape)
        playing = EnvState(tick, key, episodes, state, history, zero)
        metrics = {"hit": zero, "returned": zero, "episode_return": zero}
        return State(playing, flatten(history), zero, zero, metrics, {"truncation": zero})

    def step(self, state: State, action: Float[Array, "*batch joints"]) -> State:
        """One control period under ``action`` (..., 8)."""
        task, playing = self._task, state.pipeline_state
        episodes, before = playing.episodes, playing.state
        controller = FixedAction(jnp.clip(jnp.moveaxis(action, -1, 0), -1.0, 1.0), self._unseen)
        after = task.step(playing.tick, before, episodes, task.prepare(episodes), controller)
        done = ~after.live | (after.accumulators.steps >= task.config.max_steps)
        back = self._fly_return(after, done & after.hit & after.finite, episodes)
        rewards = task.config.rewards
        earned = add_weighted(rewards, evaluate_rewards(rewards, after, back))
        finite = after.finite & jnp.isfinite(earned)
        reward = jnp.where(finite, earned - playing.earned, 0.0)
        metrics = {
            "hit": (done & finite & after.hit).astype(reward.dtype),
            "returned": (finite & back.returned).astype(reward.dtype),
            "episode_return": jnp.where(done & finite, earned, 0.0),
        }

        next_key, key = jax.random.split(playing.key)
        fresh = self.draw(next_key, done.shape)
        episodes = _where(done, fresh, episodes)
        started = _where(done, self._start(episodes), after)
        tick = playing.tick + 1
        seen = task.observe(tick, started, episodes, task.prepare(episodes))
        history = jnp.where(done, seen, jnp.concatenate([playing.history[1:], seen[None]]))
        playing = EnvState(tick, key, episodes, started, history, jnp.where(done, 0.0, earned))
        return state.replace(
            pipeline_state=playing,
            obs=flatten(history),
            reward=reward,
            done=done.astype(reward.dtype),
            metrics=state.metrics | metrics,
        )

    def _start(self, episodes: Episodes) -> EpisodeState:
        return self._task.reset(episodes, FixedAction(jnp.zeros(self.action_size), self._unseen))

    def _fly_return(self, state: EpisodeState, hit: Bool[Array, "*batch"], episodes: Episodes) -> Return:
        """Outcome of the balls that were hit in this step.

        Few of a batch are at any one step: they are gathered, some at a time, until none is left.
        """
        task, ball, batch = self._task, state.ball, hit.shape
        width = max(FEWEST_FLOWN, batch[0] // 16) if len(batch) == 1 else 0
        if width == 0 or width >= batch[0]:
            return fly_return(task.config, ball, hit, episodes.model)

        def fly_some(carry: tuple[Array, Return]) -> tuple[Array, Return]:
            left, back = carry
            index = jnp.nonzero(left, size=width, fill_value=batch[0])[0]
            some, model = jax.tree.map(lambda x: x[..., index] if x.ndim else x, (ball, episodes.model))
            part = fly_return(task.config, some, index < batch[0], model)
            back = jax.tree.map(lambda x, new: x.at[..., index].set(new, mode="drop"), back, part)
            return left.at[index].set(False, mode="drop"), back

        return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), fly_some, (hit, Return.nowhere(ball)))[1]


def flatten(history: Float[Array, "8 observed *batch"]) -> Float[Array, "*batch size"]:
    """A network's input: the history as one axis, last."""
    return jnp.moveaxis(history.reshape(-1, *history.shape[2:]), 0, -1)


def _where(done: Array, fresh: T, old: T) -> T:
    """Of each leaf (..., B) the fresh entry where an episode is done; scalars of a batch are shared by its episodes."""
    return jax.tree.map(lambda x, y: jnp.where(done, x, y) if x.ndim >= done.ndim else y, fresh, old)
