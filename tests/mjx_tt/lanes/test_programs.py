"""Every operation by lanes against what JAX's own operations, or SciPy, make of the same numbers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from mjx_tt.lanes.emitter import Unsupported
from mjx_tt.lanes.functions import sin_cos
from mjx_tt.lanes.loop import _by_lanes

L = 37  # two vectors and a part of one
ODD = [0.0, -0.0, 1.0, -1.0, 0.5, 2.5, -2.5, 3.4e38, -3.4e38, 1.2e-38, np.inf, -np.inf, np.nan]


def numbers(low: float = -5.0, high: float = 5.0, odd: bool = True) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform(low, high, L).astype(np.float32)
    if odd:
        drawn[: len(ODD)] = ODD
    return drawn


def by_lanes(function, *arrays):
    """The function's result for arrays (..., L), computed by lanes. Raises Unsupported."""
    out = jax.eval_shape(function, *arrays)
    state = (jnp.ones(L, bool), jnp.zeros(out.shape, out.dtype))

    def step(tick, now, lanes, columns):
        return now[0], function(*lanes)

    return np.asarray(jax.jit(lambda s, a: _by_lanes(lambda s: s[0], step, s, a, (), 1))(state, arrays)[1])


A, B = numbers(), np.roll(numbers(), 3)
M = np.random.default_rng(1).normal(size=(3, 4, L)).astype(np.float32)
K, J = (np.random.default_rng(k).integers(-1000, 1000, L).astype(np.int32) for k in (2, 3))
U = np.random.default_rng(4).integers(0, 2**32, L, dtype=np.uint32)
T = np.random.default_rng(5).integers(0, 2, L).astype(bool)


COMPARISONS = (jnp.equal, jnp.less, jnp.less_equal, jnp.greater, jnp.greater_equal)
FLOATS = (
    *(jnp.negative, jnp.abs, jnp.sign, jnp.sqrt, jnp.floor, jnp.ceil, jnp.round, jnp.isfinite, jnp.square),
    lambda x: jnp.minimum(x, 1.0),
    lambda x: jnp.maximum(0.5, x),
    lambda x: jnp.clip(x, -1.0, 2.0),
    lambda x: x**3,
    lambda x: x**-2,
    lambda x: x.astype(bool),
    lambda x: jax.lax.bitcast_convert_type(x, jnp.int32),
)
WHOLE = (
    *(jnp.invert, jnp.abs),
    lambda x: x % 7,
    lambda x: x // 7,
    lambda x: jax.lax.rem(x, jnp.int32(7)),
    lambda x: x >> 3,
    lambda x: x.astype(jnp.float32),
    lambda x: x.astype(jnp.uint32),
)
UNSIGNED = (lambda x: x >> 3, lambda x: x << 5, lambda x: x ^ 0x5555, lambda x: x.astype(jnp.float32))
FLAGS = (jnp.logical_not, lambda x: x.astype(jnp.float32), lambda x: x.astype(jnp.int32))


@pytest.mark.parametrize(
    "function, arrays",
    [
        *((f, (A, B)) for f in (jnp.add, jnp.subtract, jnp.multiply, jnp.divide, jnp.minimum, jnp.maximum)),
        *((f, (A, B)) for f in COMPARISONS),
        *((f, (A,)) for f in FLOATS),
        *((f, (K, J)) for f in (jnp.add, jnp.minimum, jnp.less, jnp.bitwise_and, jnp.bitwise_or)),
        *((f, (K,)) for f in WHOLE),
        *((f, (U, U[::-1])) for f in (jnp.multiply, jnp.maximum, jnp.less)),
        *((f, (U,)) for f in UNSIGNED),
        *((f, (T,)) for f in FLAGS),
        (jnp.not_equal, (A, A)),
        (jnp.where, (T, A, B)),
        (jnp.logical_and, (T, T[::-1])),
        (lambda x: x.astype(jnp.int32), (numbers(odd=False),)),
    ],
)
def test_an_operation_gives_the_same_bits(function, arrays):
    wanted = np.asarray(function(*map(jnp.asarray, arrays)))
    np.testing.assert_array_equal(by_lanes(function, *arrays), wanted)


@pytest.mark.parametrize(
    "function, oracle, low, high, units",
    [
        (jnp.exp, np.exp, -80.0, 80.0, 3),
        (jnp.exp2, np.exp2, -100.0, 100.0, 100),
        (jnp.log, np.log, 1e-6, 100.0, 4),
        (jnp.log1p, np.log1p, -0.99, 10.0, 6),
        (jnp.tanh, np.tanh, -9.0, 9.0, 6),
        (jax.nn.sigmoid, scipy.special.expit, -20.0, 20.0, 6),
        (jax.scipy.special.erfinv, scipy.special.erfinv, -0.999, 0.999, 20),
        (jnp.sin, np.sin, -1.5, 1.5, 4),
        (jnp.cos, np.cos, -1.5, 1.5, 4),
    ],
)
def test_a_function_is_right_to_some_units_of_the_last_place(function, oracle, low, high, units):
    x = numbers(low, high, odd=False)
    wanted = oracle(x.astype(np.float64))
    error = np.abs(by_lanes(function, x) - wanted) / np.spacing(np.abs(wanted).astype(np.float32))
    assert error.max() < units


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("largest", [np.pi, 8000.0])
def test_sine_and_cosine_are_exact_to_rounding(dtype, largest):
    angles = np.random.default_rng(2).uniform(-largest, largest, 100_000).astype(dtype)
    angles[:9] = np.arange(-4, 5) * np.pi / 2
    with jax.enable_x64(dtype == np.float64):
        sin, cos = jax.jit(sin_cos)(angles)
    assert sin.dtype == cos.dtype == dtype
    for found, exact in ((sin, np.sin(angles.astype(float))), (cos, np.cos(angles.astype(float)))):
        np.testing.assert_allclose(found, exact, rtol=0, atol=np.finfo(dtype).eps)


@pytest.mark.parametrize(
    "function, at",
    [
        (jnp.exp, [np.nan, np.inf, -np.inf, 0.0, 200.0, -200.0, 88.7]),
        (jnp.log, [np.nan, np.inf, 0.0, -1.0, 1.0]),
        (jnp.log1p, [np.nan, np.inf, 0.0, -1.0, -2.0, 1e-30]),
        (jnp.tanh, [np.nan, np.inf, -np.inf, 0.0, 1e-20]),
        (jax.nn.sigmoid, [np.nan, np.inf, -np.inf, 0.0]),
        (jax.scipy.special.erfinv, [np.nan, 1.0, -1.0, 0.0, 2.0]),
        (jnp.sin, [np.nan, 0.0]),
    ],
)
def test_a_function_at_its_ends(function, at):
    x = np.resize(np.float32(at), L)
    np.testing.assert_allclose(by_lanes(function, x), function(jnp.asarray(x)), rtol=1e-6)


@pytest.mark.parametrize(
    "function",
    [
        lambda m: m[1],
        lambda m: (lambda a, b, c: (a - b) * c)(*m),  # one operation with several results from JAX 0.11 on
        lambda m: (lambda a, b, *_: a - b)(*m.transpose(1, 0, 2)),
        lambda m: m[:, 1:3],
        lambda m: m[::2, ::-1],
        lambda m: m.transpose(1, 0, 2),
        lambda m: m.reshape(12, L if m.shape[-1] == L else m.shape[-1]),
        lambda m: m.reshape(2, 6, -1),
        lambda m: jnp.moveaxis(jnp.moveaxis(m, -1, 0)[:, ::2], 0, -1),
        lambda m: jnp.concatenate([m[:1], m[2:], m], axis=0),
        lambda m: jnp.stack([m[0], m[2]], axis=1),
        lambda m: m[:, None] * jnp.arange(5.0)[:, None, None],
        lambda m: jnp.broadcast_to(m[0, 0], (2, 3, m.shape[-1])),
        lambda m: m + jnp.array([1.0, 2.0, 3.0])[:, None, None],
        lambda m: m.max(axis=(0, 1)),
        lambda m: jnp.any(m > 2.0, axis=0),
        lambda m: jnp.all(m > -2.0, axis=1),
        lambda m: jax.lax.dynamic_update_index_in_dim(m, 2.0 * m[0], jnp.int32(2), 0),
        lambda m: jax.lax.scan(lambda c, x: (c + x * m[0, 0], None), m[1], jnp.arange(1.0, 4.0))[0],
        lambda m: jax.lax.fori_loop(0, 5, lambda i, c: jnp.where(i > 2, c * 0.5, c + m[i * 0]), m[0]),
    ],
)
def test_moving_elements_about_gives_the_same_bits(function):
    wanted = np.asarray(jax.jit(function)(jnp.asarray(M)))
    np.testing.assert_array_equal(by_lanes(function, M), wanted)


@pytest.mark.parametrize(
    "function",
    [
        lambda m: m.sum(axis=0),
        lambda m: m.mean(axis=(0, 1)),
        lambda m: jnp.prod(m, axis=1),
        lambda m: jnp.einsum("ijl,jk->ikl", m, jnp.arange(12.0).reshape(4, 3) / 7.0),
        lambda m: jnp.einsum("ijl,ikl->jkl", m, m),
        lambda m: jax.vmap(lambda x: x @ x.T, in_axes=-1, out_axes=-1)(m),
        lambda m: jnp.linalg.norm(m, axis=1),
    ],
)
def test_sums_and_products_agree_to_rounding(function):
    with jax.enable_x64(True):
        wanted = np.asarray(function(jnp.asarray(M, jnp.float64)))
    np.testing.assert_allclose(by_lanes(function, M), wanted, rtol=3e-6, atol=1e-6)


@pytest.mark.parametrize(
    "function, said",
    [
        (lambda m: jnp.sort(m, axis=0), "sort"),
        (lambda m: m - m.mean(axis=-1, keepdims=True), "along the lanes"),
        (lambda m: m.reshape(3, -1)[:, : m.shape[-1]], "not one axis"),
        (lambda m: m[..., ::-1], "along the lanes"),
        (lambda m: jnp.cumsum(m, axis=0), "cumsum"),
        (lambda m: m * jnp.asarray(np.zeros((5000, 1), np.float32)).sum(), "5000 numbers"),
        (lambda m: m.astype(jnp.int32) // m.astype(jnp.int32), "whole division"),
    ],
)
def test_what_is_not_known_is_named(function, said):
    with pytest.raises(Unsupported, match=said):
        by_lanes(function, M)
