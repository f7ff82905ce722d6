"""The gated dilated CNN of 976 parameters in JAX, in streaming form (in full: ``robot_io.policy.policy.forward``).

Architecture and parameter order: ``robot_io.contract``. Streaming keeps one past input, two past outputs of layer 1 and
four of layer 2, which is all that the dilations 1, 2, 4 reach back to: 928 multiply-adds a control step instead of
4,576.

Parameters may differ along a last axis of P perturbations: kernels are (2, in, out, P) and the batch of activations
(channels, B) is R repeats of them, B = R x P with P the faster index. Sums over channels are written out so that each
layer is one vector loop over the batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PRNGKeyArray

from mjx_tt.env.episode import Tick
from mjx_tt.robot.scalar_algebra import materialise
from robot_io.contract import DILATIONS, FILTERS, GATED, N_OBSERVATION
from robot_io.policy.pytree import Policy as Policy

Parameters: TypeAlias = Mapping[str, Array]  # of ``Policy.parameters``
Layer: TypeAlias = tuple[Array, Array, bool]  # kernel, bias, gated


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PolicyState:
    """State of the streaming form, newest last."""

    inputs: Float[Array, "1 11 *batch"]  # normalised observation of the tick before
    layer1: Float[Array, "2 8 *batch"]
    layer2: Float[Array, "4 12 *batch"]


def initial_theta(key: PRNGKeyArray, scale: float = 0.1) -> Float[Array, "976"]:
    """Random parameters (976,), normal with standard deviation ``scale``; biases are drawn as well."""
    return scale * jax.random.normal(key, (sum(_sizes()),))


def _sizes() -> Iterator[int]:
    inputs = N_OBSERVATION
    for filters, gated in zip(FILTERS, GATED, strict=True):
        outputs = filters * (2 if gated else 1)
        yield 2 * inputs * outputs + outputs
        inputs = filters


def _layer(layer: Layer, older: Float[Array, "inputs *batch"], newer: Float[Array, "inputs *batch"]) -> Array:
    """One tap pair of a layer: older, newer (in, B) -> (out, B), with B = R x P for kernels of P perturbations."""
    kernel, bias, gated = layer
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
    z = materialise(z).reshape(-1, *newer.shape[1:])
    if not gated:
        return jnp.tanh(z)
    half = z.shape[0] // 2
    return jnp.tanh(z[:half]) * jax.nn.sigmoid(z[half:])


def _layers(parameters: Parameters) -> list[Layer]:
    return [(parameters[f"conv{i}/kernel"], parameters[f"conv{i}/bias"], gated) for i, gated in enumerate(GATED, 1)]


def start(parameters: Parameters, x: Float[Array, "11 *batch"]) -> PolicyState:
    """State whose whole history is the first normalised observation ``x`` (11, ...)."""
    one, two, _ = _layers(parameters)
    h1 = _layer(one, x, x)
    h2 = _layer(two, h1, h1)
    return PolicyState(x[None], jnp.stack([h1] * DILATIONS[1]), jnp.stack([h2] * DILATIONS[2]))


def stream(
    parameters: Parameters, state: PolicyState, x: Float[Array, "11 *batch"]
) -> tuple[Float[Array, "8 *batch"], PolicyState]:
    """One control step: normalised observation ``x`` (11, ...) -> action (8, ...) in [-1, 1] and the next state."""
    one, two, three = _layers(parameters)
    h1 = materialise(_layer(one, state.inputs[0], x))
    h2 = materialise(_layer(two, state.layer1[0], h1))
    action = _layer(three, state.layer2[0], h2)
    return action, PolicyState(
        x[None], jnp.concatenate([state.layer1[1:], h1[None]]), jnp.concatenate([state.layer2[1:], h2[None]])
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PolicyController:
    """The streaming policy as a ``task.Controller``: parameters of P perturbations and a frozen normaliser.

    mean, inv_std: (11,), or (11, P) where every episode has parameters of its own (one repeat).
    """

    parameters: Parameters
    mean: Float[Array, "11 *#batch"]
    inv_std: Float[Array, "11 *#batch"]

    @classmethod
    def of(cls, policy: Policy) -> PolicyController:
        return cls(policy.parameters, policy.mean, policy.inv_std)

    def start(self, observation: Float[Array, "11 *batch"]) -> PolicyState:
        return start(self.parameters, self._normalised(observation))

    def act(
        self, tick: Tick, state: PolicyState, observation: Float[Array, "11 *batch"]
    ) -> tuple[Float[Array, "8 *batch"], PolicyState]:
        return stream(self.parameters, state, self._normalised(observation))

    def _normalised(self, x: Array) -> Array:
        column = self.mean.shape + (1,) * (x.ndim - self.mean.ndim)
        return (x - self.mean.reshape(column)) * self.inv_std.reshape(column)
