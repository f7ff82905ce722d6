"""One update by first-order gradients: derivatives of a smooth objective through the simulation, compiled as a whole.

The objective is averaged over the same perturbed policies that Blackbox Gradient Sensing compares, so both optimise the
same smoothed objective. BGS learns one number per policy, its return; here each episode gives a whole gradient.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from bgs import normalizer, strategy
from experiments.training.update import Inputs, Trainer, TrainState, sum_over_devices
from mjx_tt.env.episode import reshape_episodes
from mjx_tt.env.policy import Policy
from mjx_tt.gradient.objective import Objective, Played

SECONDS = 1.7  # that are looked at: 99 of 100 balls of the widest boxes are out of reach by then
LONGEST = 1.0  # norm of a gradient: a few steep episodes must not decide where a step goes


class FirstOrderTrainer(Trainer):
    """Updates of one training run. Elites, common random numbers and the reward schedule are not used."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, **settings)
        config = self.simulator.config
        self._objective = Objective(self.simulator.task, min(config.max_steps, math.ceil(SECONDS / config.period)))

    def _update_local(self, state: TrainState, inputs: Inputs) -> tuple[TrainState, dict[str, jax.Array]]:
        config, simulator = self.bgs_config, self.simulator
        population, episodes = self._draw(state, inputs, 2 * config.num_directions)
        mine = reshape_episodes(simulator.local(episodes), -1)
        mean, inv_std = normalizer.normaliser(state.statistics)

        def cost(members: jax.Array) -> tuple[jax.Array, Played]:
            played = self._objective.play(Policy(members, mean, inv_std, self.network), mine)
            return jnp.where(jnp.isfinite(played.cost), played.cost, 0.0).sum(), played

        (_, played), slopes = jax.value_and_grad(cost, has_aux=True)(simulator.local(population.members))
        whole = jnp.isfinite(slopes).all(0)
        finite = jnp.isfinite(played.cost) & jnp.tile(whole, self._episodes_per_direction)
        seen = (played.seen & finite)[:, None].astype(slopes.dtype)
        centred = (jnp.where(seen > 0, played.observations, mean[None, :, None]) - mean[None, :, None]) * seen
        shared = {
            "slope": jnp.where(whole, slopes, 0.0).sum(1),
            "episodes": finite.sum().astype(slopes.dtype),
            "non_finite": (~finite).sum().astype(slopes.dtype),
            "cost": jnp.where(finite, played.cost, 0.0).sum(),
            "return_rate": (finite & played.returned).sum().astype(slopes.dtype),
            "hit_rate": (finite & played.hit).sum().astype(slopes.dtype),
            "steps": jnp.where(finite, played.ends, 0).sum().astype(slopes.dtype),
            "faults": jnp.where(finite, played.faults, 0.0).sum(),
            "seen": seen.sum(),
            "sums": jnp.stack([centred.sum((0, 2)), (centred * centred).sum((0, 2))]),
        }
        total = sum_over_devices(shared)
        count = jnp.maximum(total["episodes"], 1.0)
        gradient = -total["slope"] / count
        norm = jnp.linalg.norm(gradient)
        bgs = strategy.apply_gradient(
            state.bgs, gradient * jnp.minimum(1.0, LONGEST / jnp.maximum(norm, 1e-12)), config
        )
        # Without one finite episode a step would move on momentum alone.
        bgs = jax.tree.map(
            lambda new, old: jnp.where(total["episodes"] > 0, new, old),
            bgs,
            replace(state.bgs, updates=bgs.updates),
        )
        statistics = normalizer.from_sums(total["seen"].astype(jnp.int32), mean, *total["sums"])
        metrics = {
            "gradient_norm": norm,
            "update_norm": jnp.linalg.norm(bgs.theta - state.bgs.theta),
            "mean_return": -total["cost"] / count,
            "non_finite": total["non_finite"],
            **{name: total[name] / count for name in ("return_rate", "hit_rate", "steps", "faults")},
        }
        return TrainState(bgs, normalizer.merge(state.statistics, statistics), state.key), metrics
