"""Every ball of a pool is played as it was thrown, spin included, whatever balls are beside it."""

from __future__ import annotations

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.make import load_policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import TaskConfig
from mjx_tt.sim import model as models
from mjx_tt.sim.model import LatencyParams, SimModel
from tests.support.paths import ROOT

TASK = TaskConfig(sim_rate=150.0)
SHIPPED = ROOT / "experiments/shipped/policies/quickstart"
N = 120


def test_a_ball_keeps_its_spin_beside_others():
    """Balls that spin one way in the first half of their order and another way in the second; and the first half.

    In a world with lift, and nothing that is drawn anew for each episode.
    """
    certain = {f"latency.{f.name}": 0.0 for f in fields(LatencyParams) if f.name.endswith("_std")}
    lift = {"sensing.ball_noise": 0.0, "ball.flight.magnus_coefficient": 1.0}
    world, policy = models.with_values(SimModel(), certain | lift), load_policy(SHIPPED)
    balls = sample_pool(jax.random.key(2), registry.resolve("player3/M0"), world.ball, N)
    spin = np.outer([1.0, 0.3, 0.0], np.where(np.arange(N) < N // 2, 40.0, -40.0))
    mixed = replace(balls, state=replace(balls.state, spin=jnp.asarray(spin, jnp.float32)))
    half = jax.tree.map(lambda x: x[..., : N // 2] if x.ndim and x.shape[-1] == N else x, mixed)
    one = Evaluator(Simulator(TASK), mixed, world, ())
    other = one.on(half)
    key = jax.random.key(0)
    together, alone = one.play(policy, key), other.play(policy, key)
    place = np.argsort(one.order)[: N // 2]  # of the first half's balls among all
    for name in ("outcome", "landing", "returns"):
        found, wanted = getattr(together, name)[..., place], getattr(alone, name)[..., np.argsort(other.order)]
        np.testing.assert_array_equal(found, wanted, err_msg=name)
    straight = one.on(mixed.without_spin()).play(policy, key)
    assert np.abs(together.landing - straight.landing).max() > 0.05  # spin matters here
