"""Peaks of one processor core, measured: fp32 multiply-adds per second and bytes per second, in cache and in memory."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

T = TypeVar("T")

RUNS = 15  # of each kernel, of which the fastest counts: the others were disturbed
CHAINS, LENGTH = 4, 12  # of dependent multiply-adds for each number in a round
NUMBERS = 2048  # 8 kB, well inside a core's first cache
MATRIX = 384  # three matrices of this size are inside the second
MEMORY = 1 << 26  # [byte] of each array of a stream that no cache holds


def measure(cached: int) -> Callable[[], dict[str, float]]:
    """Compiles the kernels; the function returned measures them: names and peaks, in 1/s or byte/s.

    cached: bytes of the two arrays of the stream in cache together, the size of what is to be compared with it.
    fma_peak is the better of XLA's own loop (fma_xla) and NumPy's matrix product (fma_blas).
    """
    numbers: Array = jnp.linspace(0.0, 1.0, NUMBERS, dtype=jnp.float32)
    matrix = np.linspace(0.0, 1.0, MATRIX * MATRIX, dtype=np.float32).reshape(MATRIX, MATRIX)
    near, far = _pair(cached // 2), _pair(MEMORY)
    sizes = {"near": near[0].nbytes, "far": far[0].nbytes}
    rounds = {"fma": 2000, "near": max(1, (1 << 27) // cached), "far": 1}
    fma = _loop(_multiply_add, rounds["fma"], numbers)
    stream_near, stream_far = _loop(_stream, rounds["near"], near), _loop(_stream, rounds["far"], far)

    def speeds() -> dict[str, float]:
        xla = 2.0 * CHAINS * LENGTH * NUMBERS * rounds["fma"] / _fastest(fma)
        blas = 2.0 * MATRIX**3 / _fastest(lambda: matrix @ matrix)
        # Each round reads two arrays and writes one of them.
        cache = 3.0 * sizes["near"] * rounds["near"] / _fastest(stream_near)
        memory = 3.0 * sizes["far"] * rounds["far"] / _fastest(stream_far)
        return {
            "fma_peak": max(xla, blas),
            "fma_xla": xla,
            "fma_blas": blas,
            "cache_bandwidth": cache,
            "memory_bandwidth": memory,
        }

    return speeds


def _pair(size: int) -> tuple[Array, Array]:
    return jnp.ones(size // 4, jnp.float32), jnp.full(size // 4, 1e-3, jnp.float32)


def _multiply_add(x: Array) -> Array:
    chains = [x] * CHAINS
    for _ in range(LENGTH):
        chains = [y * (0.9 + 0.01 * i) + 0.01 for i, y in enumerate(chains)]
    return functools.reduce(jnp.minimum, chains)


def _stream(pair: tuple[Array, Array]) -> tuple[Array, Array]:
    a, b = pair
    return 0.999 * a + b, b


def _loop(body: Callable[[T], T], rounds: int, start: T) -> Callable[[], None]:
    """A call of the compiled loop on its last result, which it overwrites: no memory is new to the process."""
    state = start

    def run(start: T) -> T:
        return jax.lax.fori_loop(0, rounds, lambda _, x: jax.lax.optimization_barrier(body(x)), start)

    compiled = jax.jit(run, donate_argnums=0).lower(start).compile()

    def again() -> None:
        nonlocal state
        state = jax.block_until_ready(compiled(state))

    return again


def _fastest(run: Callable) -> float:
    """Seconds of the fastest of RUNS runs."""

    def seconds() -> float:
        began = time.perf_counter()
        run()
        return time.perf_counter() - began

    return min(seconds() for _ in range(RUNS))
