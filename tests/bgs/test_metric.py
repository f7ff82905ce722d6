"""Perturbations in the metric of the outputs: a closed form, an ill-conditioned function, an update by hand."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bgs
from bgs import metric, optimizers

D = 12
DAMPING = 0.05


@pytest.fixture(scope="module")
def jacobian():
    """Of 40 outputs of a linear function of 12 parameters, which differ by four orders of magnitude in what they do."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(40, D)) * np.logspace(1, -3, D)


def test_factor_is_the_root_of_the_damped_inverse(jacobian):
    fisher = jacobian.T @ jacobian
    with jax.enable_x64(True):
        factor = np.asarray(metric.factor(jnp.asarray(fisher), DAMPING))
    wanted = np.linalg.inv(fisher + DAMPING * np.trace(fisher) / D * np.eye(D))
    ratio = (factor @ factor.T) / wanted
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-8)
    assert np.trace(factor.T @ fisher @ factor) == pytest.approx(np.trace(fisher), rel=1e-10)


def test_perturbations_change_the_outputs_alike(jacobian):
    """Isotropic ones change nearly one output alone; these change as many as there are directions."""
    fisher = jacobian.T @ jacobian
    with jax.enable_x64(True):
        factor = np.asarray(metric.factor(jnp.asarray(fisher), 1e-6))

    def shares(covariance):
        power = np.linalg.eigvalsh(jacobian @ covariance @ jacobian.T)[::-1][:D]
        return power / power.sum()

    assert shares(np.eye(D))[0] > 0.7 and shares(np.eye(D))[3:].sum() < 0.02
    assert shares(factor @ factor.T)[:6].max() < 1.3 / 6 and shares(factor @ factor.T)[3:].sum() > 0.4


@pytest.mark.parametrize("broken", [np.zeros((D, D)), np.full((D, D), np.nan)])
def test_a_policy_that_does_not_answer_keeps_its_parameters_as_they_are(broken):
    np.testing.assert_array_equal(metric.factor(jnp.asarray(broken, jnp.float32), DAMPING), np.eye(D))


@pytest.mark.parametrize("damping", [0.0, -1.0, float("inf"), float("nan")])
def test_damping_is_positive(damping):
    with pytest.raises(ValueError, match=r"metric\.factor: damping = .*, allowed are positive finite numbers"):
        metric.factor(jnp.eye(3), damping)


def test_update_by_hand():
    """Members at theta +/- sigma L delta, and a step of L times the plain one; weights decay as without L."""
    rng = np.random.default_rng(1)
    factor, directions = np.triu(rng.normal(size=(3, 3))) + 2.0 * np.eye(3), rng.normal(size=(3, 4))
    theta, plus, minus = np.array([1.0, -2.0, 0.5]), rng.normal(size=4), rng.normal(size=4)
    config = bgs.BGSConfig(
        num_directions=4, elite_fraction=1.0, sigma=0.1, step=optimizers.make("sgd", 0.2, weight_decay=0.3)
    )
    with jax.enable_x64(True):
        state = replace(bgs.init(jnp.asarray(theta), config), factor=jnp.asarray(factor))
        population = bgs.perturb(state, jnp.asarray(directions), config)
        after, _ = bgs.tell(state, population, jnp.asarray(np.concatenate([plus, minus])), config)
    members = np.concatenate(
        [theta[:, None] + 0.1 * factor @ directions, theta[:, None] - 0.1 * factor @ directions], 1
    )
    np.testing.assert_allclose(population.members, members, rtol=1e-12)
    gradient = directions @ (plus - minus) / (4 * np.concatenate([plus, minus]).std())
    np.testing.assert_allclose(after.theta, theta + 0.2 * factor @ gradient - 0.2 * 0.3 * theta, rtol=1e-12)
    np.testing.assert_array_equal(after.factor, factor)


def test_it_climbs_an_ill_conditioned_hill_in_fewer_evaluations(jacobian):
    """The return falls with the square of the outputs' distance from a target that some theta reaches."""
    rng = np.random.default_rng(2)
    outputs = jnp.asarray(jacobian, jnp.float32)
    target = outputs @ jnp.asarray(rng.normal(size=D) / np.logspace(1, -3, D), jnp.float32)

    def climb(factor):
        step = optimizers.make("adam", optimizers.cosine(0.3, 1e-3, 400))
        config = bgs.BGSConfig(num_directions=6, elite_fraction=1.0, sigma=0.01, step=step)
        state = replace(bgs.init(jnp.zeros(D), config), factor=factor)

        def update(state, key):
            population = bgs.ask(key, state, config)
            distance = outputs @ population.members - target[:, None]
            return bgs.tell(state, population, -jnp.sum(distance**2, axis=0), config)[0], None

        end, _ = jax.lax.scan(update, state, jax.random.split(jax.random.key(3), 400))
        return float(jnp.sum((outputs @ end.theta - target) ** 2) / jnp.sum(target**2))

    assert climb(metric.factor(outputs.T @ outputs, 1e-6)) < 0.1 * climb(None)
