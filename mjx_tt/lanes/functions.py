"""Functions that processors do not have, in float32, by operations that they have."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

_F = np.float32
_LOG2 = _F(0.693147180559945)


def sin_cos(angle: Array) -> tuple[Array, Array]:
    """Sine and cosine of angles [rad], |angle| < 8192, to rounding.

    In float32 both together by Cephes' polynomials (Moshier, sinf.c), four times as fast as XLA's two general
    functions.
    """
    if angle.dtype != jnp.float32:
        return jnp.sin(angle), jnp.cos(angle)
    quarter = jnp.round(angle * np.float32(2.0 / np.pi))
    r = angle
    for part in (1.5703125, 4.837512969970703125e-4, 7.54978995489188216e-8):  # pi / 2 in pieces of few bits
        r = r - quarter * np.float32(part)
    z = r * r
    sin = r + r * z * (-1.6666654611e-1 + z * (8.3321608736e-3 - z * 1.9515295891e-4))
    cos = 1.0 - 0.5 * z + z * z * (4.166664568298827e-2 + z * (-1.388731625493765e-3 + z * 2.443315711809948e-5))
    turn = quarter.astype(jnp.int32)
    odd = (turn & 1) == 1
    sin, cos = jnp.where(odd, cos, sin), jnp.where(odd, sin, cos)
    return jnp.where((turn & 2) == 2, -sin, sin), jnp.where(((turn + 1) & 2) == 2, -cos, cos)


def _horner(x: Array, *coefficients: float) -> Array:
    """The polynomial in x, from its highest coefficient."""
    total = jnp.full_like(x, _F(coefficients[0]))
    for c in coefficients[1:]:
        total = total * x + _F(c)
    return total


def exp(x: Array) -> Array:
    """To 2 units of the last place (Moshier, Cephes, expf.c); 0 in place of what is below the least normal number."""
    c = jnp.clip(x, _F(-87.33654), _F(88.72283))
    n = jnp.floor(c * _F(1.44269504088896341) + _F(0.5))
    r = c - n * _F(0.693359375) + n * _F(2.12194440e-4)
    y = _horner(r, 1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
    y = y * (r * r) + r + _F(1.0)
    # 2^n in two factors: n may be 128, which has no float of its own.
    k = n.astype(jnp.int32)
    half = jax.lax.shift_right_arithmetic(k, jnp.int32(1))
    y = y * _power_of_two(half) * _power_of_two(k - half)
    y = jnp.where(x > _F(88.72283), _F(np.inf), jnp.where(x < _F(-87.33654), _F(0.0), y))
    return jnp.where(x == x, y, x)


def _power_of_two(k: Array) -> Array:
    return jax.lax.bitcast_convert_type(jax.lax.shift_left(k + jnp.int32(127), jnp.int32(23)), jnp.float32)


def log(x: Array) -> Array:
    """To 2 units of the last place (Moshier, Cephes, logf.c); what is below the least normal number counts as 0."""
    bits = jax.lax.bitcast_convert_type(x, jnp.int32)
    exponent = (jax.lax.shift_right_logical(bits, jnp.int32(23)) - jnp.int32(126)).astype(jnp.float32)
    mantissa = (bits & jnp.int32(0x007FFFFF)) | jnp.int32(0x3F000000)
    m = jax.lax.bitcast_convert_type(mantissa, jnp.float32)  # in [1/2, 1)
    low = m < _F(0.707106781186547524)
    exponent = jnp.where(low, exponent - _F(1.0), exponent)
    r = jnp.where(low, m + m, m) - _F(1.0)
    z = r * r
    y = _horner(
        r, 7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1, -1.6668057665e-1,
        2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
    )  # fmt: skip
    y = r + (y * z * r + exponent * _F(-2.12194440e-4) - _F(0.5) * z) + exponent * _F(0.693359375)
    y = jnp.where(x < _F(1.17549435e-38), jnp.where(x < _F(0.0), _F(np.nan), _F(-np.inf)), y)
    return jnp.where(x < _F(np.inf), y, x)


def log1p(x: Array) -> Array:
    """log(1 + x) without the loss of the sum's rounding: log(u) x / (u - 1) with u = 1 + x (Kahan)."""
    u = x + _F(1.0)
    rounded = u - _F(1.0)
    exact = jnp.where(rounded == _F(0.0), _F(1.0), rounded)
    return jnp.where((rounded == _F(0.0)) | ~(u < _F(np.inf)), x, log(u) * (x / exact))


def erf_inv(x: Array) -> Array:
    """Giles, Approximating the erfinv function, 2010, single precision."""
    w = -log1p(-x * x)
    near, far = w - _F(2.5), jnp.sqrt(w) - _F(3.0)
    a = _horner(
        near, 2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503,
        -0.00417768164, 0.246640727, 1.50140941,
    )  # fmt: skip
    b = _horner(
        far, -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773, -0.0076224613,
        0.00943887047, 1.00167406, 2.83297682,
    )  # fmt: skip
    y = jnp.where(w < _F(5.0), a, b) * x
    return jnp.where(jnp.abs(x) == _F(1.0), x * _F(np.inf), y)


def tanh(x: Array) -> Array:
    """To 5 units of the last place: the rational function of Eigen and XLA."""
    c = jnp.clip(x, _F(-7.90531110763549805), _F(7.90531110763549805))
    z = c * c
    p = _horner(
        z, -2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08,
        1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03,
    )  # fmt: skip
    q = _horner(z, 1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)
    return jnp.where(jnp.abs(x) < _F(4e-4), x, c * p / q)


def logistic(x: Array) -> Array:
    return _F(1.0) / (_F(1.0) + exp(-x))


# By the primitive's name.
EXPANSIONS: dict[str, Callable[..., Array]] = {
    "exp": exp,
    "exp2": lambda x: exp(x * _LOG2),
    "log": log,
    "log1p": log1p,
    "erf_inv": erf_inv,
    "tanh": tanh,
    "logistic": logistic,
    "sin": lambda x: sin_cos(x)[0],
    "cos": lambda x: sin_cos(x)[1],
    "tan": lambda x: sin_cos(x)[0] / sin_cos(x)[1],
}
