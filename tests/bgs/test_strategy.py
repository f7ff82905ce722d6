from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import bgs
from bgs import optimizers, shaping, strategy

# Five pairs in two dimensions whose elites differ under every ranking.
DIRECTIONS = np.array([[1.0, 0.0, 1.0, 2.0, 0.0], [0.0, 1.0, 1.0, -1.0, 3.0]])
PLUS = np.array([1.0, 3.0, 0.0, 10.0, 8.0])
MINUS = np.array([2.0, 0.0, 0.5, 9.5, 8.25])
# D = (-1, 3, -.5, .5, -.25), k = int(.4 * 5) = 2, by hand:
#   abs    pairs 1, 0: sum D delta = (-1, 3);    returns 3 0 1 2,       mean 1.5,    s^2 = 5 / 4
#   signed pairs 1, 3: sum D delta = (1, 2.5);   returns 3 0 10 9.5,    mean 5.625,  s^2 = 72.6875 / 4
#   max    pairs 3, 4: sum D delta = (1, -1.25); returns 10 9.5 8 8.25, mean 8.9375, s^2 = 2.796875 / 4
BY_HAND = {
    "abs": ((-1.0, 3.0), 1.25),
    "signed": ((1.0, 2.5), 18.171875),
    "max": ((1.0, -1.25), 0.69921875),
}

_shape = jax.jit(shaping.shape, static_argnames=("elite_fraction", "rank", "weighting", "normalise"))


def _tell(config, directions=DIRECTIONS, plus=PLUS, minus=MINUS, theta=(1.0, -1.0), dtype=jnp.float32):
    state = bgs.init(jnp.asarray(theta, dtype), config)
    return _update(state, config, directions, plus, minus)


def _update(state, config, directions=DIRECTIONS, plus=PLUS, minus=MINUS):
    dtype = state.theta.dtype
    population = bgs.perturb(state, jnp.asarray(directions, dtype), config)
    return bgs.tell(state, population, jnp.asarray(np.concatenate([plus, minus]), dtype), config)


def _config(**options):
    return bgs.BGSConfig(**{"num_directions": 5, "elite_fraction": 0.4, "step": optimizers.make("sgd", 0.1)} | options)


@pytest.mark.parametrize("rank", shaping.RANKS)
@pytest.mark.parametrize("x64", [False, True])
def test_update_by_hand(rank, x64):
    total, variance = BY_HAND[rank]
    with jax.enable_x64(x64), jax.numpy_dtype_promotion("strict"):
        dtype = jnp.float64 if x64 else jnp.float32
        state, info = _tell(_config(rank=rank), dtype=dtype)
        assert state.theta.dtype == dtype
    gradient = np.array(total) / (2 * math.sqrt(variance))
    tolerance = 1e-12 if x64 else 1e-6
    np.testing.assert_allclose(state.theta, np.array([1.0, -1.0]) + 0.1 * gradient, rtol=tolerance)
    np.testing.assert_allclose(info.gradient_norm, np.hypot(*gradient), rtol=tolerance)
    np.testing.assert_allclose(info.update_norm, 0.1 * np.hypot(*gradient), rtol=1e-6 if not x64 else 1e-12)
    np.testing.assert_allclose(info.elite_std, math.sqrt(variance), rtol=tolerance)
    np.testing.assert_allclose(info.mean_return, 4.225, rtol=tolerance)
    assert (info.elites, info.failed_pairs, state.updates) == (2, 0, 1)


def test_update_without_reward_normalisation_by_hand():
    state, _ = _tell(_config(normalise="none"))
    np.testing.assert_allclose(state.theta, [1.0 - 0.1 / 2, -1.0 + 0.3 / 2], rtol=1e-6)


@pytest.mark.parametrize(("rank", "weighting"), [("abs", "returns"), ("signed", "returns"), ("max", "centered_rank")])
def test_failed_pair_counts_as_never_evaluated(rank, weighting):
    config = _config(rank=rank, weighting=weighting, elite_fraction=0.5)
    left = [0, 2, 4]
    removed, expected = _tell(config, DIRECTIONS[:, left], PLUS[left], MINUS[left])
    for bad in (np.nan, np.inf, -np.inf):
        plus, minus = PLUS.copy(), MINUS.copy()
        plus[1], minus[3] = bad, bad
        dropped, info = _tell(config, plus=plus, minus=minus)
        np.testing.assert_allclose(dropped.theta, removed.theta, rtol=1e-6)
        assert (info.failed_pairs, info.elites) == (2, 1)
        np.testing.assert_allclose(info.mean_return, expected.mean_return, rtol=1e-6)


def test_update_with_every_pair_failed_changes_nothing_but_the_counter():
    config = _config(step=optimizers.make("adam", 0.1), ema_decay=0.5)
    moving, _ = _tell(config)
    nan = np.full(5, np.nan, np.float32)
    state, info = _update(moving, config, plus=nan, minus=nan)
    jax.tree.map(np.testing.assert_array_equal, dataclasses.replace(state, updates=moving.updates), moving)
    assert (state.updates, info.failed_pairs, info.elites, info.update_norm) == (2, 5, 0, 0)
    assert np.isnan(info.mean_return)


@pytest.mark.parametrize(
    ("elite_fraction", "pairs", "elites"), [(0.01, 10, 1), (0.3, 200, 60), (0.6, 5, 3), (0.7, 10, 7), (1.0, 4, 4)]
)
def test_number_of_elites(elite_fraction, pairs, elites):
    plus, minus = np.random.default_rng(0).normal(size=(2, pairs))
    shaped = _shape(plus, minus, elite_fraction)
    assert shaped.n_elites == np.sum(shaped.elites) == elites


def test_centered_ranks_are_scipys():
    rng = np.random.default_rng(0)
    plus, minus = rng.integers(0, 6, (2, 9)).astype(np.float32)  # many ties
    shaped = _shape(plus, minus, 1.0, weighting="centered_rank", normalise="none")
    ranks = (stats.rankdata(np.concatenate([plus, minus])) - 1) / 17 - 0.5
    np.testing.assert_allclose(shaped.weights, (ranks[:9] - ranks[9:]) / 9, atol=1e-7)


def test_gradient_of_a_quadratic_is_exact():
    # Antithetic differences cancel the curvature and a full orthogonal basis spans everything, so without elites and
    # normalisation the estimate is 2 sigma times the gradient, to rounding.
    with jax.enable_x64(True):
        d, rng = 12, np.random.default_rng(1)
        hessian, slope = rng.normal(size=(d, d)), rng.normal(size=d)
        hessian = hessian + hessian.T
        value = lambda x: 0.5 * np.einsum("ib,ij,jb->b", x, hessian, x) + slope @ x  # noqa: E731
        config = bgs.BGSConfig(num_directions=d, elite_fraction=1.0, normalise="none", step=optimizers.make("sgd", 1.0))
        theta = rng.normal(size=d)
        state = bgs.init(theta, config)
        population = bgs.ask(jax.random.key(0), state, config)
        after, _ = bgs.tell(state, population, jnp.asarray(value(np.asarray(population.members))), config)
        np.testing.assert_allclose(after.theta - theta, 2 * config.sigma * (hessian @ theta + slope), rtol=1e-10)


def test_perturbations_follow_their_schedule():
    config = bgs.BGSConfig(
        num_directions=1, sigma=optimizers.cosine(0.4, 0.1, 10, hold=0.5), step=optimizers.make("sgd", 1e-9)
    )
    state, spread, one = bgs.init(jnp.zeros(2), config), [], jnp.array([[1.0], [0.0]])
    for _ in range(12):
        population = bgs.perturb(state, one, config)
        spread.append(float(population.members[0, 0]))
        state, _ = bgs.tell(state, population, jnp.array([1.0, 0.0]), config)
    fall = [0.1 + 0.3 * (1 + math.cos(math.pi * k / 5)) / 2 for k in range(6)]
    np.testing.assert_allclose(spread, [0.4] * 5 + fall + [0.1], rtol=1e-6)


_PLAIN = optimizers.make("sgd", optimizers.cosine(0.2, 0.001, 400))
_ADAM = optimizers.make("adam", optimizers.cosine(0.1, 0.001, 400), b2=0.99)


@pytest.mark.parametrize(
    "config",
    [
        bgs.BGSConfig(num_directions=20, step=_PLAIN),
        bgs.BGSConfig(num_directions=20, step=_PLAIN, orthogonal=False),
        bgs.BGSConfig(num_directions=20, step=_ADAM, elite_fraction=1.0, ema_decay=0.9),
        bgs.BGSConfig(num_directions=20, step=_ADAM, elite_fraction=1.0, weighting="centered_rank", scale="chi"),
    ],
    ids=["plain", "gaussian", "adam", "ranks"],
)
def test_finds_the_top_of_a_quadratic(config):
    d = 30
    best = jnp.linspace(-1, 1, d)
    stiffness = jnp.linspace(1, 5, d)[:, None]

    def update(state, key):
        population = bgs.ask(key, state, config)
        returns = -jnp.sum(stiffness * (population.members - best[:, None]) ** 2, axis=0)
        return bgs.tell(state, population, returns, config)

    start = bgs.init(jnp.zeros(d), config)
    end, info = jax.jit(lambda state: jax.lax.scan(update, state, jax.random.split(jax.random.key(0), 400)))(start)
    distance = jnp.linalg.norm(best)
    assert jnp.linalg.norm(end.theta - best) < 0.02 * distance
    assert jnp.linalg.norm(end.average - best) < 0.02 * distance
    assert info.mean_return[-1] > info.mean_return[0]


def test_update_norm_in_pure_noise():
    # Closed form: orthogonal directions of norm sqrt(d) give alpha sqrt(d / k) sqrt(E D^2) / s over the elites, where
    # D ~ N(0, 2) beyond its 15 % tails and an elite return is the independent half sum plus or minus D / 2.
    config, d = bgs.BGSConfig(), 976
    cut = stats.norm.isf(0.15)
    mean_sq_d = 2 * (1 + cut * stats.norm.pdf(cut) / 0.15)
    expected = 0.00375 * math.sqrt(d / 60) * math.sqrt(mean_sq_d / (0.5 + mean_sq_d / 4))
    assert expected == pytest.approx(0.026, abs=0.0005)
    state = bgs.init(jnp.zeros(d), config)
    norms = []
    for key in jax.random.split(jax.random.key(0), 6):
        key_directions, key_returns = jax.random.split(key)
        returns = jax.random.normal(key_returns, (2, 200)).reshape(-1)
        norms.append(bgs.tell(state, bgs.ask(key_directions, state, config), returns, config)[1].update_norm)
    assert np.mean(norms) == pytest.approx(expected, rel=0.05)


def test_moving_average_in_closed_form():
    config = _config(ema_decay=0.9)
    state = bgs.init(jnp.array([1.0, -1.0]), config)
    expected = 0.9**4 * np.array([1.0, -1.0])
    for t in range(1, 5):
        state, _ = _update(state, config, plus=PLUS + t, minus=MINUS - t)
        expected += 0.1 * 0.9 ** (4 - t) * np.asarray(state.theta)
    np.testing.assert_allclose(state.average, expected, rtol=1e-6)
    off, _ = _tell(_config())
    np.testing.assert_array_equal(off.average, off.theta)


def test_adam_is_the_textbook_step_uphill():
    # The first Adam step is the learning rate times the sign of the gradient (Kingma and Ba 2015, section 2.1).
    state, _ = _tell(_config(step=optimizers.make("adam", 0.01)))
    np.testing.assert_allclose(state.theta, [1.0 - 0.01, -1.0 + 0.01], rtol=1e-5)


@pytest.mark.parametrize("kind", optimizers.KINDS)
def test_weight_decay_shrinks_by_rate_times_decay(kind):
    plain, _ = _tell(_config(step=optimizers.make(kind, 0.01)))
    decayed, _ = _tell(_config(step=optimizers.make(kind, 0.01, weight_decay=0.5)))
    before = np.array([1.0, -1.0])  # see the test above
    np.testing.assert_allclose(np.asarray(decayed.theta) - np.asarray(plain.theta), -0.005 * before, rtol=1e-3)


def test_cosine_schedule_in_closed_form():
    schedule = optimizers.cosine(0.01, 0.001, updates=200, hold=0.25)
    for update in (0, 10, 49, 50, 51, 100, 150, 200, 1000):
        progress = min(max((update - 50) / 150, 0), 1)
        expected = 0.001 + 0.009 * 0.5 * (1 + math.cos(math.pi * progress))
        np.testing.assert_allclose(schedule(update), expected, rtol=1e-5)


def test_piecewise_schedule():
    schedule = optimizers.piecewise(0.01, ((10, 0.1), (30, 0.002)))
    values = [float(schedule(update)) for update in (0, 9, 10, 29, 30, 500)]
    np.testing.assert_allclose(values, [0.01, 0.01, 0.1, 0.1, 0.002, 0.002], rtol=1e-6)


def test_equal_configurations_share_one_compilation():
    before = strategy._sample._cache_size(), bgs.tell._cache_size()
    for seed in range(3):
        config = bgs.BGSConfig(
            num_directions=7, step=optimizers.make("adam", optimizers.cosine(0.01, 0.001, 50)), ema_decay=0.98
        )
        state = bgs.init(jnp.zeros(11), config)
        for key in jax.random.split(jax.random.key(seed), 3):
            state, _ = bgs.tell(state, bgs.ask(key, state, config), jax.random.normal(key, 14), config)
    assert (strategy._sample._cache_size() - before[0], bgs.tell._cache_size() - before[1]) == (1, 1)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("num_directions", 0),
        ("num_directions", 2.5),
        ("sigma", 0.0),
        ("sigma", math.nan),
        ("elite_fraction", 0.0),
        ("elite_fraction", 1.1),
        ("rank", "top"),
        ("weighting", "z"),
        ("normalise", "max"),
        ("scale", "unit"),
        ("ema_decay", 1.0),
        ("step", "adam"),
    ],
)
def test_bad_configuration_names_key_value_and_choice(key, value):
    with pytest.raises(ValueError, match=rf"BGSConfig\.{key} = {value!r}, allowed is"):
        bgs.BGSConfig(**{key: value})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: optimizers.make("rmsprop"), "kind = 'rmsprop'.*sgd.*adam"),
        (lambda: optimizers.make("sgd", -1.0), "learning_rate = -1.0"),
        (lambda: optimizers.make("adam", b2=1.0), "b2 = 1.0"),
        (lambda: optimizers.make("adam", weight_decay=-0.1), "weight_decay = -0.1"),
        (lambda: optimizers.cosine(0.1, 0.0, 10), "final = 0.0"),
        (lambda: optimizers.cosine(0.1, 0.01, 10, hold=1.0), "hold = 1.0"),
        (lambda: optimizers.cosine(0.1, 0.01, 0), "updates = 0"),
        (lambda: optimizers.piecewise(0.1, ((20, 0.2), (10, 0.1))), "increasing"),
    ],
)
def test_bad_steps_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()
