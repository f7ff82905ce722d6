"""Algorithms of a comparison on one task: evolution strategies of ``bgs``, and brax's own PPO and SAC training.

A learner trains until its observer says that the budget is spent. The observer sees the policy and what the episodes
brought after every piece of learning. A run cannot be resumed inside: brax's training functions restore networks, but
neither the optimiser nor the replay buffer.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from brax.training.acme import running_statistics
from brax.training.acme.running_statistics import NestedMeanStd
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo
from brax.training.agents.sac import checkpoint as sac_checkpoint
from brax.training.agents.sac import networks as sac_networks
from brax.training.agents.sac import train as sac
from brax.training.types import Params

from bgs import normalizer
from experiments.config import build
from experiments.config.baselines import Ppo, Sac
from experiments.training.update import Trainer
from mjx_tt.env.brax import flatten
from mjx_tt.env.episode import Controller, Tick
from mjx_tt.env.policy import Policy, PolicyController
from robot_io.contract import HISTORY

ENDLESS = 2**40  # environment steps: the observer ends a training
PIECE = 512  # control steps of each environment between two looks at a learner with a replay buffer
COUNTED = ("episodes", "steps")

Counts = dict[str, float]  # COUNTED, sums over a training so far
Decide = Callable[[Params, jax.Array], jax.Array]  # (parameters, (..., size)) -> (..., joints) in [-1, 1]


class BudgetSpent(Exception):  # noqa: N818 (ends a training as it should end)
    """Raised by an observer when the training has to end."""


Observer = Callable[[Controller, Counts], None]


class Learner(Protocol):
    """One algorithm on one task."""

    def train(self, seed: int, observe: Observer) -> None:
        """Trains until ``observe``, called after each piece of learning, raises BudgetSpent."""

    def template(self) -> Controller:
        """A controller of the shapes that ``observe`` gets, to load a saved one."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkController:
    """A network on the history of observations as a ``task.Controller``."""

    parameters: Params  # (NestedMeanStd, those of the network)
    mean: jax.Array  # (observed,) of the newest observation in the normaliser
    decide: Decide = field(metadata={"static": True})

    def start(self, observation: jax.Array) -> jax.Array:
        return jnp.broadcast_to(observation, (HISTORY, *observation.shape))

    def act(self, tick: Tick, history: jax.Array, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        history = jnp.concatenate([history[1:], observation[None]])
        return jnp.moveaxis(self.decide(self.parameters, flatten(history)), -1, 0), history


class EpisodeCounter(Wrapper):
    """Adds up on the host what the environment's episodes bring; brax counts steps only.

    The environment has batches and starts episodes itself, so brax's wrappers are not needed; PPO reads two of the
    fields that they add.
    """

    def __init__(self, env: Env) -> None:
        super().__init__(env)
        self._sums = np.zeros(len(COUNTED))

    def reset(self, rng: jax.Array) -> State:
        state = self.env.reset(rng)
        return state.replace(info=state.info | {"episode_metrics": {}, "episode_done": state.done})

    def step(self, state: State, action: jax.Array) -> State:
        after = self.env.step(state, action)
        jax.debug.callback(self._add, jnp.stack([after.done.sum(), jnp.float32(after.done.size)]))
        return after

    def _add(self, sums: jax.Array) -> None:
        self._sums += np.asarray(sums)

    def counts(self) -> Counts:
        """Sums of all steps whose results are known."""
        jax.effects_barrier()
        return dict(zip(COUNTED, self._sums.tolist(), strict=True))


@dataclass(frozen=True)
class EvolutionLearner:
    """Blackbox Gradient Sensing or ARS, an update at a time."""

    trainer: Trainer

    def train(self, seed: int, observe: Observer) -> None:
        """As ``Learner``."""
        state, episodes, steps = self.trainer.init(build.key(seed, build.INITIAL_STATE)), 0.0, 0.0
        with suppress(BudgetSpent):
            while True:
                observe(self._controller(state), {"episodes": episodes, "steps": steps})
                state, metrics = self.trainer.update(state)
                played = self.trainer.episodes_per_update
                episodes += played
                steps += (played - float(metrics["non_finite"])) * float(metrics["steps"])

    def template(self) -> PolicyController:
        """As ``Learner``."""
        return jax.eval_shape(lambda: self._controller(self.trainer.init(jax.random.key(0))))

    def _controller(self, state: Any) -> PolicyController:
        return PolicyController.of(Policy(state.bgs.average, *normalizer.normaliser(state.statistics)))


class BraxLearner:
    """What PPO and SAC share: networks, their deterministic policy, and the settings that brax names alike."""

    def __init__(self, settings: Ppo | Sac, env: Env, factory: Any, make_inference_fn: Any) -> None:
        self.env = env
        self._networks = factory(
            env.observation_size, env.action_size, preprocess_observations_fn=running_statistics.normalize
        )
        self._make_policy = make_inference_fn(self._networks)
        self._shared = {
            "num_timesteps": ENDLESS,
            "max_devices_per_host": 1,
            "episode_length": 1,  # of evaluations and wrappers that are not used
            "normalize_observations": True,
            "learning_rate": settings.learning_rate,
            "discounting": settings.discount,
            "reward_scaling": settings.reward_scale,
            "network_factory": factory,
        }

    def template(self) -> NetworkController:
        """As ``Learner``."""
        size = jax.ShapeDtypeStruct((self.env.observation_size,), jnp.float32)
        return jax.eval_shape(
            lambda: self._controller(
                running_statistics.init_state(size), self._networks.policy_network.init(jax.random.PRNGKey(0))
            )
        )

    def _controller(self, normaliser: NestedMeanStd, policy: Params) -> NetworkController:
        """The policy without exploration; normaliser: brax's running statistics of the histories."""
        scale = NestedMeanStd(jnp.array(normaliser.mean), jnp.array(normaliser.std))
        newest = scale.mean.shape[0] // HISTORY
        # Copies, as brax gives the memory of a state to the next one.
        return NetworkController((scale, jax.tree.map(jnp.array, policy)), scale.mean[-newest:], self._decide)

    def _decide(self, parameters: Params, observation: jax.Array) -> jax.Array:
        return self._make_policy(parameters, deterministic=True)(observation, None)[0]


class PpoLearner(BraxLearner):
    """``brax.training.agents.ppo.train``: a piece is one round of play and the learning from it."""

    def __init__(self, settings: Ppo, env: Env) -> None:
        factory = partial(
            ppo_networks.make_ppo_networks,
            policy_hidden_layer_sizes=tuple(settings.policy_layers),
            value_hidden_layer_sizes=tuple(settings.value_layers),
        )
        super().__init__(settings, env, factory, ppo_networks.make_inference_fn)
        self._settings = settings

    def train(self, seed: int, observe: Observer) -> None:
        """As ``Learner``."""
        settings, env = self._settings, EpisodeCounter(self.env)
        with brax_on_new_jax(), suppress(BudgetSpent):
            ppo.train(
                env,
                seed=seed,
                **self._shared,
                wrap_env=False,
                num_envs=settings.environments,
                batch_size=settings.environments // settings.minibatches,
                num_minibatches=settings.minibatches,
                unroll_length=settings.unroll,
                num_updates_per_batch=settings.epochs,
                gae_lambda=settings.gae_lambda,
                clipping_epsilon=settings.clip,
                entropy_cost=settings.entropy_cost,
                max_grad_norm=settings.max_gradient_norm,
                num_evals=-(-ENDLESS // (settings.environments * settings.unroll)) + 1,  # one after each round
                run_evals=False,
                policy_params_fn=lambda steps, make, params: observe(self._controller(*params[:2]), env.counts()),
            )


class SacLearner(BraxLearner):
    """``brax.training.agents.sac.train``, which hands out policies in checkpoints only: the first after a piece."""

    def __init__(self, settings: Sac, env: Env) -> None:
        factory = partial(sac_networks.make_sac_networks, hidden_layer_sizes=tuple(settings.layers))
        super().__init__(settings, env, factory, sac_networks.make_inference_fn)
        self._settings = settings

    def train(self, seed: int, observe: Observer) -> None:
        """As ``Learner``."""
        settings, env = self._settings, EpisodeCounter(self.env)
        with brax_on_new_jax(), suppress(BudgetSpent), tempfile.TemporaryDirectory() as folder:

            def look(steps: int, metrics: Any) -> None:
                if steps:  # at 0 there is no checkpoint yet
                    saved = Path(folder) / f"{steps:012d}"
                    normaliser, policy = sac_checkpoint.load(saved)
                    shutil.rmtree(saved)
                    observe(self._controller(normaliser, policy), env.counts())

            sac.train(
                env,
                seed=seed,
                **self._shared,
                wrap_env_fn=lambda env, **_: env,  # without wrap_env brax has no key
                eval_env=NoEvaluation(self.env),
                num_eval_envs=1,
                num_envs=settings.environments,
                min_replay_size=settings.random_steps,
                max_replay_size=settings.capacity,
                grad_updates_per_step=settings.gradient_steps,
                batch_size=settings.batch,
                tau=settings.target_rate,
                num_evals=ENDLESS // (PIECE * settings.environments) + 1,
                progress_fn=look,
                checkpoint_logdir=folder,
            )


class NoEvaluation(Env):
    """One step in an environment of that size: brax's SAC evaluates always, which is the comparison's business."""

    def __init__(self, env: Env) -> None:
        self._env = env

    observation_size = property(lambda self: self._env.observation_size)
    action_size = property(lambda self: self._env.action_size)
    backend = property(lambda self: self._env.backend)

    def reset(self, rng: jax.Array) -> State:
        batch = jnp.zeros(rng.shape[:-1])
        return State(None, jnp.zeros((*batch.shape, self.observation_size)), batch, batch, {}, {"steps": batch})

    def step(self, state: State, action: jax.Array) -> State:
        return state.replace(done=jnp.ones_like(state.done))


@contextmanager
def brax_on_new_jax() -> Iterator[None]:
    """Gives brax 0.14 the function ``jax.device_put_replicated``, which JAX 0.10 removed (google/brax, issue 671)."""

    def device_put_replicated(tree: Any, devices: list[jax.Device]) -> Any:
        # By brax's own kind of map: from another layout brax would compile its first call apart from the others.
        stacked = jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
        return jax.pmap(lambda x: x, axis_name="i", devices=devices)(stacked)

    if hasattr(jax, "device_put_replicated"):
        yield
        return
    setattr(jax, "device_put_replicated", device_put_replicated)  # noqa: B010 - no name that mypy knows
    try:
        yield
    finally:
        delattr(jax, "device_put_replicated")  # noqa: B043
