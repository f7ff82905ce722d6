from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bgs import normalizer

# Compiled once here: one small operation after another is most of these tests' time otherwise.
_from_sums, _merge, _normaliser = (jax.jit(f) for f in (normalizer.from_sums, normalizer.merge, normalizer.normaliser))


def _statistics(data, shift):
    """Statistics of data (n, count) the way a rollout accumulates them."""
    shifted = data - shift[:, None]
    dtype = data.dtype
    return _from_sums(data.shape[1], shift.astype(dtype), shifted.sum(axis=1), (shifted**2).sum(axis=1))


@pytest.fixture
def chunks():
    rng = np.random.default_rng(0)
    centre, spread = np.array([1e3, -2.0, 0.5]), np.array([0.3, 4.0, 1e-2])
    return [centre[:, None] + spread[:, None] * rng.normal(0.2 * i, 1 + i, (3, 40 + 13 * i)) for i in range(4)]


def test_merged_chunks_equal_numpy_over_everything(chunks):
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        merged = normalizer.empty(3, jnp.float64)
        for i, chunk in enumerate(chunks):
            merged = _merge(merged, _statistics(chunk, np.array([1e3, i - 2.0, 0.0])))
        mean, inverse_scale = _normaliser(merged)
        total = float(normalizer.total(merged))
    data = np.concatenate(chunks, axis=1)
    assert total == data.shape[1]
    np.testing.assert_allclose(merged.mean, data.mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(merged.m2, data.var(axis=1) * data.shape[1], rtol=1e-8)  # the shift cancels digits
    np.testing.assert_allclose(mean, merged.mean)
    np.testing.assert_allclose(inverse_scale, 1 / (data.std(axis=1, ddof=1) + 1e-8), rtol=1e-8)


def test_merging_in_float32(chunks):
    merged = normalizer.empty(3)
    for chunk in chunks:
        merged = _merge(merged, _statistics(chunk.astype(np.float32), np.float32([1e3, -2.0, 0.5])))
    data = np.concatenate(chunks, axis=1)
    np.testing.assert_allclose(merged.mean, data.mean(axis=1), rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(merged.m2), data.std(axis=1) * np.sqrt(data.shape[1]), rtol=1e-3)


def test_merge_is_associative_commutative_and_has_an_identity(chunks):
    with jax.enable_x64(True):
        a, b, c, _ = [_statistics(chunk, np.array([1e3, -2.0, 0.5])) for chunk in chunks]
        left = _merge(_merge(a, b), c)
        same = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12)  # noqa: E731
        jax.tree.map(same, left, _merge(a, _merge(b, c)))
        jax.tree.map(same, left, _merge(_merge(c, b), a))
        empty = normalizer.empty(3, jnp.float64)
        jax.tree.map(np.testing.assert_array_equal, _merge(empty, a), a)
        jax.tree.map(np.testing.assert_array_equal, _merge(a, empty), a)


def test_paper_scale_stream_in_float32():
    # 45,000 updates of 6,000 episodes x 60 observations: the count is exact, mean and deviation stay near float64's.
    updates, per_update = 45_000, 6_000 * 60 + 1
    rng = np.random.default_rng(0)
    means = (np.array([1.5, 0.0, -3.0]) + rng.normal(0, 0.1, (updates, 3))).astype(np.float32)
    variances = rng.uniform(0.5, 2.0, (updates, 3)).astype(np.float32)

    def update(statistics, chunk):
        mean, variance = chunk
        new = normalizer.from_sums(per_update, mean, jnp.zeros(3), variance * per_update)
        return normalizer.merge(statistics, new), None

    merged, _ = jax.lax.scan(update, normalizer.empty(3), (jnp.asarray(means), jnp.asarray(variances)))
    assert int(merged.count[0]) * 2**30 + int(merged.count[1]) == updates * per_update > 2**33
    mean, inverse_scale = _normaliser(merged)
    exact_mean = means.astype(np.float64).mean(axis=0)
    exact_std = np.sqrt(variances.astype(np.float64).mean(axis=0) + means.astype(np.float64).var(axis=0))
    np.testing.assert_allclose(mean, exact_mean, atol=1e-4 * exact_std.min())
    np.testing.assert_allclose(1 / inverse_scale, exact_std, rtol=1e-4)


def test_count_beyond_int32_and_float32_still_counts_in_ones():
    huge = normalizer.ObservationStatistics(jnp.array([15, 2**30 - 1], jnp.int32), jnp.zeros(1), jnp.ones(1))
    one = normalizer.from_sums(1, jnp.zeros(1), jnp.zeros(1), jnp.zeros(1))
    np.testing.assert_array_equal(_merge(huge, one).count, [16, 0])
    np.testing.assert_array_equal(_merge(_merge(huge, one), one).count, [16, 1])


def test_constant_component_is_normalised_to_zero():
    data = np.stack([np.linspace(-1, 1, 50), np.full(50, 0.7)]).astype(np.float32)
    mean, inverse_scale = _normaliser(_statistics(data, np.float32([0.0, 0.7])))
    np.testing.assert_allclose(inverse_scale, [1 / data[0].std(ddof=1), 0.0], rtol=1e-6)


def test_before_any_deviation_the_normaliser_does_not_scale():
    one = normalizer.from_sums(1, jnp.array([2.0]), jnp.array([0.5]), jnp.array([0.25]))
    for statistics, mean in ((normalizer.empty(1), 0.0), (one, 2.5)):
        np.testing.assert_array_equal(np.stack(_normaliser(statistics)), [[mean], [1.0]])
