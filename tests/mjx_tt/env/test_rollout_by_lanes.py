"""Episodes with control steps compiled lane by lane against the same episodes by XLA."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import registry
from ballmodel.sampling import sample_pool
from mjx_tt.env import user_defined
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.reward_weights import SIM_WEIGHTS
from mjx_tt.env.rollout import RolloutResult, Simulator
from mjx_tt.env.task import CONTRACT_OBSERVATIONS, TaskConfig, weigh_rewards
from mjx_tt.sim import model as models
from mjx_tt.sim.actuators import DriveParams
from mjx_tt.sim.model import Range, SimModel
from robot_io.contract import n_parameters
from tests.support.small_network import SMALL

R, P = 5, 13  # 65 lanes: four vectors and one lane more
CONFIG = TaskConfig(sim_rate=150.0)
USER_DEFINED = (
    SMALL.replace("(11, 16)", "(14, 16)")
    + """
import jax.numpy as jnp
from mjx_tt.env.terms import observation_term, reward_term

@observation_term("axes")
def axes(sensed):
    return sensed.command[:3]

@reward_term("reach")
def reach(step):
    return jnp.sqrt(jnp.sum(step.blade.position**2, axis=0)) - jnp.exp(-jnp.abs(step.ball_velocity[1]))
"""
)


def everything() -> tuple[SimModel, tuple[Range, ...]]:
    """Every parameter of a model that is a number, drawn for every episode from its nominal value to a little above."""
    model, ranges = SimModel(drives=DriveParams()), []
    for path, value in models.paths(model).items():
        if isinstance(value, int | float) and math.isfinite(value):
            low, high = models.bounds(path)
            if path.endswith(".resonance"):  # [Hz], of which 0 stands for a rigid mount
                value = 8.0
            near = value + max(0.02 * abs(value), 1e-3)
            ranges.append(Range(path, max(low, value), min(high, near)))
    assert len(ranges) > 100
    return model, tuple(ranges)


def both(config: TaskConfig, size: int, network=None, model=SimModel(), ranges=()):  # noqa: B008
    """The same episodes of random policies by lanes and by XLA."""
    keys = jax.random.split(jax.random.key(2), P)
    theta = jnp.stack([initial_theta(key, 0.2, size) for key in keys], axis=-1)
    policy = Policy(theta, jnp.full(config.n_observation, 0.1), jnp.full(config.n_observation, 1.5), network)
    pool = sample_pool(jax.random.key(0), registry.resolve("player3/M0"), SimModel().ball, 256)
    results = []
    for lanes in (True, False):
        simulator = Simulator(replace(config, lanes=lanes))
        episodes = simulator.draw(jax.random.key(1), pool, model, ranges, R, P)
        results.append(jax.jit(simulator.rollout)(policy, episodes))
    return results


def assert_alike(one: RolloutResult, other: RolloutResult) -> None:
    """To rounding, but for a few episodes in which a contact may turn it into another bounce."""
    assert np.isfinite(np.asarray(other.returns)).all()
    assert len(np.unique(np.asarray(other.steps))) > 5
    for name in ("returns", "landing", "steps", "terms", "peak_velocity"):
        a, b = (np.asarray(getattr(x, name), float) for x in (one, other))
        same = np.isclose(a, b, rtol=1e-4, atol=1e-4).reshape(-1, R, P).all(axis=0)
        assert same.mean() > 0.95, name
    np.testing.assert_array_equal(one.finite, other.finite)
    assert (np.asarray(one.outcome) == np.asarray(other.outcome)).mean() > 0.95


@pytest.fixture
def by_lanes(caplog):
    """Fails a test whose loops were left to XLA: it would compare XLA with itself."""
    caplog.set_level("INFO", logger="mjx_tt.lanes")
    yield
    assert "left to XLA" not in caplog.text


@pytest.mark.smoke
def test_the_nominal_model(by_lanes):
    assert_alike(*both(CONFIG, n_parameters()))


@pytest.mark.slow
def test_a_model_in_which_everything_varies(by_lanes):
    model, ranges = everything()
    assert_alike(*both(CONFIG, n_parameters(), model=model, ranges=ranges))


def test_a_users_network_and_terms(by_lanes):
    mine = user_defined.load(USER_DEFINED, "mine.py")
    config = replace(
        CONFIG,
        rewards=weigh_rewards(SIM_WEIGHTS | {"reach": 0.1}, mine.rewards.values()),
        observations=(*CONTRACT_OBSERVATIONS, *mine.observations.values()),
    )
    small = mine.checked_network("small", config.n_observation)
    assert_alike(*both(config, small.size, small))


def test_an_operation_that_lanes_do_not_know_is_left_to_xla(caplog):
    caplog.set_level("INFO", logger="mjx_tt.lanes")
    text = SMALL.replace("jnp.tanh(jnp.tanh((x", "jnp.tanh(jnp.tanh((jnp.sort(x)")
    sorting = user_defined.load(text, "mine.py").networks["small"]
    one, other = both(replace(CONFIG, sim_rate=75.0, max_steps=20), sorting.size, sorting)
    assert "left to XLA: the operation sort" in caplog.text
    np.testing.assert_array_equal(one.returns, other.returns)
