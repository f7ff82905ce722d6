"""The hash noise: distribution, independence, reproducibility."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

from mjx_tt.sim.noise import symmetric_uniform

SEEDS, STEPS = 400, 75


@pytest.fixture(scope="module", params=["random seeds", "consecutive seeds"])
def noise(request):
    """(step, axis, seed)."""
    if request.param == "random seeds":
        seeds = jax.random.bits(jax.random.key(0), (SEEDS,), np.uint32)
    else:
        seeds = np.arange(SEEDS, dtype=np.uint32)
    return np.asarray(jax.jit(jax.vmap(lambda n: symmetric_uniform(seeds, n, 3)))(np.arange(STEPS)), np.float64)


def test_is_uniform_on_the_open_interval(noise):
    assert noise.shape == (STEPS, 3, SEEDS)
    assert (np.abs(noise) < 1).all()
    assert stats.kstest(noise.ravel(), "uniform", (-1, 2)).pvalue > 1e-3
    for axis in range(3):
        assert stats.kstest(noise[:, axis].ravel(), "uniform", (-1, 2)).pvalue > 1e-3
    assert abs(noise.mean()) < 4 / np.sqrt(3 * noise.size)  # four standard errors of a uniform mean
    assert noise.var() == pytest.approx(1 / 3, rel=0.02)


@pytest.mark.parametrize(("axis", "lag"), [(0, 1), (0, 2), (0, 7), (1, 1), (1, 2), (2, 1), (2, 13)])
def test_steps_axes_and_seeds_are_uncorrelated(noise, axis, lag):
    """axis 0: steps, 1: coordinates, 2: seeds; also the squares and magnitudes, which see what a sign hides."""
    along = np.moveaxis(noise, axis, 0)
    for f in (np.array, np.square, np.abs):
        earlier, later = f(along[:-lag]).ravel(), f(along[lag:]).ravel()
        assert abs(np.corrcoef(earlier, later)[0, 1]) < 4.5 / np.sqrt(earlier.size)


def test_pairs_fill_the_square_evenly(noise):
    """A chi-square test on 16 x 16 cells finds lattice structure that correlations miss."""
    for a, b in ((noise[:-1], noise[1:]), (noise[:, :-1], noise[:, 1:]), (noise[..., :-1], noise[..., 1:])):
        counts = np.histogram2d(a.ravel(), b.ravel(), 16, [[-1, 1], [-1, 1]])[0]
        assert stats.chisquare(counts.ravel()).pvalue > 1e-3
