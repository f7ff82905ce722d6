"""The gated dilated CNN of 976 parameters in JAX, and a user's network, as controllers of simulated episodes.

Architecture and parameter order: ``robot_io.contract``; the network tick by tick: ``robot_io.policy.policy.step``.

Parameters may differ along a last axis of P perturbations: kernels are (2, in, out, P) and the batch of activations
(channels, B) is R repeats of them, B = R x P with P the faster index. Sums over channels are written out so that each
layer is one vector loop over the batch. ``mjx_tt.gradient.network`` has matrix products for loops that are
differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_tt.env.episode import Tick
from mjx_tt.env.user_network import Network
from mjx_tt.pytrees import pytree
from mjx_tt.robot.scalar_algebra import optimization_barrier
from robot_io.contract import GATED, n_parameters
from robot_io.policy.jax_policy import Policy as Policy
from robot_io.policy.policy import Past, start, step

Parameters: TypeAlias = Mapping[str, Array]  # of ``Policy.parameters``


def initial_theta(key: PRNGKeyArray, scale: float = 0.1, size: int = n_parameters()) -> Float[Array, " size"]:
    """Random parameters (976,), normal with standard deviation ``scale``; biases are drawn as well."""
    return scale * jax.random.normal(key, (size,))


def _layer(parameters: Parameters, i: int, older: Array, newer: Array) -> Array:
    """Layer i from 0: older, newer (in, B) -> (out, B), with B = R x P for kernels of P perturbations."""
    kernel, bias = parameters[f"conv{i + 1}/kernel"], parameters[f"conv{i + 1}/bias"]
    columns = kernel.shape[3] if kernel.ndim == 4 else 1
    shape = (-1, columns) if kernel.ndim == 4 else newer.shape[1:]

    def spread(w: Array) -> Array:  # (out, P) -> (out, 1, P)
        return w[:, None] if kernel.ndim == 4 else w.reshape(w.shape + (1,) * (newer.ndim - 1))

    z = spread(bias)
    for c in range(older.shape[0]):
        z = (
            z
            + spread(kernel[0, c]) * older[c].reshape(shape)[None]
            + spread(kernel[1, c]) * newer[c].reshape(shape)[None]
        )
    x = activate(optimization_barrier(z).reshape(-1, *newer.shape[1:]), i)
    return x if i == len(GATED) - 1 else optimization_barrier(x)


def activate(z: Array, i: int, axis: int = 0) -> Array:
    """Outputs of layer i from 0; ``axis`` has the channels."""
    if not GATED[i]:
        return jnp.tanh(z)
    half = z.shape[axis] // 2
    signal, opening = (jax.lax.slice_in_dim(z, k * half, (k + 1) * half, axis=axis) for k in (0, 1))
    return jnp.tanh(signal) * jax.nn.sigmoid(opening)


@pytree
class PolicyController:
    """The streaming policy as a ``task.Controller``: parameters of P perturbations and a frozen normaliser.

    mean, inv_std: (11,), or (11, P) where every episode has parameters of its own (one repeat).
    """

    parameters: Parameters
    mean: Float[Array, "observed *#batch"]
    inv_std: Float[Array, "observed *#batch"]

    @classmethod
    def of(cls, policy: Policy) -> PolicyController:
        """Raises ValueError for a policy of another network than the paper's."""
        if policy.network is not None:
            raise ValueError(f"the policy's network is {policy.network.name!r}; here only the paper's is computed")
        return cls(policy.parameters, policy.mean, policy.inv_std)

    def start(self, observation: Float[Array, "observed *batch"]) -> Past:
        return start(partial(_layer, self.parameters), normalised(observation, self.mean, self.inv_std))

    def act(
        self, tick: Tick, state: Past, observation: Float[Array, "observed *batch"]
    ) -> tuple[Float[Array, "joints *batch"], Past]:
        return step(partial(_layer, self.parameters), state, normalised(observation, self.mean, self.inv_std))


def normalised(x: Float[Array, "observed *batch"], mean: Array, inv_std: Array) -> Float[Array, "observed *batch"]:
    """Observations less their mean, over their deviation, both (11,) or (11, P)."""
    column = mean.shape + (1,) * (x.ndim - mean.ndim)
    return (x - mean.reshape(column)) * inv_std.reshape(column)


@pytree
class NetworkController:
    """A user's network as a ``task.Controller``: theta (size, P), its functions mapped over P and R repeats.

    mean, inv_std: (11,), or (11, P) where every episode has parameters of its own (one repeat).
    """

    network: Network = field(metadata={"static": True})
    theta: Float[Array, "size P"]
    mean: Float[Array, "observed *#batch"]
    inv_std: Float[Array, "observed *#batch"]

    def start(self, observation: Float[Array, "observed *batch"]) -> Any:
        def one(theta: Array, x: Array) -> Any:
            return jax.tree.map(jnp.asarray, self.network.start(self.network.unflatten(theta), x))

        return self._mapped(one, observation)

    def act(
        self, tick: Tick, state: Any, observation: Float[Array, "observed *batch"]
    ) -> tuple[Float[Array, "joints *batch"], Any]:
        def one(theta: Array, x: Array, state: Any) -> tuple[Array, Any]:
            action, after = self.network.step(self.network.unflatten(theta), state, x)
            return jnp.clip(jnp.asarray(action), -1.0, 1.0), jax.tree.map(jnp.asarray, after)

        action, after = self._mapped(one, observation, state)
        return action.reshape(-1, *observation.shape[1:]), after

    def _mapped(self, one: Callable, observation: Array, *state: Any) -> Any:
        """The function of one policy and one episode for all of them; states have the axes (..., R, P)."""
        x = normalised(observation, self.mean, self.inv_std)
        x = x.reshape(x.shape[0], -1, self.theta.shape[-1])
        repeats = jax.vmap(one, in_axes=(None, *[-1] * (1 + len(state))), out_axes=-1)
        return jax.vmap(repeats, in_axes=-1, out_axes=-1)(self.theta, x, *state)


def controller(policy: Policy) -> PolicyController | NetworkController:
    """The controller that plays a policy's network, the paper's or a user's: theta (size, P), a normaliser as there."""
    if policy.network is None:
        return PolicyController.of(policy)
    return NetworkController(policy.network, policy.theta, policy.mean, policy.inv_std)
