"""Scalar algebra that drops zeros and ones while tracing.

A scalar is a Python float (a constant of the robot) or an array over the batch. Products with 0 and 1 and sums with 0
never reach the compiler, which leaves a serial chain's equations of motion with a third of their operations.
Vectors are 3-tuples of scalars, matrices 3-tuples of rows; ``Sym`` stores the six entries of a symmetric matrix.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

ZERO3 = (0.0, 0.0, 0.0)
EYE3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def is_const(a, value: float) -> bool:
    return isinstance(a, float) and a == value


def add(a, b):
    if is_const(a, 0.0):
        return b
    if is_const(b, 0.0):
        return a
    return a + b


def neg(a):
    return 0.0 if is_const(a, 0.0) else -a


def sub(a, b):
    if is_const(b, 0.0):
        return a
    if is_const(a, 0.0):
        return neg(b)
    return a - b


def mul(a, b):
    if is_const(a, 0.0) or is_const(b, 0.0):
        return 0.0
    for x, y in ((a, b), (b, a)):
        if is_const(x, 1.0):
            return y
        if is_const(x, -1.0):
            return neg(y)
    return a * b


def vadd(a, b):
    return tuple(add(x, y) for x, y in zip(a, b))


def vsub(a, b):
    return tuple(sub(x, y) for x, y in zip(a, b))


def vscale(a, s):
    return tuple(mul(x, s) for x in a)


def dot(a, b):
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]))


def cross(a, b):
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def matvec(m, v):
    return tuple(dot(row, v) for row in m)


def transpose(m):
    return tuple(zip(*m))


def matmul(a, b):
    columns = transpose(b)
    return tuple(tuple(dot(row, column) for column in columns) for row in a)


def madd(a, b):
    return tuple(vadd(x, y) for x, y in zip(a, b))


def msub(a, b):
    return tuple(vsub(x, y) for x, y in zip(a, b))


def outer(a, b):
    return tuple(vscale(b, x) for x in a)


def skew(p):
    """The matrix of p x (.)."""
    return ((0.0, neg(p[2]), p[1]), (p[2], 0.0, neg(p[0])), (neg(p[1]), p[0], 0.0))


def mirror(upper) -> tuple:
    """Full symmetric matrix from a function (i, j) -> entry that is called for i <= j only."""
    entries = {(i, j): upper(i, j) for i in range(3) for j in range(i, 3)}
    return tuple(tuple(entries[min(i, j), max(i, j)] for j in range(3)) for i in range(3))


def congruence(r, a):
    """R A R^T of a symmetric A, each entry computed once."""
    ra = matmul(r, a)
    return mirror(lambda i, j: dot(ra[i], r[j]))


def axis_rotation(axis, cos, sin):
    """Rotation about a constant unit axis: Rodrigues' formula, exact zeros for the coordinate axes."""
    versine = 1.0 - cos
    k = skew(axis)
    kk = np.array(k) @ np.array(k)
    kk = np.where(np.abs(kk) < 1e-15, 0.0, kk)

    def entry(i, j):
        constant = 1.0 if i == j else 0.0
        # For a coordinate axis 1 + (1 - c)(-1) is c itself: no rounding, no work.
        even = cos if constant and kk[i, j] == -1.0 else add(constant, mul(float(kk[i, j]), versine))
        return add(even, mul(k[i][j], sin))

    return tuple(tuple(entry(i, j) for j in range(3)) for i in range(3))


def are_signs(*nested) -> bool:
    """Whether nothing but -1, 0 and 1 stands in nested floats: products with them cost nothing."""
    return all(entry in (-1.0, 0.0, 1.0) for entry in jax.tree.leaves(nested))


def sin_cos(angle):
    """Sine and cosine of angles [rad], |angle| < 8192, to rounding.

    In float32 both together by Cephes' polynomials (Moshier, sinf.c), four times as fast as XLA's two general functions.
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


def constants(values):
    """Nested floats of a NumPy array."""
    values = np.asarray(values, float)
    return tuple(constants(v) for v in values) if values.ndim else float(values)


def materialise(tree):
    """The same nested scalars, with every array of it computed once and stored.

    Left alone, the compiler fuses a whole recursion into each of its results and computes shared terms again for every
    one of them: eight times the work for an eight-joint arm, and minutes of compilation.
    """
    leaves, structure = jax.tree.flatten(tree)
    arrays = [i for i, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    if arrays:
        for i, stored in zip(arrays, jax.lax.optimization_barrier([leaves[i] for i in arrays])):
            leaves[i] = stored
    return jax.tree.unflatten(structure, leaves)
