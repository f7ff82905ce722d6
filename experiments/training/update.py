"""One update of Blackbox Gradient Sensing on the simulator, compiled as a whole.

Nothing crosses to the host inside an update: directions, balls, rollouts, the step and the merged observation
statistics are one compiled call from a ``TrainState`` to the next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec
from jax.stages import Lowered
from jax.typing import ArrayLike

from ballmodel.sampling import BallPool
from bgs import normalizer, strategy
from bgs.strategy import BGSConfig, BGSState
from mjx_tt.env.episode import MISSED, RETURNED, Episodes
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.rollout import AXIS, RolloutResult, Simulator
from mjx_tt.env.user_network import Network
from mjx_tt.sim import model as models
from mjx_tt.sim.arguments import Arguments, arguments
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Randomised
from robot_io.contract import n_parameters

T = TypeVar("T")
Inputs: TypeAlias = tuple[BallPool, Arguments]  # what trainings of one program differ in: balls, numbers


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything an update reads: a run resumed from it continues bit for bit."""

    bgs: BGSState
    statistics: normalizer.ObservationStatistics
    key: jax.Array  # of the run; update u uses fold_in(key, u)


class Trainer:
    """Updates of one training run.

    episodes_per_direction episodes of each perturbed policy
    common_random_numbers  both members of a pair meet the same balls, latencies and noise
    initial_scale          standard deviation of the random first weights
    reward_schedule        after how many updates the rewards get other weights, and these; None: never
    network                user-defined; None: the paper's
    """

    def __init__(
        self,
        simulator: Simulator,
        bgs_config: BGSConfig,
        pool: BallPool,
        model: SimModel,
        randomise: tuple[Randomised, ...] = (),
        episodes_per_direction: int = 15,
        common_random_numbers: bool = False,
        initial_scale: float = 0.1,
        reward_schedule: tuple[int, tuple[float, ...]] | None = None,
        network: Network | None = None,
    ) -> None:
        if episodes_per_direction < 1:
            raise ValueError(f"repeats: expected at least 1, got {episodes_per_direction}")
        self.simulator, self.bgs_config, self.pool = simulator, bgs_config, simulator.replicate(pool)
        self._model = model
        self.inputs: Inputs = self.pool, simulator.replicate(arguments(model, randomise))
        self._episodes_per_direction, self._initial_scale = episodes_per_direction, initial_scale
        self._crn = common_random_numbers
        self._reward_schedule = reward_schedule
        self.network = network
        self._update = jax.jit(simulator.on_devices(self._update_local, out_specs=PartitionSpec()))

    @property
    def episodes_per_update(self) -> int:
        return 2 * self.bgs_config.num_directions * self._episodes_per_direction

    def init(
        self,
        key: jax.Array,
        theta: ArrayLike | None = None,
        statistics: normalizer.ObservationStatistics | None = None,
    ) -> TrainState:
        """State before the first update, from random weights or from ``theta`` (976,) and its statistics.

        Raises ValueError where theta is not this network's.
        """
        theta_key, run_key = jax.random.split(key)
        task = self.simulator.task
        size = n_parameters(task.contract.n_joints) if self.network is None else self.network.size
        theta = initial_theta(theta_key, self._initial_scale, size) if theta is None else jnp.asarray(theta)
        if theta.shape != (size,):
            raise ValueError(f"the first policy has {theta.shape[0]} parameters, the network has {size}")
        statistics = normalizer.empty(task.config.n_observation) if statistics is None else statistics
        return self.simulator.replicate(TrainState(strategy.init(theta, self.bgs_config), statistics, run_key))

    def update(self, state: TrainState) -> tuple[TrainState, dict]:
        """One update and its metrics (scalars on the device; fetch them rarely)."""
        return self._update(state, self.inputs)

    def lower(self, state: TrainState) -> Lowered:
        """The update, lowered for ahead-of-time compilation (``.compile()``)."""
        return self._update.lower(state, self.inputs)

    def _update_local(self, state: TrainState, inputs: Inputs) -> tuple[TrainState, dict[str, jax.Array]]:
        config, pairs = self.bgs_config, self.bgs_config.num_directions
        population, episodes = self._draw(state, inputs, pairs if self._crn else 2 * pairs)
        if self._crn:
            episodes = jax.tree.map(lambda x: jnp.concatenate([x, x], -1) if x.ndim >= 2 else x, episodes)
        mean, inv_std = normalizer.normaliser(state.statistics)
        simulator = self.simulator
        result = simulator.rollout(
            Policy(simulator.local(population.members), mean, inv_std, self.network), simulator.local(episodes)
        )
        result = self._apply_schedule(result, state.bgs.updates)
        # Everything that the devices have to share, in one sum: each fills in its own members.
        member = result.returns.mean(axis=0)  # NaN when one of its episodes was not finite
        failed = ~jnp.isfinite(member)
        place = jax.lax.axis_index(AXIS) * member.shape[0]
        members = (
            jnp.zeros((2, 2 * pairs))
            .at[:, place + jnp.arange(member.shape[0])]
            .set(jnp.stack([jnp.where(failed, 0.0, member), failed]))
        )
        sums, counts = result.observation_sums.sum(axis=-1), result.observation_counts.sum()
        shared = (members, sums, counts.astype(jnp.float32), totals(result))
        members, sums, counts, total = sum_over_devices(shared)
        member = jnp.where(members[1] > 0, jnp.nan, members[0])
        bgs, info = strategy.tell(state.bgs, population, member, config)
        seen = normalizer.from_sums(counts.astype(jnp.int32), mean, sums[0], sums[1])
        metrics = {
            **{name: getattr(info, name) for name in ("gradient_norm", "update_norm", "failed_pairs", "elite_std")},
            **means(total, self.simulator.config.terms),
        }
        return TrainState(bgs, normalizer.merge(state.statistics, seen), state.key), metrics

    def _draw(self, state: TrainState, inputs: Inputs, columns: int) -> tuple[strategy.Population, Episodes]:
        """Perturbed policies of the update of this state, and episodes (repeats, columns)."""
        direction_key, episode_key = jax.random.split(jax.random.fold_in(state.key, state.bgs.updates))
        population = strategy.ask(direction_key, state.bgs, self.bgs_config)
        pool, numbers = inputs
        model = models.with_values(self._model, numbers.numbers)
        repeats = self._episodes_per_direction
        return population, self.simulator.draw(episode_key, pool, model, numbers.drawing, repeats, columns)

    def _apply_schedule(self, result: RolloutResult, updates: jax.Array) -> RolloutResult:
        """The result with the returns that the weights of this update give."""
        if self._reward_schedule is None:
            return result
        after, weights = self._reward_schedule
        returns = jnp.tensordot(jnp.array(weights, jnp.float32), jnp.where(result.finite, result.terms, 0.0), 1)
        later = jnp.where(result.finite, returns, jnp.nan)
        return replace(result, returns=jnp.where(updates >= after, later, result.returns))


def sum_over_devices(tree: T) -> T:
    """Sums of a tree's leaves in one collective: several at a time starve the threads of host devices."""
    flat, unravel = ravel_pytree(tree)
    return unravel(jax.lax.psum(flat, AXIS))


def totals(result: RolloutResult) -> dict:
    """Sums over the finite episodes of a rollout, from which ``means`` makes metrics; sums of parts add up."""

    def total(x: jax.Array) -> jax.Array:
        return jnp.where(result.finite, x, 0.0).sum(axis=(-2, -1)).astype(jnp.float32)

    return {
        "episodes": total(jnp.ones_like(result.returns)),
        "non_finite": (~result.finite).sum().astype(jnp.float32),
        "mean_return": total(result.returns),
        "return_rate": total(result.outcome == RETURNED),
        "hit_rate": total(result.outcome != MISSED),
        "steps": total(result.steps),
        "terms": total(result.terms),
    }


def means(total: dict, names: tuple[str, ...]) -> dict:
    """Metrics of finite episodes (scalars) from ``totals``; the reward terms, by these names, are unweighted."""
    count = jnp.maximum(total["episodes"], 1.0)
    over = {k: total[k] / count for k in ("mean_return", "return_rate", "hit_rate", "steps")}
    terms = {f"reward/{name}": total["terms"][i] / count for i, name in enumerate(names)}
    return {**over, "non_finite": total["non_finite"], **terms}
