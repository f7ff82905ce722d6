"""Functions that processors do not have, by operations that they have; float32."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

_F = np.float32


def exp(x: Array) -> Array:
    """e^x to 2 units of the last place (Moshier, Cephes, expf.c); 0 below -87.3, infinity above 88.7."""
    clipped = jnp.clip(x, _F(-87.33654), _F(88.72283))
    n = jnp.floor(clipped * _F(1.44269504088896341) + _F(0.5))
    r = clipped - n * _F(0.693359375) + n * _F(2.12194440e-4)
    p = _F(1.9875691500e-4)
    for c in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1):
        p = p * r + _F(c)
    y = p * (r * r) + r + _F(1.0)
    # 2^n in two factors: n may be 128, which has no float of its own.
    k = n.astype(jnp.int32)
    half = jax.lax.shift_right_arithmetic(k, jnp.int32(1))
    y = y * _power_of_two(half) * _power_of_two(k - half)
    y = jnp.where(x > _F(88.72283), _F(np.inf), jnp.where(x < _F(-87.33654), _F(0.0), y))
    return jnp.where(x == x, y, x)


def _power_of_two(k: Array) -> Array:
    return jax.lax.bitcast_convert_type(jax.lax.shift_left(k + jnp.int32(127), jnp.int32(23)), jnp.float32)


def tanh(x: Array) -> Array:
    """To 5 units of the last place: the rational function that XLA and Eigen use."""
    c = jnp.clip(x, _F(-7.90531110763549805), _F(7.90531110763549805))
    z = c * c
    p = _F(-2.76076847742355e-16)
    for a in (2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08, 1.48572235717979e-05):
        p = p * z + _F(a)
    for a in (6.37261928875436e-04, 4.89352455891786e-03):
        p = p * z + _F(a)
    q = _F(1.19825839466702e-06)
    for b in (1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03):
        q = q * z + _F(b)
    return jnp.where(jnp.abs(x) < _F(4e-4), x, jnp.where(x == x, c * p / q, x))


def logistic(x: Array) -> Array:
    return _F(1.0) / (_F(1.0) + exp(-x))


EXPANSIONS = {"exp": exp, "tanh": tanh, "logistic": logistic}
