"""The metric of the actions in a policy's parameter space, measured while it plays: the F of ``bgs.metric``.

Windows of observations come from episodes of the training, each at a tick of its own, so that they are those that the
policy sees now. At each of them the network's actions are differentiated by its parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from bgs.normalizer import ObservationStatistics, normaliser
from mjx_tt.env.episode import reshaped
from mjx_tt.env.own import Network
from mjx_tt.env.policy import Policy, controller
from mjx_tt.env.rollout import AXIS, Simulator
from mjx_tt.env.task import Controller, Episodes, Tick
from robot_io.policy.policy import forward

EPISODES = 2048  # of which some two fifths have not ended at their tick
AT_ONCE = 256  # windows that are differentiated side by side
WINDOW = 8  # observations, as far back as the paper's network sees; a network that remembers more starts with them


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Recorder:
    """A controller that keeps the last observations (WINDOW, 11, P) of another at one tick of each episode, (1, P)."""

    inner: Controller
    tick: Array

    @property
    def mean(self) -> Array:
        return self.inner.mean

    def start(self, observation: Array) -> tuple[Any, Array, Array]:
        window = jnp.broadcast_to(observation, (WINDOW, *observation.shape))
        return self.inner.start(observation), window, window

    def act(self, tick: Tick, state: tuple[Any, Array, Array], observation: Array) -> tuple[Array, tuple]:
        inner, window, kept = state
        window = jnp.concatenate([window[1:], observation[None]])
        action, inner = self.inner.act(tick, inner, observation)
        return action, (inner, window, jnp.where(self.tick[0] == tick, window, kept))


def measure(
    simulator: Simulator,
    key: Array,
    theta: Array,
    statistics: ObservationStatistics,
    network: Network | None,
    episodes: Episodes,
) -> Array:
    """Mean of J^T J over observations, (d, d); J the derivatives (joints, d) of the actions by theta (d,).

    episodes: (1, n) drawn for all devices; inside ``simulator.on_devices`` each plays its share. Zero where all
    episodes had ended before their ticks.
    """
    mean, inv_std = normaliser(statistics)
    local = simulator.local(reshaped(episodes, -1))
    ticks = simulator.local(jax.random.randint(key, episodes.seed.shape, 0, simulator.task.config.max_steps))
    columns = jnp.repeat(theta[:, None], ticks.shape[-1], axis=1)
    windows, valid = _windows(simulator, Policy(columns, mean, inv_std, network), local, ticks)
    slopes = jax.vmap(jax.jacrev(partial(actions, mean=mean, inv_std=inv_std, network=network)), in_axes=(None, 0))

    def add(total: Array, part: tuple[Array, Array]) -> tuple[Array, None]:
        inside, used = part
        rows = jnp.where(used[:, None, None], slopes(theta, inside), 0.0).reshape(-1, theta.shape[0])
        return total + jnp.matmul(rows.T, rows, precision=jax.lax.Precision.HIGHEST), None

    n = valid.shape[0]
    parts = -(-n // AT_ONCE)
    padded = [jnp.pad(x, ((0, parts * AT_ONCE - n),) + ((0, 0),) * (x.ndim - 1)) for x in (windows, valid)]
    inside, used = (x.reshape(parts, AT_ONCE, *x.shape[1:]) for x in padded)
    total, _ = jax.lax.scan(add, jnp.zeros((theta.shape[0],) * 2, theta.dtype), (inside, used))
    shared = jax.lax.psum(jnp.append(total.ravel(), valid.sum().astype(theta.dtype)), AXIS)
    return shared[:-1].reshape(total.shape) / jnp.maximum(shared[-1], 1.0)


def actions(
    theta: Array,
    window: Array,
    mean: Array,
    inv_std: Array,
    network: Network | None,
) -> Array:
    """Actions (joints,) after the observations of a window (WINDOW, 11), with nothing before them."""
    if network is None:
        return forward(Policy(theta, mean, inv_std), window[..., None], xp=jnp)[:, 0]
    parameters, seen = network.unflatten(theta), (window - mean) * inv_std
    action, state = jnp.zeros(0), network.start(parameters, seen[0])
    for x in seen:
        action, state = network.step(parameters, state, x)
    return jnp.clip(jnp.asarray(action), -1.0, 1.0)


def _windows(simulator: Simulator, policy: Policy, episodes: Episodes, ticks: Array) -> tuple[Array, Array]:
    """Observations of n episodes up to their ticks (1, n), (n, WINDOW, 11), and (n,) whether the policy saw them."""
    end = simulator.task.play(Recorder(controller(policy), ticks), episodes)
    return jnp.moveaxis(end.controller[2], -1, 0), end.finite & (end.sums.steps > ticks[0].astype(end.sums.steps.dtype))
