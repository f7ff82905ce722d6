"""Perturbations x episodes in one compiled call, over one or several devices.

Arrays are (component, repeat R, perturbation P). Repeats are sorted by the ball's time of arrival and run in blocks,
each until its last live episode: blocks keep the working set in the cache and let fast balls end early. The
perturbation axis can be split over devices (jax.sharding): every device runs its share, with no communication.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from ballmodel.partial_params import without_nominal
from ballmodel.sampling import BallPool
from ballmodel.state import BallState
from mjx_tt.env.episode import HIT, MISSED, RETURNED, Controller, Episodes
from mjx_tt.env.policy import controller
from mjx_tt.env.return_flight import fly_return
from mjx_tt.env.task import Task, TaskConfig, add_weighted, evaluate_rewards
from mjx_tt.pytrees import pytree
from mjx_tt.sim import model as models
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Drawing, Randomised
from robot_io.policy.policy import Policy

T = TypeVar("T")

AXIS = "perturbation"
CPU_BLOCK = 768  # episodes per block that keep the state inside a core's cache


@pytree
class RolloutResult:
    """Results of a batch of episodes."""

    terms: Float[Array, "terms R P"]  # unweighted, order of TaskConfig.terms
    returns: Float[Array, "R P"]  # weighted sum; NaN where the episode was not finite
    outcome: Int[Array, "R P"]  # task.MISSED, HIT, RETURNED
    landing: Float[Array, "2 R P"]  # [m] where the outgoing ball came down to the table's height
    finite: Bool[Array, "R P"]
    steps: Int[Array, "R P"]  # control steps under the policy
    peak_velocity: Float[Array, "joints R P"]  # [m/s], [rad/s]
    observation_sums: Float[Array, "2 observed P"]  # sums of (x - mean) and of (x - mean)^2 over the finite episodes
    observation_counts: Int[Array, " P"]


# The layout of such a result for jax.shard_map, by the axes of each field: split along the last one, P.
RESULT_SPECS = RolloutResult(*(PartitionSpec(*[None] * (rank - 1), AXIS) for rank in (3, 2, 2, 3, 2, 2, 3, 3, 1)))  # type: ignore[arg-type]


class Simulator:
    """Draws and runs episodes of one task on ``devices`` devices: this process' own, or all of several processes'.

    Raises ValueError when fewer devices exist or a number of perturbations cannot be split evenly.
    """

    def __init__(self, config: TaskConfig, devices: int = 1) -> None:
        available = jax.local_devices()
        self._own = devices <= len(available)
        if devices == jax.device_count():
            available = jax.devices()
        if not 1 <= devices <= len(available):
            raise ValueError(f"{devices} devices wanted, this process has {len(available)}: {available}")
        self.config = config
        self.task = Task(config)
        self.devices = devices
        self._mesh = Mesh(np.array(available[:devices]), (AXIS,))
        self._cpu = available[0].platform == "cpu"

    def draw(
        self,
        key: PRNGKeyArray,
        pool: BallPool,
        model: SimModel,
        randomise: tuple[Randomised | Drawing, ...],
        repeats: int,
        columns: int,
    ) -> Episodes:
        """Balls, latencies, noise seeds and randomised parameters of repeats x columns episodes.

        Within each column the episodes are in the order of the balls' arrival. Optional parameters
        that are at their nominal value are None in the episodes' model.
        """
        if model.drives is not None and model.joints != self.task.contract.joints:
            wanted = self.task.contract.joints
            raise ValueError(f"the model has drives of {model.joints}, the robot's joints are {wanted}")
        balls_key, latency_key, seed_key, model_key = jax.random.split(key, 4)
        shape = (repeats, columns)
        index = jax.random.randint(balls_key, shape, 0, pool.arrival.shape[0])
        order = jnp.argsort(pool.arrival[index], axis=0)
        index = jnp.take_along_axis(index, order, axis=0)
        drawn = models.draw(model_key, model, randomise, shape)
        ball: BallState = jax.tree.map(lambda x: x[:, index], pool.state)
        spin = models.draw_spin(jax.random.fold_in(balls_key, 1), drawn.ball_spin, shape)
        if spin is not None:
            ball = replace(ball, spin=ball.spin + spin)
        longest = jnp.array([self.config.max_observation_latency] * 3 + [self.config.max_action_latency] * 2)
        return Episodes(
            ball=ball,
            latency=models.draw_latencies(latency_key, drawn.latency, shape, longest[:, None, None]),
            seed=jax.random.bits(seed_key, shape, jnp.uint32),
            model=jax.tree.map(jnp.asarray, without_nominal(drawn)),
        )

    def on_devices(self, function: Callable, **specs: Any) -> Callable:
        """``function`` run on every device at once, on the same arguments; inside it ``local`` picks a device's share.

        specs: ``out_specs`` of jax.shard_map. What a function combines over devices it should combine in one
        collective: several at a time starve the few threads that host devices share, and hang.
        """
        return jax.shard_map(function, mesh=self._mesh, in_specs=PartitionSpec(), check_vma=False, **specs)

    def replicate(self, tree: T) -> T:
        """The arrays of ``tree`` on every device: the layout that ``on_devices`` takes and returns."""
        everywhere = NamedSharding(self._mesh, PartitionSpec())
        if self._own:
            return jax.device_put(tree, everywhere)
        return jax.tree.map(lambda x: _put(x, everywhere), held_here(tree))

    def gather(self, x: Array) -> np.ndarray:
        """All of an array that ``on_devices`` left on the devices, or a copy of it, for the host to read and write."""
        return np.array(x if x.is_fully_addressable else multihost_utils.process_allgather(x, tiled=True))

    def local(self, tree: T) -> T:
        """This device's share of arrays (..., P) along the last axis; only inside ``on_devices``. Scalars are
        shared."""

        def share(x: Array) -> Array:
            if not x.ndim:
                return x
            width, left = divmod(x.shape[-1], self.devices)
            if left:
                raise ValueError(f"{x.shape[-1]} perturbations cannot be split evenly over {self.devices} devices")
            return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * width, width, axis=-1)

        return jax.tree.map(share, tree)

    def rollout(self, policy: Policy, episodes: Episodes) -> RolloutResult:
        """Runs P policies, theta (976, P) with one normaliser (11,), each on its column of episodes (R, P).

        Runs on the device it is called for; ``on_devices`` and ``local`` spread it.
        """
        columns = policy.theta.shape[-1]
        if columns != episodes.seed.shape[-1]:
            raise ValueError(f"theta has {columns} columns, the episodes {episodes.seed.shape[-1]}")
        return self.play(controller(policy), episodes)

    def play(self, controller: Controller, episodes: Episodes) -> RolloutResult:
        """Runs any controller on episodes (R, P), in blocks of whole rows."""
        repeats, columns = episodes.seed.shape
        rows = self._block_rows(repeats, columns)
        blocks = repeats // rows

        # Inside a block rows and columns are one axis: one long loop per operation instead of many short ones.
        def cut(x: Array) -> Array:  # (..., R, P) -> (blocks, ..., rows x P); scalars are shared
            if x.ndim < 2:
                return jnp.broadcast_to(x, (blocks, *x.shape))
            return jnp.moveaxis(x.reshape(*x.shape[:-2], blocks, rows * columns), -2, 0)

        def join(x: Array) -> Array:  # (blocks, ..., rows x P) -> (..., R, P)
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], repeats, columns)

        run = partial(self._block, controller=controller)
        result, sums, counts = jax.lax.map(run, jax.tree.map(cut, episodes))
        return RolloutResult(
            **{name: join(value) for name, value in result.items()},
            observation_sums=sums.reshape(blocks, 2, -1, rows, columns).sum(axis=(0, 3)),
            observation_counts=counts.reshape(blocks, rows, columns).sum(axis=(0, 1)),
        )

    def _block_rows(self, repeats: int, columns: int) -> int:
        """Rows of a block: all of them on an accelerator; on a CPU the largest divisor that stays near CPU_BLOCK."""
        if not self._cpu:
            return repeats
        wanted = max(1, CPU_BLOCK // columns)
        return max(d for d in range(1, repeats + 1) if repeats % d == 0 and d <= wanted)

    def _block(self, episodes: Episodes, controller: Controller) -> tuple[dict[str, Array], Array, Array]:
        task, config = self.task, self.config
        state = task.play(controller, episodes)
        back = fly_return(config, state.ball, state.hit & state.finite, episodes.model)
        terms = evaluate_rewards(config.rewards, state, back)
        returns = add_weighted(config.rewards, terms)
        finite = state.finite & jnp.isfinite(returns)
        returned = state.hit & back.returned & finite
        outcome = jnp.where(returned, RETURNED, jnp.where(state.hit & finite, HIT, MISSED)).astype(jnp.int32)
        sums = state.accumulators
        observed = jnp.where(finite, jnp.stack([sums.observation, sums.observation_sq]), 0.0)
        steps = sums.steps.astype(jnp.int32)
        result: dict[str, Array] = dict(
            terms=terms,
            returns=jnp.where(finite, returns, jnp.nan),
            outcome=outcome,
            landing=jnp.asarray(back.landing),
            finite=finite,
            steps=steps,
            peak_velocity=sums.peak_velocity,
        )
        return result, observed, jnp.where(finite, steps, 0)


def held_here(tree: T) -> T:
    """The arrays as this process holds them, where each of several processes holds a copy; others as they are."""

    def held(x: Any) -> Any:
        spread = isinstance(x, jax.Array) and not x.is_fully_addressable
        return x.addressable_shards[0].data if spread else x

    return jax.tree.map(held, tree)


def _put(x: Any, where: NamedSharding) -> Array:
    """A host's copy on the devices of all processes, each of which has the same: JAX takes it as NumPy array only."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(x), where), impl=jax.random.key_impl(x))
    return jax.device_put(np.asarray(x), where)
