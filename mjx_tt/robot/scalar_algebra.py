"""Scalar algebra that drops zeros and ones while tracing.

A scalar is a Python float (a constant of the robot) or an array over the batch. Products with 0 and 1 and sums with 0
never reach the compiler, which leaves a serial chain's equations of motion with a third of their operations.
Vectors are 3-tuples of scalars, matrices 3-tuples of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias, TypeVar

import jax
import numpy as np

Scalar: TypeAlias = float | jax.Array
Vector: TypeAlias = tuple[Scalar, Scalar, Scalar]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]
Constant: TypeAlias = tuple[float, float, float]
ConstantMatrix: TypeAlias = tuple[Constant, Constant, Constant]
T = TypeVar("T")

ZERO3: Constant = (0.0, 0.0, 0.0)
EYE3: ConstantMatrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def is_const(a: Scalar, value: float) -> bool:
    return isinstance(a, float) and a == value


def add(a: Scalar, b: Scalar) -> Scalar:
    if is_const(a, 0.0):
        return b
    if is_const(b, 0.0):
        return a
    return a + b


def neg(a: Scalar) -> Scalar:
    return 0.0 if is_const(a, 0.0) else -a


def sub(a: Scalar, b: Scalar) -> Scalar:
    if is_const(b, 0.0):
        return a
    if is_const(a, 0.0):
        return neg(b)
    return a - b


def mul(a: Scalar, b: Scalar) -> Scalar:
    if is_const(a, 0.0) or is_const(b, 0.0):
        return 0.0
    for x, y in ((a, b), (b, a)):
        if is_const(x, 1.0):
            return y
        if is_const(x, -1.0):
            return neg(y)
    return a * b


def vadd(a: Vector, b: Vector) -> Vector:
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


def vsub(a: Vector, b: Vector) -> Vector:
    return sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2])


def vscale(a: Vector, s: Scalar) -> Vector:
    return mul(a[0], s), mul(a[1], s), mul(a[2], s)


def dot(a: Vector, b: Vector) -> Scalar:
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]))


def cross(a: Vector, b: Vector) -> Vector:
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def matvec(m: Matrix, v: Vector) -> Vector:
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


def transpose(m: Matrix) -> Matrix:
    x, y, z = zip(*m, strict=True)
    return x, y, z


def matmul(a: Matrix, b: Matrix) -> Matrix:
    x, y, z = transpose(b)

    def times(row: Vector) -> Vector:
        return dot(row, x), dot(row, y), dot(row, z)

    return times(a[0]), times(a[1]), times(a[2])


def madd(a: Matrix, b: Matrix) -> Matrix:
    return vadd(a[0], b[0]), vadd(a[1], b[1]), vadd(a[2], b[2])


def msub(a: Matrix, b: Matrix) -> Matrix:
    return vsub(a[0], b[0]), vsub(a[1], b[1]), vsub(a[2], b[2])


def outer(a: Vector, b: Vector) -> Matrix:
    return vscale(b, a[0]), vscale(b, a[1]), vscale(b, a[2])


def skew(p: Vector) -> Matrix:
    """The matrix of p x (.)."""
    return ((0.0, neg(p[2]), p[1]), (p[2], 0.0, neg(p[0])), (neg(p[1]), p[0], 0.0))


def mirror(upper: Callable[[int, int], Scalar]) -> Matrix:
    """Full symmetric matrix from a function (i, j) -> entry that is called for i <= j only."""
    entries = {(i, j): upper(i, j) for i in range(3) for j in range(i, 3)}
    e = entries
    return (e[0, 0], e[0, 1], e[0, 2]), (e[0, 1], e[1, 1], e[1, 2]), (e[0, 2], e[1, 2], e[2, 2])


def congruence(r: Matrix, a: Matrix) -> Matrix:
    """R A R^T of a symmetric A, each entry computed once."""
    ra = matmul(r, a)
    return mirror(lambda i, j: dot(ra[i], r[j]))


def axis_rotation(axis: Constant, cos: Scalar, sin: Scalar) -> Matrix:
    """Rotation about a constant unit axis: Rodrigues' formula, exact zeros for the coordinate axes."""
    versine = 1.0 - cos
    k = skew(axis)
    kk = np.array(k) @ np.array(k)
    kk = np.where(np.abs(kk) < 1e-15, 0.0, kk)

    def entry(i: int, j: int) -> Scalar:
        constant = 1.0 if i == j else 0.0
        # For a coordinate axis 1 + (1 - c)(-1) is c itself: no rounding, no work.
        even = cos if constant and kk[i, j] == -1.0 else add(constant, mul(float(kk[i, j]), versine))
        return add(even, mul(k[i][j], sin))

    x, y, z = ((entry(i, 0), entry(i, 1), entry(i, 2)) for i in range(3))
    return x, y, z


def are_signs(*nested: Vector | Matrix) -> bool:
    """True for nested floats that are all -1, 0 or 1: products with them cost nothing."""
    return all(entry in (-1.0, 0.0, 1.0) for entry in jax.tree.leaves(nested))


def vector(values: Sequence | np.ndarray) -> Constant:
    """Three numbers as floats."""
    x, y, z = np.asarray(values, float)
    return float(x), float(y), float(z)


def matrix(values: Sequence | np.ndarray) -> ConstantMatrix:
    """3 x 3 numbers as nested floats."""
    x, y, z = np.asarray(values, float)
    return vector(x), vector(y), vector(z)


def optimization_barrier(tree: T) -> T:
    """The same nested scalars, with every array of it computed once and stored.

    Left alone, the compiler fuses a whole recursion into each of its results and computes shared terms again for every
    one of them: eight times the work for an eight-joint arm, and minutes of compilation.
    """
    leaves, structure = jax.tree.flatten(tree)
    arrays = [i for i, leaf in enumerate(leaves) if not isinstance(leaf, float)]
    if arrays:
        for i, kept in zip(arrays, jax.lax.optimization_barrier([leaves[i] for i in arrays]), strict=True):
            leaves[i] = kept
    return jax.tree.unflatten(structure, leaves)
