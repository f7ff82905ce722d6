"""The tracker's errors, each against its closed form or SciPy, in episodes with a ball that flies straight."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation

from ballmodel import constants as c
from mjx_tt.sim import model
from mjx_tt.sim.model import SensingParams
from mjx_tt.sim.sensors import FRESH, Lag
from tests.support import scripted_episodes
from tests.support.scripted_episodes import TICKS, episodes, play, task

T = 1 / 75
START, VELOCITY = np.array([0.2, 1.2, 0.5]), np.array([0.3, -0.6, 0.1])
CAMERA = {
    "camera_scale": 1.01,
    "camera_rotation_x": 0.02,
    "camera_rotation_y": -0.03,
    "camera_rotation_z": 0.05,
    "camera_distortion": 0.004,
}
DELAY = 0.05
# One episode each: what the tracker does in it.
CASES = (
    {},
    CAMERA,
    {"smoothing": 0.03},
    {"jitter": 0.004},
    {"clock_rate": 1.2},
    {"clock_rate": 3.0},
    {"smoothing": 0.001},
    CAMERA | {"smoothing": 0.05, "ball_offset_y": 0.01},
)


@pytest.fixture(scope="module")
def seen():
    """Observed ball (TICKS, 3, P)."""
    names = {name for case in CASES for name in case}
    values = {f"sensing.{n}": jnp.array([c.get(n, getattr(SensingParams(), n)) for c in CASES]) for n in names}
    still_air = {"ball.flight.drag_coefficient": 0.0}
    with jax.enable_x64(True):
        simulation = model.with_values(scripted_episodes.model(gravity=0.0), values | still_air)
        batch = episodes(START, VELOCITY, {"ball_observation": DELAY}, simulation)
        record = play(task(), batch)
    assert record.live.all()
    return record.controller[:, :3]


def straight(delay):
    """The ball (TICKS, 3), which stood still at its start before the episode."""
    return START + VELOCITY * np.maximum(np.arange(TICKS) * T - delay, 0.0)[:, None]


def through_camera(p):
    """By SciPy: extrinsic turns about the table's x, y, then z axis."""
    turned = Rotation.from_euler("xyz", [CAMERA[f"camera_rotation_{a}"] for a in "xyz"]).as_matrix()
    bent = p * (1 + CAMERA["camera_distortion"] * (p**2).sum(axis=-1, keepdims=True))
    return CAMERA["camera_scale"] * bent @ turned.T


def filtered(tau, delay):
    """By an adaptive solver of df/dt = (p - f) / tau."""
    times = np.maximum(np.arange(TICKS) * T - delay, 0.0)

    def slope(t, f):
        return (START + VELOCITY * t - f) / tau

    end, exact = (0, TICKS * T), {"rtol": 1e-10, "atol": 1e-12}
    return solve_ivp(slope, end, START, "Radau", dense_output=True, **exact).sol(times).T


def test_a_nominal_tracker_shows_the_truth(seen):
    np.testing.assert_allclose(seen[..., 0], straight(DELAY), atol=1e-9)


def test_camera_scales_turns_and_bends(seen):
    np.testing.assert_allclose(seen[..., 1], through_camera(straight(DELAY)), atol=1e-9)
    assert np.abs(seen[..., 1] - seen[..., 0]).max() > 0.02


@pytest.mark.parametrize(("case", "tau"), [(2, 0.03), (6, 0.001)])
def test_smoothing_is_a_first_order_filter(seen, case, tau):
    """Between substeps the captured position is interpolated, which the first few milliseconds show."""
    wanted = filtered(tau, DELAY)
    np.testing.assert_allclose(seen[..., case], wanted, atol=3e-4)
    late = np.arange(TICKS) * T > DELAY + 0.1
    np.testing.assert_allclose(seen[late, :, case], wanted[late], atol=1e-6)
    # Long after the start it trails a straight ball by its time constant.
    np.testing.assert_allclose(seen[-1, :, case], straight(DELAY + tau)[-1], atol=1e-6)


def test_camera_filter_and_offset_together(seen):
    wanted = through_camera(filtered(0.05, DELAY)) + np.array([0.0, 0.01, 0.0])
    np.testing.assert_allclose(seen[..., 7], wanted, atol=3e-4)


def test_jitter_is_a_gaussian_error_in_time(seen):
    error = (seen[..., 3] - seen[..., 0])[np.arange(TICKS) * T > DELAY + T]
    late = error @ VELOCITY / (VELOCITY @ VELOCITY)
    np.testing.assert_allclose(error, late[:, None] * VELOCITY, atol=1e-9)  # along the flight and nowhere else
    assert stats.kstest(late, stats.norm(0.0, 0.004).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(late[1:], late[:-1])[0, 1]) < 4.5 / np.sqrt(len(late))


def test_a_fast_clock_stretches_the_trackers_latency(seen):
    np.testing.assert_allclose(seen[..., 4], straight(1.2 * DELAY), atol=1e-9)
    longest = task().config.max_observation_latency
    assert 3.0 * DELAY > longest
    np.testing.assert_allclose(seen[..., 5], straight(longest), atol=1e-9)


def butterworth(t, memory):
    """Answer [s] to a unit jump of the velocity: s / (s^3 + 2 w s^2 + 2 w^2 s + w^3), w = 1 / memory, negative."""
    x, b = t / memory, np.sqrt(0.75)
    return memory * (np.exp(-x) - np.exp(-x / 2.0) * (np.cos(b * x) + np.sin(b * x) / np.sqrt(3.0)))


def test_a_filter_of_constant_acceleration_fades_behind_a_jump_of_the_velocity():
    memory, step, kick = 0.02, 2e-5, np.array([1.0, -2.0, 4.0])

    def advance(lag, _):
        lag = lag.predict(step, still, 0.0).correct(step, step, memory, 1e6)
        return lag, lag.position

    with jax.enable_x64(True):
        still = jnp.zeros(3)
        lag = Lag.settle(step, memory, still).predict(0.0, jnp.array(kick), 0.0)
        _, error = jax.lax.scan(advance, lag, length=5000)
    wanted = butterworth(step * np.arange(1, 5001)[:, None], memory) * kick
    np.testing.assert_allclose(error, wanted, atol=5e-3 * np.abs(wanted).max())


def white_jerk(dt):
    """Matrices (3, 3) of position, velocity and acceleration after ``dt`` [s], and of what unit density adds."""
    move = np.array([[1.0, dt, dt**2 / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    grown = [[dt**4 / 20, dt**3 / 8, dt**2 / 6], [dt**3 / 8, dt**2 / 3, dt / 2], [dt**2 / 6, dt / 2, 1.0]]
    return move, dt * np.array(grown)


@pytest.mark.parametrize("memory", [0.004, 0.012, 0.05])
def test_a_settled_filters_covariance_solves_riccatis_equation(memory):
    """By SciPy's solver, in seconds and metres, at 125 Hz and 3 mm of noise."""
    dt, variance = 0.008, 0.003**2
    q = variance * dt / memory**6
    move, grown = white_jerk(dt)
    before = solve_discrete_are(move.T, np.eye(3, 1), q * grown, np.array([[variance]]))
    gain = before[:, :1] / (before[0, 0] + variance)
    after = (before - gain @ before[:1]) / variance * np.outer(*2 * [memory ** np.arange(3)])
    with jax.enable_x64(True):
        covariance = Lag.settle(dt, memory, jnp.zeros(3)).covariance
    np.testing.assert_allclose(covariance, after[np.triu_indices(3)], rtol=2e-2)


def test_a_filter_follows_the_textbooks_recursion_after_it_opened():
    """Opened wide by a surprise, shut from then on, a sample missing: matrices in seconds and metres."""
    memory, kick = 0.012, 5.0
    times = np.array([0.008, 0.008, 0.016, 0.008, 0.008, 0.008])
    gates = [0.02, *[1e3] * 5]
    q = 0.008 / memory**6
    seen, wanted = [], []
    with jax.enable_x64(True):
        lag = Lag.settle(0.008, memory, jnp.zeros(3))
        covariance = np.zeros((3, 3))
        covariance[np.triu_indices(3)] = lag.covariance
        covariance = covariance + np.triu(covariance, 1).T
        covariance = covariance / np.outer(*2 * [memory ** np.arange(3)])
        state = np.zeros(3)
        for i, (dt, gate) in enumerate(zip(times, gates, strict=True)):
            hit = kick if i == 0 else 0.0
            lag = lag.predict(dt, jnp.array([0.0, 0.0, hit]), dt).correct(dt, 0.008, memory, gate)
            move, grown = white_jerk(dt)
            state = move @ state - np.array([dt * hit, hit, 0.0])
            covariance = move @ covariance @ move.T + q * grown
            if i == 0:
                covariance = covariance + FRESH * np.diag([1.0, 0.008**-2, 0.008**-4])
            gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
            state, covariance = state - gain * state[0], covariance - np.outer(gain, covariance[0])
            seen.append(lag.position[2])
            wanted.append(state[0])
    np.testing.assert_allclose(seen, wanted, rtol=1e-6)


@pytest.mark.parametrize("memory", [0.0, 1e-9, 1e-6, 1e-4, 8e-4])
def test_a_filter_of_hardly_any_memory_shows_nothing(memory):
    """Of 40 mm of surprise, and whatever came before."""
    lag = Lag.settle(0.008, memory, jnp.zeros(3)).predict(0.008, jnp.array([0.0, 0.0, 5.0]), 0.008)
    for _ in range(20):
        lag = lag.correct(0.008, 0.008, memory, 1.0)
        assert float(jnp.abs(lag.position).max()) < 1e-5
        lag = lag.predict(0.008, jnp.zeros(3), 0.0)


def test_a_filter_of_constant_acceleration_is_wrong_behind_a_bounce_in_an_episode():
    """A ball dropped without drag: bounce and the error behind it in closed form, sampled at the substeps' rate."""
    height, memory, g = 0.8, 0.04, 9.81
    values = {"sensing.filter_time": jnp.full(8, memory).at[0].set(0.0), "sensing.filter_gate": jnp.full(8, 5.0)}
    values["ball.flight.drag_coefficient"] = jnp.zeros(8)
    with jax.enable_x64(True):
        simulation = model.with_values(scripted_episodes.model(), values)
        at = np.array([0.0, -0.6, c.BALL_RADIUS + height])
        record = play(task(), episodes(at, np.zeros(3), None, simulation))
    ball = record.controller[:, :3]
    error = ball[:, 2, 1] - ball[:, 2, 0]
    since = np.maximum(np.arange(TICKS) * T - np.sqrt(2.0 * height / g), 0.0)
    kick = (1.0 + c.TABLE_RESTITUTION) * np.sqrt(2.0 * g * height)
    wanted = kick * butterworth(since, memory)
    first = (since > 0.0) & (since < 0.2)
    assert np.abs(wanted[first]).max() > 0.06
    np.testing.assert_allclose(error[first], wanted[first], atol=0.15 * np.abs(wanted).max())
    np.testing.assert_allclose(error[since == 0.0], 0.0, atol=1e-9)
