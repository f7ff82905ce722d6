"""Evaluation of policies of every kind alike: the same balls, without exploration, also in a world never trained in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from experiments.evaluation import evaluate
from mjx_tt.env.episode import Controller, Episodes
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim.model import ModelFile

ROWS, COLUMNS = 2, 256  # episodes of one compiled call
PROGRESS = ("return_rate", "low", "high", "hit_rate", "mean_return")


class World:
    """Plays controllers under one simulation model. A controller of another kind is compiled anew.

    Args:
        task: at the evaluation's rate.
        model: the simulation's parameters and what is randomised around them.
    """

    def __init__(self, task: TaskConfig, model: ModelFile) -> None:
        self._simulator, self._model = Simulator(task, 1), model
        self._play = jax.jit(lambda controller, *given: self._simulator.play(controller, self.draw(*given)))

    def play(self, controller: Controller, balls: BallPool, key: jax.Array) -> RolloutResult:
        """Every ball of ``draw_balls`` once; NumPy arrays (..., R, P)."""
        chunks = _chunks(balls)
        keys = jax.random.split(key, len(chunks))
        parts = [jax.tree.map(np.asarray, self._play(controller, *given)) for given in zip(chunks, keys, strict=True)]
        episodes = [replace(part, observation_sums=0.0, observation_counts=0) for part in parts]
        return jax.tree.map(lambda *x: np.concatenate(x, axis=-2) if np.ndim(x[0]) else x[0], *episodes)

    def draw(self, balls: BallPool, key: jax.Array) -> Episodes:
        """Episodes of a chunk's balls in their order, with their own spin and the one that the world gives them."""
        model = self._model
        drawn = self._simulator.draw(key, balls.without_spin(), model.model, model.randomise, ROWS, COLUMNS)
        thrown = jax.tree.map(lambda x: x.reshape(-1, ROWS, COLUMNS), balls.state)
        return replace(drawn, ball=replace(thrown, spin=thrown.spin + drawn.ball.spin))


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
        """Per world the summary of ``evaluate``."""
        return {
            name: evaluate.summary(world.play(controller, self._balls, self._key))
            for name, world in self._worlds.items()
        }


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
