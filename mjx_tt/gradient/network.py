"""The paper's network as matrix products, for loops that are differentiated.

``mjx_tt.env.policy`` writes its sums out, which is fast forwards. Backwards each of the 976 parameters then sums over
all episodes in every control step, one by one: twenty times the time forwards, where a matrix product takes two.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from mjx_tt.env.episode import Controller, Tick
from mjx_tt.env.policy import activate, controller, normalised
from mjx_tt.pytrees import pytree
from robot_io.contract import GATED
from robot_io.policy.policy import Past, Policy, start, step


@pytree
class Matrices:
    """The network of P policies as a controller; it does what ``policy.PolicyController`` does.

    weights, biases: by layer, for a step's inputs below those of ``DILATIONS`` steps before
    """

    weights: tuple[Float[Array, "P out 2*in"], ...]
    biases: tuple[Float[Array, "P out 1"], ...]
    mean: Float[Array, " observed"]
    inv_std: Float[Array, " observed"]

    @classmethod
    def of(cls, policy: Policy) -> Matrices:
        """theta: (976, P)."""
        weights, biases, parameters = [], [], policy.parameters
        for i in range(1, len(GATED) + 1):
            kernel = parameters[f"conv{i}/kernel"]  # (2, in, out, P)
            weights.append(kernel.reshape(-1, *kernel.shape[2:]).transpose(2, 1, 0))
            biases.append(parameters[f"conv{i}/bias"].T[..., None])
        return cls(tuple(weights), tuple(biases), policy.mean, policy.inv_std)

    def start(self, observation: Float[Array, "observed L"]) -> Past:
        return start(self._layer, self._by_policy(observation))

    def act(
        self, tick: Tick, state: Past, observation: Float[Array, "observed L"]
    ) -> tuple[Float[Array, "joints L"], Past]:
        action, later = step(self._layer, state, self._by_policy(observation))
        return action.transpose(1, 2, 0).reshape(action.shape[1], -1), later

    def _by_policy(self, observation: Array) -> Array:
        """Normalised observations (P, 11, R) of (11, R x P)."""
        x = normalised(observation, self.mean, self.inv_std)
        return x.reshape(x.shape[0], -1, self.weights[0].shape[0]).transpose(2, 0, 1)

    def _layer(self, i: int, older: Array, newer: Array) -> Array:
        inputs = jnp.concatenate([older, newer], 1)
        z = jnp.matmul(self.weights[i], inputs, precision=jax.lax.Precision.HIGHEST) + self.biases[i]
        return activate(z, i, axis=1)


def differentiable(policy: Policy) -> Controller:
    """The controller of P policies, theta (size, P), for loops that are differentiated."""
    return Matrices.of(policy) if policy.network is None else controller(policy)
