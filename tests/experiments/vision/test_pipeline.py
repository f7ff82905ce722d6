"""The covariance's scale against the closed form of two degrees of freedom."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from experiments.vision import network, pipeline
from robot_io.vision.detector import read_cells


def test_calibration_scales_every_covariance_alike():
    params = jax.tree.map(np.asarray, network.start(jax.random.key(0)))
    crops = np.random.default_rng(0).integers(0, 255, (2, 4, 64, 64, 3), np.uint8)
    scaled = pipeline.calibrate(params, np.full(10, 6.0))
    before, after = (
        read_cells(*(np.asarray(said).transpose(0, 3, 1, 2) for said in network.apply(p, *crops)))
        for p in (params, scaled)
    )
    # Errors three times too large for the covariance: it grows threefold.
    np.testing.assert_allclose(after.covariance, 3 * before.covariance, rtol=1e-3)
    np.testing.assert_allclose(after.centre, before.centre, atol=1e-4)
    assert after.probability == pytest.approx(before.probability, abs=1e-5)
