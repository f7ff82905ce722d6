"""Strikes and landings against closed forms: parabolas, mirrors, and straight lines past a blade at rest."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import constants as c
from ballmodel.flight import PaddlePose, ball_params
from ballmodel.state import ball_state
from mjx_tt.gradient.incoming import Incoming
from mjx_tt.gradient.strike import Meeting, Strike, find_landing, simulate_strike

STEP = 1 / 150
AIRLESS = replace(ball_params(), flight=replace(ball_params().flight, air_density=0.0))


def test_without_air_a_ball_lands_where_its_parabola_does():
    start = np.array([[0.1, -0.3], [-1.2, -1.5], [0.3, 0.4]])  # two balls
    velocity = np.array([[0.4, -0.2], [4.0, 5.0], [2.0, 0.5]])
    found = find_landing(AIRLESS, ball_state(jnp.asarray(start, jnp.float32), velocity))
    fall = start[2] - c.BALL_RADIUS
    t = (velocity[2] + np.sqrt(velocity[2] ** 2 + 2 * c.GRAVITY * fall)) / c.GRAVITY
    np.testing.assert_allclose(found.position, start[:2] + velocity[:2] * t, atol=2e-3)
    over = -start[1] / velocity[1]
    np.testing.assert_allclose(found.height, start[2] + velocity[2] * over - 0.5 * c.GRAVITY * over**2, atol=1e-3)
    assert found.crossed.all() and found.down.all()


def strike(ball: Incoming, position: list[float], hit: bool) -> Strike:
    """Of a blade at rest there, its normal along y."""
    column, rest = jnp.array(position)[:, None], jnp.zeros((3, 1))
    blade = PaddlePose(column, jnp.array([[0.0], [1.0], [0.0]]), rest, rest)
    met = Meeting(jnp.array([0]), jnp.array([0]), jnp.array([True]), jnp.array([hit]))
    return simulate_strike(met, ball, AIRLESS, (blade, blade), STEP)


def passing(height: float) -> Incoming:
    """A ball that flies by straight, at x = 0 and this height, 5 m/s against y; at rest in y = 0 between substeps."""
    y = jnp.array([0.5, -0.5]) * 5.0 * STEP
    position = jnp.stack([jnp.zeros(2), y, jnp.full(2, height)])[..., None]
    velocity = jnp.broadcast_to(jnp.array([0.0, -5.0, 0.0])[:, None, None], position.shape)
    true = jnp.ones((2, 1), bool)
    return Incoming(ball_state(position, velocity), true, true, jnp.zeros((1, 3, 1)))


@pytest.mark.parametrize("above", [0.1, 0.25])
def test_a_missed_ball_is_as_far_as_its_line_passes_the_blade(above):
    struck = strike(passing(above), [0.0, 0.0, 0.0], hit=False)
    np.testing.assert_allclose(np.sqrt(struck.distance), above, atol=2e-4)
    # Struck at the blade's middle it would have come straight back, slower by the rubber's restitution.
    np.testing.assert_allclose(struck.ball.velocity[[0, 2], 0], 0.0, atol=1e-5)
    assert 2.5 < float(struck.ball.velocity[1, 0]) < 5.0
    np.testing.assert_allclose(struck.ball.position[:, 0], [0.0, c.BALL_RADIUS, 0.0], atol=1e-4)


def test_a_hit_counts_from_the_blade_s_middle_in_its_plane():
    struck = strike(passing(0.04), [0.03, 0.0, 0.0], hit=True)
    np.testing.assert_allclose(np.sqrt(struck.distance), 0.05, atol=5e-4)
    assert float(struck.ball.velocity[1, 0]) > 2.5
