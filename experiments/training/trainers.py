"""The trainer that an experiment asks for: Blackbox Gradient Sensing, or first-order gradients."""

from __future__ import annotations

from experiments.config import build
from experiments.config.build import Experiment
from experiments.errors import error_context
from experiments.training.first_order import FirstOrderTrainer
from experiments.training.update import Trainer
from mjx_tt.env.rollout import Simulator

KINDS: dict[str, type[Trainer]] = {"zeroth_order": Trainer, "first_order": FirstOrderTrainer}  # by optimiser.gradient


def trainer(experiment: Experiment) -> Trainer:
    """The trainer with its pool of balls drawn. Raises ConfigError."""
    config = experiment.config
    with error_context("training.devices"):
        simulator = Simulator(experiment.task, build.device_count(config))
    return KINDS[config.optimiser.gradient](
        simulator,
        experiment.bgs,
        build.pool(experiment, build.key(config.training.seed, build.TRAINING_BALLS), config.training.pool),
        experiment.model.model,
        experiment.model.randomise,
        config.optimiser.repeats,
        config.optimiser.common_random_numbers,
        config.optimiser.initial_scale,
        build.later_weights(config),
        experiment.network,
    )
