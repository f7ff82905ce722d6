"""Blackbox Gradient Sensing and ARS: the strategies of ``bgs`` on the compiled update of training."""

from __future__ import annotations

import jax

from bgs import normalizer
from experiments.baselines.learner import Advance, Learner, Measured
from experiments.training.update import Trainer, TrainState
from mjx_tt.env.policy import Policy, PolicyController


class Evolution(Learner[TrainState]):
    """One call of the compiled function is one update."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer

    def init(self, key: jax.Array) -> TrainState:
        return self._trainer.init(key)

    def compiled(self, state: TrainState) -> Advance[TrainState]:
        update, episodes = self._trainer.lower(state).compile(), self._trainer.episodes_per_update

        def advance(state: TrainState) -> tuple[TrainState, Measured]:
            state, metrics = update(state, self._trainer.inputs)
            finite = episodes - metrics["non_finite"]
            means = {"hit": "hit_rate", "returned": "return_rate", "episode_return": "mean_return", "steps": "steps"}
            sums = {name: metrics[mean] * finite for name, mean in means.items()}
            return state, {"episodes": episodes, **sums}

        return advance

    def controller(self, state: TrainState) -> PolicyController:
        return PolicyController.of(Policy(state.bgs.average, *normalizer.normaliser(state.statistics)))
