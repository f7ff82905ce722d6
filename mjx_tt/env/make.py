"""Environments and rollouts from names: the short way in for scripts and notebooks."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from ballmodel import registry
from ballmodel.distribution import BallDistribution, BallMixture
from ballmodel.sampling import sample_pool
from mjx_tt.env import user_defined
from mjx_tt.env.brax import TableTennis, register_environment
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel
from robot_io.policy import artefact

Balls = BallDistribution | BallMixture | str | os.PathLike
Model = SimModel | ModelFile | str | os.PathLike | None
OUTCOMES = np.array(["missed", "hit", "returned"])  # in the order of MISSED, HIT, RETURNED


@dataclass(frozen=True)
class PlayedEpisodes:
    """Results of n episodes: NumPy arrays with the episode as first axis, in the order of the balls' arrival.

    terms          reward term by name, (n,) each, unweighted (``TaskConfig.terms``)
    returns        (n,) weighted sum; NaN where the episode was not finite
    outcome        (n,) "missed", "hit" (touched after the bounce, but not returned) or "returned"
    landing        (n, 2) [m] x, y where the outgoing ball came down to the table's height
    incoming       (n, 2) [m] x, y where the ball bounced on the robot's side
    ball           (n, 6) start of the ball: position [m] and velocity [m/s]
    seconds        (n,) [s] of play under the policy
    peak_velocity  (n, 8) [m/s] and [rad/s]
    finite         (n,) bool
    """

    terms: dict[str, np.ndarray]
    returns: np.ndarray
    outcome: np.ndarray
    landing: np.ndarray
    incoming: np.ndarray
    ball: np.ndarray
    seconds: np.ndarray
    peak_velocity: np.ndarray
    finite: np.ndarray


class Rollout:
    """Plays episodes of one world with any policy; compiled at the first call, whatever the number of episodes."""

    def __init__(self, simulator: Simulator, distribution: registry.Balls, model: ModelFile) -> None:
        self.simulator, self.distribution, self.model = simulator, distribution, model
        self._evaluator: Evaluator | None = None

    def __call__(self, policy: Policy, episodes: int = 1000, seed: int = 0) -> PlayedEpisodes:
        """Plays ``episodes`` balls drawn with ``seed``, each once. Raises ValueError for less than one episode."""
        if episodes < 1:
            raise ValueError(f"episodes is {episodes}, at least 1 is needed")
        ball_key, key = jax.random.split(jax.random.key(seed))
        balls = sample_pool(ball_key, self.distribution, self.model.model.ball, episodes)
        if self._evaluator is None:
            self._evaluator = Evaluator(self.simulator, balls, self.model.model, self.model.randomise)
        else:
            self._evaluator = self._evaluator.on(balls)
        result, order = self._evaluator.play(policy, key), self._evaluator.order
        start = np.concatenate([np.asarray(balls.state.position), np.asarray(balls.state.velocity)])
        return PlayedEpisodes(
            terms=dict(zip(self.simulator.config.terms, result.terms, strict=True)),
            returns=np.asarray(result.returns),
            outcome=OUTCOMES[result.outcome],
            landing=np.asarray(result.landing).T,
            incoming=np.asarray(balls.landing).T[order],
            ball=start.T[order],
            seconds=np.asarray(result.steps) * self.simulator.config.period,
            peak_velocity=np.asarray(result.peak_velocity).T,
            finite=np.asarray(result.finite),
        )


def make_rollout(
    balls: Balls = "player3/M0", model: Model = None, task: TaskConfig | None = None, devices: int | None = None
) -> Rollout:
    """A rollout on balls of a distribution, by name ("player3/M0", "narrow") or as YAML, in the world of a model YAML.

    model    SimModel, ModelFile or a path; None: the nominal one
    devices  None: all of the process (``mjx_tt.configure`` makes one of each processor core)

    Raises ValueError or FileNotFoundError naming what was given and what exists.
    """
    simulator = Simulator(task or TaskConfig(), devices or len(jax.devices()))
    return Rollout(simulator, _distribution(balls), _model(model))


def make(
    balls: Balls = "player3/M0", model: Model = None, task: TaskConfig | None = None, pool: int = 8192, seed: int = 0
) -> TableTennis:
    """The task as a brax environment on ``pool`` balls. Raises as ``make_rollout`` does."""
    world = _model(model)
    drawn = sample_pool(jax.random.key(seed), _distribution(balls), world.model.ball, pool)
    return TableTennis(Simulator(task or TaskConfig()), drawn, world.model, world.randomise)


def load_policy(path: str | os.PathLike) -> Policy:
    """The policy in an artefact's folder, or in a file written by ``Policy.save``, as float32.

    Runs the Python that an artefact holds where its network is not the paper's.
    Raises ArtefactError, OSError or ValueError saying what is wrong with it.
    """
    if not os.path.isdir(path):
        return Policy.load(path)
    found = artefact.load(Path(path))
    return user_defined.load_network(found.policy, str(path), found.contract).astype(np.float32)


def _distribution(balls: Balls) -> registry.Balls:
    return balls if isinstance(balls, BallDistribution | BallMixture) else registry.resolve(balls)


def _model(model: Model) -> ModelFile:
    if isinstance(model, ModelFile):
        return model
    if model is None or isinstance(model, SimModel):
        return ModelFile(model or SimModel(), (), {})
    return models.ModelFile.load(model)


register_environment("table_tennis", make)
