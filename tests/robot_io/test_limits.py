"""The kinematic limiter under requests that try to break it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_tt.robot import mjcf
from robot_io.contract import N_JOINTS
from robot_io.limits import LIMITS, limit_velocity

DT, TICKS, COLUMNS = 1 / 75, 400, 264  # 105,600 requests of eight velocities
LOWER, UPPER, V_MAX, A_MAX, MARGIN = (
    np.array(getattr(LIMITS, name))[:, None] for name in ("lower", "upper", "velocity", "acceleration", "margin")
)


@pytest.fixture(scope="module")
def requests():
    """(ticks, 8, columns) in units of twice the velocity limit: noise, bang-bang, resonant sweeps, constant pushes."""
    rng = np.random.default_rng(0)
    quarter = COLUMNS // 4
    shape = (TICKS, N_JOINTS, quarter)
    noise = rng.uniform(-1, 1, shape)
    hold = rng.integers(1, 60, shape[1:])  # ticks between the switches of bang-bang
    t = np.arange(TICKS)[:, None, None]
    bang = np.where((t // hold + rng.integers(0, 2, shape[1:])) % 2, 1.0, -1.0)
    frequency, phase = rng.uniform(0.1, 20, shape[1:]), rng.uniform(0, 2 * np.pi, shape[1:])
    resonant = np.sin(2 * np.pi * (frequency + 0.002 * t) * t * DT + phase)
    push = np.broadcast_to(np.where(rng.random(shape[1:]) < 0.5, 1.0, -1.0), shape)
    return np.concatenate([noise, bang, resonant, push], axis=2) * 2 * V_MAX


def home(columns=COLUMNS):
    return np.repeat(mjcf.home_qpos(mjcf.load_model())[:, None], columns, axis=1)


def integrate(limiter, requests, dtype):
    """Velocities and positions (ticks, 8, columns) when the limited velocity is integrated from rest at home."""
    position, velocity = home().astype(dtype), np.zeros((N_JOINTS, COLUMNS), dtype)
    velocities, positions = [], []
    for request in requests.astype(dtype):
        velocity = limiter(request, velocity, position)
        position = position + velocity * dtype(DT)
        velocities.append(velocity)
        positions.append(position)
    return np.array(velocities), np.array(positions)


def limited(request, previous, reference):
    return limit_velocity(request, previous, reference, DT)


def violations(velocities, positions):
    """Worst excess over each limit, relative to it."""
    change = np.diff(velocities, axis=0, prepend=np.zeros_like(velocities[:1])) / DT
    span = UPPER - LOWER
    return {
        "position": max(((positions - UPPER + MARGIN) / span).max(), ((LOWER + MARGIN - positions) / span).max()),
        "velocity": (np.abs(velocities) / V_MAX - 1).max(),
        "acceleration": (np.abs(change) / A_MAX - 1).max(),
    }


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 2e-4)], ids=["float64", "float32"])
def test_no_request_breaks_a_limit(requests, dtype, tolerance):
    velocities, positions = integrate(limited, requests, dtype)
    for limit, excess in violations(velocities.astype(float), positions.astype(float)).items():
        assert excess < tolerance, limit
    # The limits are used, not merely kept: some joints arrive at every margin and speeds at every maximum.
    assert (positions.max(axis=(0, 2)) > (UPPER - MARGIN - 0.01 * (UPPER - LOWER))[:, 0]).all()
    assert (positions.min(axis=(0, 2)) < (LOWER + MARGIN + 0.01 * (UPPER - LOWER))[:, 0]).all()
    assert (np.abs(velocities).max(axis=(0, 2)) > 0.95 * V_MAX[:, 0]).all()


def test_clipping_velocity_and_acceleration_alone_breaks_the_position_limits(requests):
    """Without the braking envelope the position limits break; and these tests can fail."""

    def clipped(request, previous, reference):
        return np.clip(np.clip(request, -V_MAX, V_MAX), previous - A_MAX * DT, previous + A_MAX * DT)

    def stopped(request, previous, reference):  # at the wall, whatever deceleration that takes
        return np.clip(np.clip(request, -V_MAX, V_MAX), (LOWER - reference) / DT, (UPPER - reference) / DT)

    assert violations(*integrate(clipped, requests, np.float64))["position"] > 0.1
    assert violations(*integrate(stopped, requests, np.float64))["acceleration"] > 1


@pytest.mark.parametrize(("x64", "atol"), [(True, 1e-12), (False, 2e-5)], ids=["float64", "float32"])
def test_jax_equals_numpy(requests, x64, atol):
    """On every request, from the same velocity and position: near a limit rounding grows from step to step."""
    dtype = np.float64 if x64 else np.float32
    velocities, positions = integrate(limited, requests, dtype)
    states = [x.swapaxes(0, 1) for x in (requests[1:].astype(dtype), velocities[:-1], positions[:-1])]
    with jax.enable_x64(x64):
        ours = jax.jit(lambda *state: limit_velocity(*state, DT, xp=jnp))(*states)
    assert ours.dtype == dtype
    np.testing.assert_allclose(ours.swapaxes(0, 1), velocities[1:], rtol=0, atol=atol)


def test_a_request_within_all_limits_passes_unchanged():
    small = 0.1 * A_MAX * DT * np.ones((N_JOINTS, 3))
    np.testing.assert_array_equal(limit_velocity(small, np.zeros_like(small), home(3), DT), small)
    np.testing.assert_array_equal(limit_velocity(small[:, 0], np.zeros(N_JOINTS), home(1)[:, 0], DT), small[:, 0])
