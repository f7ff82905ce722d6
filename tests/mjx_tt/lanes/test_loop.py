"""Loops by lanes: against closed forms, lanes one by one, and the same loop by XLA."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_tt.lanes.loop import _by_lanes, while_any

COUNTS = (1, 15, 16, 17, 100)


def oscillate(lanes, steps, columns=None):
    """Leapfrog of x'' = -w^2 x from x = 1 at rest; w (P,) by column."""
    w = jnp.linspace(1.0, 2.0, columns or lanes, dtype=jnp.float32)[None]

    def step(tick, s, by_lane, w):
        live, x, v = s
        (dt,) = by_lane
        v = v - 0.5 * dt * w[0] ** 2 * x
        x = x + dt * v
        return live, x, v - 0.5 * dt * w[0] ** 2 * x

    start = (jnp.ones(lanes, bool), jnp.ones(lanes), jnp.zeros(lanes))
    run = jax.jit(lambda start, w: _by_lanes(lambda s: s[0], step, start, (0.01,), w, steps))
    return np.asarray(w[0]), run(start, w)


@pytest.mark.parametrize("lanes", COUNTS)
def test_a_leapfrog_has_its_own_closed_form(lanes):
    """cos(n theta) with cos(theta) = 1 - (w dt)^2 / 2 is what leapfrog makes of the oscillator, exactly."""
    w, (_, x, _) = oscillate(lanes, 200)
    theta = np.arccos(1.0 - 0.5 * (w.astype(float) * 0.01) ** 2)
    np.testing.assert_allclose(x, np.cos(200 * theta), atol=2e-5)


def countdown(lanes: bool):
    """Each lane counts down from its own number, hears of a ring of the last three counts, and stops at zero."""

    def step(tick, s, by_lane, by_column):
        live, left, sum_, ring = s
        ring = jax.lax.dynamic_update_index_in_dim(ring, left, jnp.mod(tick, 3), 0)
        ring = jax.tree.map(lambda new, old: jnp.where(live, new, old), ring, s[3])
        left = jnp.where(live, left - by_lane["by"], left)
        return left > 0.0, left, jnp.where(live, sum_ + left, sum_), ring

    n = jnp.asarray(np.random.default_rng(0).integers(1, 40, 50), jnp.float32)
    start = (n > 0.0, n, jnp.zeros(50), jnp.zeros((3, 50)))
    run = jax.jit(lambda s: while_any(lambda s: s[0], step, s, {"by": jnp.ones(())}, limit=1000, lanes=lanes))
    return np.asarray(n), jax.tree.map(np.asarray, run(start))


@pytest.mark.parametrize("lanes", [True, False], ids=["by lanes", "by XLA"])
def test_lanes_end_one_by_one(lanes):
    n, (live, left, sum_, ring) = countdown(lanes)
    assert not live.any() and not left.any()
    np.testing.assert_array_equal(sum_, n * (n - 1) / 2)
    last = np.stack([np.where(n > k, k + 1, 0) for k in range(3)])  # the last three counts of a lane, in some order
    np.testing.assert_array_equal(np.sort(ring, axis=0), np.sort(last, axis=0))


def test_the_limit_ends_what_is_live():
    start = (jnp.ones(5, bool), jnp.zeros(5, jnp.int32))
    step = lambda tick, s, lanes, columns: (s[0], s[1] + tick)  # noqa: E731
    for lanes in (True, False):
        done = while_any(lambda s: s[0], step, start, limit=7, lanes=lanes)
        np.testing.assert_array_equal(done[1], [21] * 5)


def test_a_lane_that_is_not_finite_leaves_its_neighbours_alone():
    start = (jnp.ones(20, bool), jnp.ones(20).at[3].set(jnp.nan).at[4].set(jnp.inf))
    step = lambda tick, s, lanes, columns: (s[0] & jnp.isfinite(s[1]), 1.5 * s[1])  # noqa: E731
    live, x = _by_lanes(lambda s: s[0], step, start, (), (), 10)
    others = np.delete(np.arange(20), [3, 4])
    np.testing.assert_array_equal(np.asarray(x)[others], np.float32(1.5) ** 10)
    assert not live[3] and not live[4] and live[others].all()
    assert np.isnan(x[3]) and np.isinf(x[4])


def test_a_loop_within_a_loop_and_a_map():
    def step(tick, s, lanes, columns):
        return s[0], jax.lax.fori_loop(0, 3, lambda i, x: x * 0.5 + i, s[1])

    def block(x):
        return while_any(lambda s: s[0], step, (x > -1.0, x), limit=2)[1]

    x = jnp.arange(60.0).reshape(3, 20)
    wanted = np.asarray(x)
    for _ in range(2):
        for i in range(3):
            wanted = wanted * 0.5 + i
    np.testing.assert_allclose(jax.jit(lambda x: jax.lax.map(block, x))(x), wanted, rtol=1e-6)
