"""The policy's forms in JAX, streaming and full, against each other and against the NumPy reference."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_tt.env.policy import Policy, PolicyController
from robot_io.contract import HISTORY, N_OBSERVATION, n_parameters
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import forward

TICKS, P, R = 12, 5, 3
PRECISION = pytest.mark.parametrize(("x64", "atol"), [(True, 1e-12), (False, 1e-6)], ids=["float64", "float32"])


def draw(x64, seed=0):
    """theta (976, P), mean and inverse scale (11,), observations (ticks, 11, R x P)."""
    rng = np.random.default_rng(seed)
    dtype = np.float64 if x64 else np.float32
    shapes = (n_parameters(), P), (N_OBSERVATION,), (TICKS, N_OBSERVATION, R * P)
    theta, mean, observations = (
        rng.normal(0, scale, shape) for scale, shape in zip((0.3, 0.5, 1.0), shapes, strict=True)
    )
    return [x.astype(dtype) for x in (theta, mean, rng.uniform(0.5, 2, N_OBSERVATION), observations)]


@jax.jit
def streamed(theta, mean, inverse_scale, observations):
    """Actions (ticks, 8, B) of the controller that the rollout uses."""
    controller = PolicyController.of(Policy(theta, mean, inverse_scale))

    def tick(state, n):
        action, state = controller.act(n, state, observations[n])
        return state, action

    return jax.lax.scan(tick, controller.start(observations[0]), jnp.arange(TICKS))[1]


def in_full(theta, mean, inverse_scale, observations):
    """Actions (ticks, 8, B) of one policy, every tick from its whole history."""
    full = jax.jit(jax.vmap(partial(forward, xp=jnp), (None, 0)))
    return np.asarray(full(Policy(theta, mean, inverse_scale), histories(observations)))


def histories(observations):
    """(ticks, 8, 11, B): the first observation fills what came before it."""
    padded = np.concatenate([np.repeat(observations[:1], HISTORY - 1, 0), observations])
    return np.stack([padded[t : t + HISTORY] for t in range(len(observations))])


@PRECISION
def test_both_forms_equal_numpy_for_every_perturbation(x64, atol):
    """Column b of the batch is played with the parameters of perturbation b mod P."""
    with jax.enable_x64(x64):
        theta, mean, inverse_scale, observations = draw(x64, seed=1)
        actions = np.asarray(streamed(theta, mean, inverse_scale, observations))
        each = [in_full(theta[:, p], mean, inverse_scale, observations[..., p::P]) for p in range(P)]
    full = np.stack(each, axis=-1).reshape(actions.shape)
    for b in range(R * P):
        one = Policy(theta[:, b % P], mean, inverse_scale)
        exact = [one.apply(h) for h in histories(observations[..., b])]
        np.testing.assert_allclose(actions[..., b], exact, rtol=0, atol=atol)
        np.testing.assert_allclose(full[..., b], exact, rtol=0, atol=atol)
        robot = StreamingPolicy(one)
        np.testing.assert_allclose([robot.step(o) for o in observations[..., b]], exact, rtol=0, atol=1e-12)
