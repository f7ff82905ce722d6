"""Functions by operations that processors have, against NumPy in float64."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mjx_tt.lanes.functions import sin_cos


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
