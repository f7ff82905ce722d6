"""Evaluation of policies of every kind alike: the same balls, without exploration, also in a world never trained in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from experiments.evaluation import evaluate
from mjx_tt.env.episode import Controller, Episodes, EpisodeState, Tick, reshape_episodes
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import ModelFile

ROWS, COLUMNS = 2, 256  # episodes of one compiled call
LIMITED = ("velocity", "acceleration", "jerk")  # reward terms: 1 - mean over joints and steps of |value| / limit
PROGRESS = ("return_rate", "low", "high", "hit_rate", "mean_return")

Carry = tuple[EpisodeState, jax.Array, jax.Array]  # of a scan: state, sum of changes, their number


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LastAction:
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


class World:
    """Plays controllers under one simulation model. A controller of another kind is compiled anew.

    Args:
        task: at the evaluation's rate.
        model: the simulation's parameters and what is randomised around them.
    """

    def __init__(self, task: TaskConfig, model: ModelFile) -> None:
        self._simulator, self._model = Simulator(task, 1), model
        self._play = jax.jit(lambda controller, *given: self._simulator.play(controller, self.draw(*given)))
        self._change = jax.jit(self._action_change)

    def play(self, controller: Controller, balls: BallPool, key: jax.Array) -> RolloutResult:
        """Every ball of ``draw_balls`` once; NumPy arrays (..., R, P)."""
        chunks = _chunks(balls)
        keys = jax.random.split(key, len(chunks))
        parts = [jax.tree.map(np.asarray, self._play(controller, *given)) for given in zip(chunks, keys, strict=True)]
        episodes = [replace(part, observation_sums=0.0, observation_counts=0) for part in parts]
        return jax.tree.map(lambda *x: np.concatenate(x, axis=-2) if np.ndim(x[0]) else x[0], *episodes)

    def action_change(self, controller: Controller, balls: BallPool, key: jax.Array) -> float | None:
        """Mean square change of an action between control steps, each velocity relative to its limit."""
        change = float(self._change(controller, self.draw(_chunks(balls)[0], key)))
        return change if math.isfinite(change) else None

    def draw(self, balls: BallPool, key: jax.Array) -> Episodes:
        """Episodes of a chunk's balls in their order, with their own spin and the one that the world gives them."""
        model = self._model
        drawn = self._simulator.draw(key, balls.without_spin(), model.model, model.randomise, ROWS, COLUMNS)
        thrown = jax.tree.map(lambda x: x.reshape(-1, ROWS, COLUMNS), balls.state)
        return replace(drawn, ball=replace(thrown, spin=thrown.spin + drawn.ball.spin))

    def _action_change(self, controller: Controller, episodes: Episodes) -> jax.Array:
        task, episodes = self._simulator.task, reshape_episodes(episodes, -1)
        constants, last = task.prepare(episodes), LastAction(controller, controller.mean)

        def advance(carry: Carry, tick: Tick) -> tuple[Carry, None]:
            state, total, count = carry
            after = task.step(tick, state, episodes, constants, last)
            counted = (state.live & (tick > 0)).astype(total.dtype)
            change = jnp.mean((after.controller[1] - state.controller[1]) ** 2, axis=0)
            return (after, total + jnp.sum(counted * change), count + jnp.sum(counted)), None

        start = (task.reset(episodes, last), jnp.zeros(()), jnp.zeros(()))
        (_, total, count), _ = jax.lax.scan(advance, start, jnp.arange(task.config.max_steps, dtype=jnp.int32))
        return total / count


class Judge:
    """Evaluations of a comparison: on the way in simulation, in the end there and in ``reality``."""

    def __init__(self, experiment: Experiment, reality: ModelFile, progress_episodes: int) -> None:
        training, evaluation = experiment.config.training, experiment.config.evaluation
        task = replace(experiment.task, sim_rate=evaluation.sim_rate or experiment.task.sim_rate)
        self._worlds = {"simulation": World(task, experiment.model), "reality": World(task, reality)}
        self._progress_key = build.key(training.seed, build.PROGRESS_EPISODES)
        progress_key = build.key(training.seed, build.PROGRESS_BALLS)
        self._progress_balls = draw_balls(experiment, progress_key, progress_episodes)
        self._key = build.key(evaluation.seed, build.EVALUATION_EPISODES)
        self._balls = draw_balls(experiment, build.key(evaluation.seed, build.EVALUATION_BALLS), evaluation.episodes)

    def progress(self, controller: Controller) -> dict[str, Any]:
        """Rates and mean return of a point of the curve."""
        result = self._worlds["simulation"].play(controller, self._progress_balls, self._progress_key)
        summary = evaluate.summary(result)
        return {name: summary[name] for name in PROGRESS}

    def final(self, controller: Controller) -> dict[str, Any]:
        """Per world the summary of ``evaluate``, and how restless the motion is in simulation."""
        found = {
            name: evaluate.summary(world.play(controller, self._balls, self._key))
            for name, world in self._worlds.items()
        }
        terms = found["simulation"]["terms"]
        restless = {name: None if terms[name] is None else 1.0 - terms[name] for name in LIMITED}
        change = self._worlds["simulation"].action_change(controller, self._balls, self._key)
        return found | {"restlessness": {"action_change": change} | restless}


def draw_balls(experiment: Experiment, key: jax.Array, episodes: int) -> BallPool:
    """At least ``episodes`` balls, up to whole calls, in the order of their arrival: similar ones play together."""
    size = ROWS * COLUMNS
    balls = build.pool(experiment, key, -(-episodes // size) * size)
    return _pick(balls, np.argsort(np.asarray(balls.arrival)))


def _chunks(balls: BallPool) -> list[BallPool]:
    count = balls.arrival.shape[0]
    return [_pick(balls, part) for part in np.split(np.arange(count), count // (ROWS * COLUMNS))]


def _pick(balls: BallPool, chosen: np.ndarray) -> BallPool:
    state = jax.tree.map(lambda x: x[:, chosen], balls.state)
    return replace(balls, state=state, arrival=balls.arrival[chosen], landing=balls.landing[:, chosen])
