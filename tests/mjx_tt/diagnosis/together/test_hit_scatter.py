"""Scatter of hits whose delays and rest were drawn from known covariances, and least squares by NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from mjx_tt.diagnosis.together.hit_scatter import HitScatter, believed_delays, scatter
from mjx_tt.sim.model import LatencyParams

BELIEVED = believed_delays(LatencyParams())
LEFT = np.diag([0.002, 0.004, 0.002, 0.03, 0.03, 0.03]) ** 2


def drawn(n: int, times: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    slopes = rng.normal(size=(2, 6, n)) * np.array([0.5, 0.5, 0.5, 15.0, 15.0, 15.0])[None, :, None]
    own = times * np.linalg.cholesky(BELIEVED) @ rng.normal(size=(2, n))
    return np.einsum("kn,kcn->cn", own, slopes) + np.sqrt(LEFT) @ rng.normal(size=(6, n)), slopes


@pytest.mark.parametrize("times", [0.5, 1.0, 1.5])
def test_finds_how_large_delays_and_the_rest_are(times):
    y, slopes = drawn(4000, times)
    clean = scatter(y, slopes, BELIEVED)
    np.testing.assert_allclose(clean.delays, times**2 * BELIEVED, rtol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diagonal(clean.left)), np.sqrt(np.diagonal(LEFT)), rtol=0.1)
    y[:, :80] += 40.0 * np.sqrt(np.diagonal(LEFT))[:, None]  # two in a hundred met something else
    found = scatter(y, slopes, BELIEVED)
    np.testing.assert_allclose(found.delays, clean.delays, rtol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.left)), np.sqrt(np.diagonal(clean.left)), rtol=0.1)
    assert found.weight[:80].max() < 0.6 < np.median(found.weight[80:])


def test_own_delays_are_those_of_least_squares_with_their_prior():
    y, slopes = drawn(3, 1.0)
    found = HitScatter(LEFT, BELIEVED, np.ones(3)).own(y, slopes)
    for i in range(3):
        rows = np.concatenate(
            [slopes[:, :, i].T / np.sqrt(np.diagonal(LEFT))[:, None], np.linalg.cholesky(np.linalg.inv(BELIEVED)).T]
        )
        target = np.concatenate([y[:, i] / np.sqrt(np.diagonal(LEFT)), np.zeros(2)])
        np.testing.assert_allclose(found[:, i], np.linalg.lstsq(rows, target)[0], rtol=1e-9)
