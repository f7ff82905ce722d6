"""The network as matrix products against NumPy's forward pass over whole histories."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mjx_tt.env.policy import initial_theta
from mjx_tt.gradient.network import differentiable
from robot_io.contract import HISTORY, N_OBSERVATION
from robot_io.policy import policy as numpy_policy
from robot_io.policy.policy import Policy

R, P, TICKS = 3, 4, 2 * HISTORY
MEAN = np.linspace(-0.3, 0.4, N_OBSERVATION, dtype=np.float32)
INVERSE_SCALE = np.linspace(0.5, 2.0, N_OBSERVATION, dtype=np.float32)


def test_it_answers_as_the_forward_pass_over_the_whole_history():
    theta = np.stack([initial_theta(jax.random.key(i), 0.4) for i in range(P)], axis=1)
    seen = np.random.default_rng(0).normal(size=(TICKS, N_OBSERVATION, R * P)).astype(np.float32)
    controller = differentiable(Policy(theta, MEAN, INVERSE_SCALE))
    state, act = controller.start(jnp.asarray(seen[0])), jax.jit(controller.act)
    answers = []
    for tick, observation in enumerate(seen):
        action, state = act(tick, state, jnp.asarray(observation))
        answers.append(np.asarray(action))
    history = np.concatenate([np.repeat(seen[:1], HISTORY - 1, axis=0), seen])
    for episode in range(R * P):
        alone = Policy(theta[:, episode % P].astype(float), MEAN.astype(float), INVERSE_SCALE.astype(float))
        for tick in range(TICKS):
            wanted = numpy_policy.forward(alone, history[tick : tick + HISTORY, :, episode, None].astype(float))[:, 0]
            np.testing.assert_allclose(answers[tick][:, episode], wanted, atol=3e-6)
