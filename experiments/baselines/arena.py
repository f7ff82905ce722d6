"""Comparison of finished and half-finished policies of every kind: the same balls, frozen, without exploration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from mjx_tt.env.episode import Controller, Episodes, EpisodeState, Tick, reshape_episodes
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import ModelFile

ROWS, COLUMNS = 2, 256  # episodes of one compiled call
Carry = tuple[EpisodeState, jax.Array, jax.Array]  # of a scan: state, sum of changes, their number


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Remembered:
    """A controller whose state also keeps its last action (8, ...)."""

    inner: Controller
    mean: jax.Array

    def start(self, observation: jax.Array) -> tuple[Any, jax.Array]:
        return self.inner.start(observation), observation[3:]  # of the action's shape, before there is one

    def act(
        self, tick: Tick, state: tuple[Any, jax.Array], observation: jax.Array
    ) -> tuple[jax.Array, tuple[Any, jax.Array]]:
        action, inner = self.inner.act(tick, state[0], observation)
        return action, (inner, action)


class Arena:
    """Plays controllers in one world. A controller of another kind is compiled anew, a retrained one is not.

    task: at the evaluation's rate; world: the simulation's parameters and what is randomised around them.
    """

    def __init__(self, task: TaskConfig, world: ModelFile) -> None:
        self._simulator, self._world = Simulator(task, 1), world
        self._play = jax.jit(self._play_chunk)
        self._restless = jax.jit(self._action_change)

    def play(self, controller: Controller, balls: BallPool, key: jax.Array) -> RolloutResult:
        """Every ball of ``balls`` (``draw_balls``) once; NumPy arrays (..., R, P)."""
        chunks = _chunks(balls)
        keys = jax.random.split(key, len(chunks))
        parts = [jax.tree.map(np.asarray, self._play(controller, *given)) for given in zip(chunks, keys, strict=True)]
        episodes = [replace(part, observation_sums=0.0, observation_counts=0) for part in parts]
        return jax.tree.map(lambda *x: np.concatenate(x, axis=-2) if np.ndim(x[0]) else x[0], *episodes)

    def action_change(self, controller: Controller, balls: BallPool, key: jax.Array) -> float:
        """Mean square change of an action between control steps, each velocity relative to its limit."""
        return float(self._restless(controller, _chunks(balls)[0], key))

    def _draw(self, balls: BallPool, key: jax.Array) -> Episodes:
        """The chunk's balls in their order, with their own spin and the one that the world gives them."""
        drawn = self._simulator.draw(key, balls.without_spin(), self._world.model, self._world.randomise, ROWS, COLUMNS)
        thrown = jax.tree.map(lambda x: x.reshape(-1, ROWS, COLUMNS), balls.state)
        return replace(drawn, ball=replace(thrown, spin=thrown.spin + drawn.ball.spin))

    def _play_chunk(self, controller: Controller, balls: BallPool, key: jax.Array) -> RolloutResult:
        return self._simulator.play(controller, self._draw(balls, key))

    def _action_change(self, controller: Controller, balls: BallPool, key: jax.Array) -> jax.Array:
        task, episodes = self._simulator.task, self._draw(balls, key)
        episodes = reshape_episodes(episodes, -1)
        constants, remembered = task.prepare(episodes), Remembered(controller, controller.mean)

        def advance(carry: Carry, tick: Tick) -> tuple[Carry, None]:
            state, total, count = carry
            after = task.step(tick, state, episodes, constants, remembered)
            counted = (state.live & (tick > 0)).astype(total.dtype)
            change = jnp.mean((after.controller[1] - state.controller[1]) ** 2, axis=0)
            return (after, total + jnp.sum(counted * change), count + jnp.sum(counted)), None

        start = (task.reset(episodes, remembered), jnp.zeros(()), jnp.zeros(()))
        (_, total, count), _ = jax.lax.scan(advance, start, jnp.arange(task.config.max_steps, dtype=jnp.int32))
        return total / count


def draw_balls(experiment: Experiment, key: jax.Array, episodes: int) -> BallPool:
    """At least ``episodes`` balls, up to whole calls, in the order of their arrival: similar ones play together."""
    size = ROWS * COLUMNS
    balls = build.pool(experiment, key, -(-episodes // size) * size)
    order = np.argsort(np.asarray(balls.arrival))
    return replace(
        balls,
        state=jax.tree.map(lambda x: x[:, order], balls.state),
        arrival=balls.arrival[order],
        landing=balls.landing[:, order],
    )


def _chunks(balls: BallPool) -> list[BallPool]:
    n = balls.arrival.shape[0] // (ROWS * COLUMNS)
    return [_cut(balls, slice(i * ROWS * COLUMNS, (i + 1) * ROWS * COLUMNS)) for i in range(n)]


def _cut(balls: BallPool, part: slice) -> BallPool:
    state = jax.tree.map(lambda x: x[:, part], balls.state)
    return replace(balls, state=state, arrival=balls.arrival[part], landing=balls.landing[:, part])
