"""Training from the policy in play, in a believed world, and the trial of both policies in it.

Both are compiled once: worlds, balls and policies are arguments of their programs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from rich.console import Console

from ballmodel.registry import Balls
from ballmodel.sampling import BallPool, sample_pool
from experiments.config import build, experiment, files
from experiments.runs import load_policy
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import Run
from experiments.training.loop import train
from mjx_tt.env.episode import RETURNED
from mjx_tt.env.evaluator import COLUMNS, ROWS
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.sim import model as models
from mjx_tt.sim.arguments import Arguments, arguments
from mjx_tt.sim.model import ModelFile, SimModel

RECIPE = "robust"  # of the trainings that come with the program: by first-order gradients
WIDE = 1.96  # deviations of half a 95 % interval


@dataclass(frozen=True)
class Trial:
    """Return rates of two policies on the same balls of a world, and the 95 % interval of their difference."""

    old: float
    new: float
    low: float
    high: float


class Learner:
    """Trains policies in worlds that are identified, each from the one before.

    updates: of each training; seed: of its balls and of the trial's.
    """

    def __init__(self, updates: int, seed: int = 0) -> None:
        self._config = experiment.load(
            files.shipped("train")[RECIPE],
            (f"training.updates={updates}", "training.evaluate_every=null", "training.devices=1"),
        )
        self._seed = seed
        made = build.experiment(self._config.model_copy(update={"model": {}}), RECIPE)
        task = replace(made.task, sim_rate=self._config.evaluation.sim_rate or made.task.sim_rate)
        self._simulator = Simulator(task, 1)
        self._play = jax.jit(self._simulator.on_devices(self._outcomes, out_specs=PartitionSpec()))

    def train(self, world: Path, balls: Path, policy: str | Path, folder: Path) -> TrainedPolicy:
        """The policy of a run or artefact, trained on in the world of a model YAML on the balls of a person.

        folder: of the run, which goes on where it was stopped.
        """
        changed = {"model": str(world), "balls": str(balls), "initial_policy": str(policy)}
        made, run = build.experiment(self._config.model_copy(update=changed), folder.name), Run(folder)
        if not run.trained(made.config):
            train(made, run, Console(quiet=True))
        return load_policy.load(folder)

    def compare(self, old: Policy, new: Policy, world: ModelFile, balls: Balls) -> Trial:
        """Both policies on the same balls, in the same draws of a world."""
        key = build.key(self._seed, build.EVALUATION_EPISODES)
        pool = sample_pool(build.key(self._seed, build.EVALUATION_BALLS), balls, SimModel().ball, ROWS * COLUMNS)
        numbers = arguments(world.model, world.randomise)
        given = self._simulator.replicate((key, pool, numbers))
        returned = [
            np.asarray(self._play(self._simulator.replicate(_wide(policy)), *given)).ravel() for policy in (old, new)
        ]
        gain = returned[1].astype(float) - returned[0]
        half = WIDE * float(gain.std()) / np.sqrt(gain.size)
        mean = float(gain.mean())
        return Trial(float(returned[0].mean()), float(returned[1].mean()), mean - half, mean + half)

    def _outcomes(self, policy: Policy, key: jax.Array, pool: BallPool, numbers: Arguments) -> jax.Array:
        """Which of ROWS x COLUMNS balls are returned."""
        model = models.with_values(SimModel(), numbers.numbers)
        episodes = self._simulator.draw(key, pool, model, numbers.drawing, ROWS, COLUMNS)
        result = self._simulator.rollout(policy, self._simulator.local(episodes))
        return (result.outcome == RETURNED) & result.finite


def _wide(policy: Policy) -> Policy:
    """The policy on every column of balls."""
    theta, mean, inv_std = (jnp.asarray(x, jnp.float32) for x in (policy.theta, policy.mean, policy.inv_std))
    return Policy(jnp.repeat(theta[:, None], COLUMNS, axis=1), mean, inv_std, policy.network)
