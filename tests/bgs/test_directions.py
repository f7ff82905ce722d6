from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from bgs import directions


def _many(d, pairs, draws, **options):
    keys = jax.random.split(jax.random.key(0), draws)
    return np.asarray(jax.vmap(lambda key: directions.sample(key, d, pairs, **options))(keys))


def test_columns_are_orthogonal_with_norm_sqrt_d():
    delta = np.asarray(directions.sample(jax.random.key(1), 976, 200), np.float64)
    assert delta.shape == (976, 200)
    np.testing.assert_allclose(delta.T @ delta, 976 * np.eye(200), atol=976 * 1e-5)


def test_more_pairs_than_dimensions_come_in_orthogonal_blocks_that_differ():
    delta = np.asarray(directions.sample(jax.random.key(2), 5, 12), np.float64)
    for start in (0, 5, 10):
        block = delta[:, start : start + 5]
        np.testing.assert_allclose(block.T @ block, 5 * np.eye(block.shape[1]), atol=1e-5)
    assert np.abs(delta[:, 0] - delta[:, 5]).max() > 0.1


def test_orthogonal_basis_is_haar():
    # Archimedes: each coordinate of a uniform unit vector in three dimensions is uniform on [-1, 1]. LAPACK's own signs
    # would make the first element of the first column negative every time.
    q = _many(3, 3, 2000) / np.sqrt(3)
    for row in range(3):
        for column in range(3):
            assert stats.kstest(q[:, row, column], stats.uniform(-1, 2).cdf).pvalue > 1e-3
    determinants = np.linalg.det(q)
    assert 0.45 < np.mean(determinants > 0) < 0.55  # both rotations and reflections; 4.5 standard errors


def test_chi_scale_gives_gaussian_columns():
    delta = _many(4, 3, 2000, scale="chi")
    assert stats.kstest(delta[:, 1, 2], stats.norm.cdf).pvalue > 1e-3
    assert stats.kstest(np.sum(delta[:, :, 0] ** 2, axis=1), stats.chi2(4).cdf).pvalue > 1e-3
    products = np.einsum("nij,nik->njk", delta, delta)
    assert np.abs(products[:, 0, 1]).max() < 1e-4  # still orthogonal


def test_plain_gaussian_columns_are_independent():
    delta = _many(4, 2, 2000, orthogonal=False)
    assert stats.kstest(delta[:, 3, 1], stats.norm.cdf).pvalue > 1e-3
    products = np.einsum("ni,ni->n", delta[:, :, 0], delta[:, :, 1])
    assert abs(np.var(products) / 4 - 1) < 0.3  # variance d of the inner product of two standard Gaussian vectors


def test_precision_follows_dtype():
    with jax.enable_x64(True):
        delta = directions.sample(jax.random.key(3), 30, 30, dtype=jnp.float64)
        np.testing.assert_allclose(np.asarray(delta.T @ delta), 30 * np.eye(30), atol=1e-12)
