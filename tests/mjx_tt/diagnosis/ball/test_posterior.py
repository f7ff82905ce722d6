"""Errors that are stated of all effects together."""

from __future__ import annotations

import numpy as np

from mjx_tt.diagnosis.ball.posterior import stated


def test_an_error_besides_takes_the_others_along():
    """As the spread of draws of which one effect is moved by the error, and the others as their correlation has it."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    covariance = root @ root.T
    draws = rng.multivariate_normal(np.zeros(4), covariance, 400_000)
    moved = draws + rng.normal(0.0, 0.7, (len(draws), 1)) * covariance[2] / covariance[2, 2]
    np.testing.assert_allclose(stated(covariance, (2, 0.7)), moved.std(axis=0), rtol=0.01)
    np.testing.assert_allclose(stated(covariance), draws.std(axis=0), rtol=0.01)
