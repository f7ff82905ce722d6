"""Averages over sets of causes, against the enumeration of all sets and against worlds whose truth is known."""

from itertools import combinations

import numpy as np
from scipy.special import betaln
from scipy.stats import multivariate_normal

from mjx_tt.diagnosis.ball import model_averaging, scores
from mjx_tt.diagnosis.ball.model_averaging import averaged
from mjx_tt.diagnosis.ball.scores import Scores

BALLS, ROWS = 150, 6


def measured(columns: np.ndarray, target: np.ndarray) -> Scores:
    """Scores of columns (n, rows, K) and target (n, rows) of unit noise."""
    gram = columns.swapaxes(1, 2) @ columns
    right = (columns.swapaxes(1, 2) @ target[..., None])[..., 0]
    return Scores(gram.sum(axis=0), right.sum(axis=0), gram, right, 0.0, ())


def test_sets_are_visited_as_often_as_their_exact_probability():
    """All sixteen sets of four columns, their evidence by the density of the data under each."""
    rng = np.random.default_rng(3)
    columns = rng.standard_normal((BALLS, ROWS, 4))
    columns[..., 1] = 0.9 * columns[..., 0] + 0.3 * columns[..., 1]  # two that look alike
    scale = np.array([0.2, 0.2, 0.1, 0.1])
    target = columns @ np.array([0.12, 0.0, 0.09, 0.0]) + rng.standard_normal((BALLS, ROWS))
    flat, y = columns.reshape(-1, 4), target.ravel()
    every = [s for k in range(5) for s in combinations(range(4), k)]
    log = []
    for s in every:
        x = flat[:, list(s)] * scale[list(s)]
        density = multivariate_normal(cov=np.eye(len(y)) + x @ x.T).logpdf(y)
        log.append(density + betaln(len(s) + 1, 4 - len(s) + 1))
    exact = np.exp(np.array(log) - max(log))
    exact /= exact.sum()
    rated = measured(columns, target)
    sets = model_averaging.Sets(rated.gram, rated.right, scale, (0, 1, 2, 3))
    counts = model_averaging.visited(sets, (1,), rng, sweeps=4000)
    shares = np.array([counts.get(s, 0) for s in every]) / sum(counts.values())
    assert 0.02 < exact.max() < 0.95, "the case should leave open which set it is"
    np.testing.assert_allclose(shares, exact, atol=0.03)


def test_the_adjusted_curvature_is_that_from_ball_to_ball():
    """Balls that differ by more than their noise says, as the bootstrap over balls sees it."""
    rng = np.random.default_rng(5)
    n = 400
    columns = rng.standard_normal((n, ROWS, 2))
    own = 0.8 * rng.standard_normal((n, 1, 2)) * np.array([1.0, 0.1])  # effects that differ from ball to ball
    target = ((columns * (0.3 + own)).sum(axis=2)) + rng.standard_normal((n, ROWS))
    rated = measured(columns, target)
    gram, right = model_averaging.adjusted(rated, (0, 1))
    estimates = []
    for _ in range(600):
        drawn = rated.weighted(rng.multinomial(n, np.full(n, 1.0 / n)).astype(float))
        estimates.append(scores.solve(drawn, (0, 1)))
    np.testing.assert_allclose(np.linalg.solve(gram, right), scores.solve(rated, (0, 1)), rtol=1e-9)
    error = np.sqrt(np.diagonal(np.linalg.inv(gram)))
    np.testing.assert_allclose(error, np.std(estimates, axis=0), rtol=0.12)
    assert error[0] > 1.5 * np.sqrt(1.0 / rated.gram[0, 0]), "the noise's own error should be too small here"


def world(rng: np.random.Generator) -> tuple[Scores, np.ndarray]:
    """Twelve related columns, four to seven of which matter, many too little to be seen; sizes of Laplace's law."""
    k = 12
    mix = np.eye(k) + 0.5 * rng.standard_normal((k, k))
    columns = rng.standard_normal((BALLS, ROWS, k)) @ mix
    theta = np.zeros(k)
    true = rng.permutation(k)[: rng.integers(4, 8)]
    theta[true] = rng.laplace(0.0, 0.15, len(true))
    return measured(columns, columns @ theta + rng.standard_t(5, (BALLS, ROWS))), theta


def test_intervals_cover_where_a_chosen_set_is_too_small():
    """The set grown by the same threshold as the search's; by its own errors it covers less than it says."""
    rng = np.random.default_rng(0)
    hits, plain, found = 0, 0, 0
    scale = np.full(12, 0.2)
    for _ in range(60):
        rated, theta = world(rng)
        gains = scores.widened(rated, scores.all_gains(rated, tuple(range(12)), 2), tuple(range(12)), 14.0, 12)
        chosen = max(gains, key=lambda s: gains[s] - 14.0 * len(s))
        low, high = averaged(rated, range(12), chosen, scale, 140.0, rng).intervals(chosen, 0.9, rng)
        size, error = scores.solve(rated, chosen), np.sqrt(np.diagonal(scores.sandwich(rated, chosen)))
        true = theta[list(chosen)]
        hits += int(((low <= true) & (true <= high)).sum())
        plain += int((np.abs(size - true) < 1.645 * error).sum())
        found += len(chosen)
    assert found > 100
    assert plain / found < 0.70
    assert abs(hits / found - 0.9) < 3.0 * (0.9 * 0.1 / found) ** 0.5


def test_an_effect_that_others_replace_gets_an_interval_of_its_own():
    """Two columns that are all but one: no set needs the chosen one, whose interval still holds its estimate."""
    rng = np.random.default_rng(7)
    columns = rng.standard_normal((BALLS, ROWS, 3))
    columns[..., 1] = columns[..., 0] + 0.01 * columns[..., 1]
    target = columns[..., 0] * 0.5 + rng.standard_normal((BALLS, ROWS))
    rated = measured(columns, target)
    low, high = averaged(rated, (0, 1, 2), (1,), np.full(3, 0.5), 100.0, rng).intervals((1,), 0.9, rng)
    assert low[0] < scores.solve(rated, (1,))[0] < high[0]
    assert np.all(np.isfinite([low, high]))


def test_a_log_that_shows_no_effect_has_one_set():
    rng = np.random.default_rng(0)
    rated = measured(rng.standard_normal((BALLS, ROWS, 2)), rng.standard_normal((BALLS, ROWS)))
    sets = averaged(rated, (), (), np.full(2, 0.5), 100.0, rng)
    assert set(sets.counts) == {()} and not sets.draws(5, rng).any()
    assert sets.intervals((), 0.9, rng)[0].shape == (0,)


def test_draws_keep_what_is_known_of_effects_together():
    """Two columns that are nearly one: their sum is known, neither is; moments against the exact mixture's."""
    rng = np.random.default_rng(11)
    columns = rng.standard_normal((BALLS, ROWS, 3))
    columns[..., 1] = columns[..., 0] + 0.05 * columns[..., 1]
    target = 0.3 * columns[..., 0] + 0.3 * columns[..., 1] + rng.standard_normal((BALLS, ROWS))
    rated = measured(columns, target)
    sets = averaged(rated, (0, 1), (0, 1), np.full(4, 0.5), np.inf, rng)
    draws = sets.draws(20000, rng)
    assert draws.shape == (20000, 4) and not draws[:, 2:].any()
    assert draws[:, 0].std() > 4.0 * (draws[:, 0] + draws[:, 1]).std()
    share = {s: n / sum(sets.counts.values()) for s, n in sets.counts.items()}
    exact = np.zeros(2)
    for subset, probability in share.items():
        precision = sets.sets.gram[np.ix_(subset, subset)] + np.diag(np.full(len(subset), 4.0))
        exact[list(subset)] += probability * np.linalg.solve(precision, sets.sets.right[list(subset)])
    np.testing.assert_allclose(draws[:, :2].mean(axis=0), exact, atol=0.02)
