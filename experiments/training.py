"""One update of Blackbox Gradient Sensing on the simulator, compiled as a whole, and evaluation of a policy.

Nothing crosses to the host inside an update: directions, balls, rollouts, the step and the merged observation statistics
are one compiled call from a ``TrainState`` to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.pool import BallPool
from bgs import normalizer, strategy
from bgs.strategy import BGSConfig, BGSState
from mjx_tt import rewards
from mjx_tt.model import Range, SimModel
from mjx_tt.policy import initial_theta
from mjx_tt.rollout import RolloutResult, Simulator
from mjx_tt.task import MISSED, RETURNED
from robot_io.contract import N_OBSERVATION

EVALUATION_COLUMNS = 256  # copies of one policy side by side, to fill the vector loops


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything an update reads: a run resumed from it continues bit for bit."""

    bgs: BGSState
    statistics: normalizer.ObservationStatistics
    key: jax.Array  # of the run; update u uses fold_in(key, u)


class Trainer:
    """Updates of one training run.

    repeats                episodes per perturbation
    common_random_numbers  both members of a pair meet the same balls, latencies and noise
    initial_scale          standard deviation of the random first weights
    """

    def __init__(
        self,
        simulator: Simulator,
        bgs_config: BGSConfig,
        pool: BallPool,
        model: SimModel,
        randomise: tuple[Range, ...] = (),
        repeats: int = 15,
        common_random_numbers: bool = False,
        initial_scale: float = 0.1,
    ) -> None:
        if repeats < 1:
            raise ValueError(f"repeats is {repeats}, at least 1 is needed")
        self.simulator, self.bgs_config, self.pool = simulator, bgs_config, pool
        self._model, self._randomise = model, randomise
        self._repeats, self._crn, self._initial_scale = repeats, common_random_numbers, initial_scale
        self._update = jax.jit(self._update_on)

    @property
    def episodes_per_update(self) -> int:
        return 2 * self.bgs_config.pairs * self._repeats

    def init(self, key, theta=None, statistics=None) -> TrainState:
        """State before the first update, from random weights or from ``theta`` (976,) and its statistics."""
        theta_key, run_key = jax.random.split(key)
        theta = initial_theta(theta_key, self._initial_scale) if theta is None else jnp.asarray(theta)
        statistics = normalizer.empty(N_OBSERVATION) if statistics is None else statistics
        return TrainState(strategy.init(theta, self.bgs_config), statistics, run_key)

    def update(self, state: TrainState) -> tuple[TrainState, dict]:
        """One update and its metrics (scalars on the device; fetch them rarely)."""
        return self._update(state, self.pool)

    def lower(self, state: TrainState):
        """The update, lowered for ahead-of-time compilation (``.compile()``)."""
        return self._update.lower(state, self.pool)

    def _update_on(self, state: TrainState, pool: BallPool):
        config, pairs = self.bgs_config, self.bgs_config.pairs
        direction_key, episode_key = jax.random.split(jax.random.fold_in(state.key, state.bgs.updates))
        directions = strategy.ask(direction_key, state.bgs, config)
        theta = strategy.population(state.bgs.theta, directions, config.sigma)
        columns = pairs if self._crn else 2 * pairs
        episodes = self.simulator.draw(
            episode_key, pool, self._model, self._randomise, self._repeats, columns
        )
        if self._crn:
            episodes = jax.tree.map(lambda x: jnp.concatenate([x, x], -1) if x.ndim >= 2 else x, episodes)
        mean, inverse_scale = normalizer.normaliser(state.statistics)
        result = self.simulator.rollout(theta, mean, inverse_scale, episodes)
        member = result.returns.mean(axis=0)  # NaN when one of its episodes was not finite
        bgs, info = strategy.tell(state.bgs, directions, member[:pairs], member[pairs:], config)
        seen = observed(result, mean)
        statistics = normalizer.merge(state.statistics, seen)
        metrics = {
            **{name: getattr(info, name) for name in ("gradient_norm", "update_norm", "failed_pairs", "elite_std")},
            **summary(result),
        }
        return TrainState(bgs, statistics, state.key), metrics

    def evaluate(self, theta, statistics, key, pool: BallPool, model: SimModel, episodes: int) -> RolloutResult:
        """Plays at least ``episodes`` episodes of one policy theta (976,) with frozen statistics; NumPy arrays (R, P)."""
        return evaluate(self.simulator, theta, *normalizer.normaliser(statistics), key, pool, model, episodes)


def evaluate(
    simulator: Simulator, theta, mean, inverse_scale, key, pool: BallPool, model: SimModel, episodes: int,
    randomise: tuple[Range, ...] = (),
) -> RolloutResult:  # fmt: skip
    """Plays one policy theta (976,) on at least ``episodes`` balls of the pool; the result's arrays are NumPy, (R, P)."""
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}, at least 1 is needed")
    columns = min(EVALUATION_COLUMNS, episodes)
    columns = -(-columns // simulator.devices) * simulator.devices
    repeats = -(-episodes // columns)

    def play(theta, mean, inverse_scale, key, pool):
        drawn = simulator.draw(key, pool, model, randomise, repeats, columns)
        return simulator.rollout(jnp.repeat(theta[:, None], columns, 1), mean, inverse_scale, drawn)

    return jax.tree.map(np.asarray, jax.jit(play)(theta, mean, inverse_scale, key, pool))


def observed(result: RolloutResult, shift) -> normalizer.ObservationStatistics:
    """Statistics of the observations of a rollout whose sums are about ``shift`` (11,)."""
    sums = result.observation_sums.sum(axis=-1)
    return normalizer.from_sums(result.observation_counts.sum(), shift, sums[0], sums[1])


def summary(result: RolloutResult) -> dict:
    """Scalars over all finite episodes of a rollout."""
    count = jnp.maximum(result.finite.sum(), 1)

    def over_finite(x):
        return jnp.where(result.finite, x, 0.0).sum(axis=(-2, -1)) / count

    terms = over_finite(result.terms)
    return {
        "mean_return": over_finite(jnp.nan_to_num(result.returns)),
        "return_rate": over_finite(result.outcome == RETURNED),
        "hit_rate": over_finite(result.outcome != MISSED),
        "non_finite": (~result.finite).sum(),
        "steps": over_finite(result.steps),
        **{f"reward/{name}": terms[i] for i, name in enumerate(rewards.TERMS)},
    }
