"""Operations of compiled programs against counts by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from benchmarks import operations
from mjx_tt.lanes import loop, machine

N = 4096


@pytest.mark.optimised
def test_loops_count_as_often_as_they_run():
    """Ten times: four times a square and a sum, each stored; then a sine. XLA's own analysis has each of them once."""

    def square(_, x):
        return jax.lax.optimization_barrier(x * x + 0.1)

    def outer(_, x):
        return jax.lax.optimization_barrier(jnp.sin(jax.lax.fori_loop(0, 4, square, x)))

    compiled = jax.jit(lambda x: jax.lax.fori_loop(0, 10, outer, x)).lower(jnp.ones(N)).compile()
    counts = operations.count(compiled)
    assert counts.operations == pytest.approx(10 * 4 * 2 * N, rel=0.01)  # and the loops' own counters
    assert counts.transcendentals == 10 * N
    assert counts.bytes == pytest.approx(10 * (4 + 1) * 2 * 4 * N, rel=0.1)  # and the copy of the argument
    assert 10 * (4 + 1) <= counts.kernels <= 10 * (4 * 4 + 5)  # and those of the counters, fused or not
    assert compiled.cost_analysis()["flops"] == pytest.approx(2 * N, rel=0.01)


@pytest.mark.optimised
def test_a_product_of_matrices():
    compiled = jax.jit(jnp.matmul).lower(jnp.ones((8, 16)), jnp.ones((16, 32))).compile()
    assert operations.count(compiled).operations == 2 * 8 * 16 * 32


def test_a_loop_by_lanes_by_hand():
    """Three rounds of a product and a sum, then one square root; two numbers in, one out."""

    def step(tick, state, by_lane, by_column):
        live, x = state
        return live, jnp.sqrt(jax.lax.fori_loop(0, 3, lambda _, y: 0.5 * y + by_lane[0], x))

    state = (jnp.ones(20, bool), jnp.ones(20))
    jax.jit(lambda state, a: loop.while_any(lambda s: s[0], step, state, (a,), limit=2)).lower(state, jnp.ones(20))
    counts = operations.count_lanes(str(machine.optimised(loop.compiled()[-1])), rounds=3)
    assert (counts.operations, counts.transcendentals, counts.kernels) == (7.0, 1.0, 1.0)
    assert counts.bytes in (12.0, 20.0)  # the second number once, or in every round
