"""Impacts against closed forms and conserved quantities."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ballmodel import constants as c
from ballmodel.contact import (
    NET,
    TABLE,
    PaddleParams,
    SurfaceParams,
    box_gap,
    elevation,
    impact,
    restitution_at,
    surface_frame,
    surface_gap,
)

UP = np.array([0.0, 0.0, 1.0])
R, M = c.BALL_RADIUS, c.BALL_MASS
INERTIA = 2 / 3 * M * R**2


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def slip(velocity, spin, normal=UP):
    """Velocity of the contact point along the surface, by NumPy."""
    v = velocity + np.cross(spin, -R * normal)
    return v - (v @ normal) * normal


def bounce(params, velocity, spin, normal=UP):
    return tuple(np.array(v) for v in impact(params, np.array(velocity), np.array(spin), normal, R))


def random_impacts(n=200):
    rng = np.random.default_rng(3)
    for _ in range(n):
        normal = rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        velocity = rng.normal(size=3) * 5
        velocity -= normal * (velocity @ normal + abs(rng.normal()) * 3)  # towards the surface
        yield velocity, rng.normal(size=3) * 80, normal


def test_sliding_bounce_loses_the_coulomb_impulse():
    params = SurfaceParams(0.93, 0.0, 0.25, 0.0)
    velocity, spin = bounce(params, [0.0, -8.0, -2.0], [0.0, 0.0, 0.0])
    lost = 0.25 * 1.93 * 2.0
    np.testing.assert_allclose(velocity, [0.0, -8.0 + lost, 0.93 * 2.0], rtol=1e-12)
    np.testing.assert_allclose(spin, [lost * 3 / (2 * R), 0, 0], rtol=1e-12)  # topspin for a ball towards -y


def test_sticking_bounce_rolls_away():
    params = SurfaceParams(0.93, 0.0, 0.25, 0.0)
    velocity, spin = bounce(params, [0.1, -0.8, -3.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(velocity[:2], [0.1 * 0.6, -0.8 * 0.6], rtol=1e-9)  # a thin shell keeps 3/5
    np.testing.assert_allclose(slip(velocity, spin), 0.0, atol=1e-9)


def test_a_table_that_springs_back_reverses_the_slip_that_it_grips():
    params = SurfaceParams(0.93, 0.0, 1e3, 0.0, tangential_restitution=0.15)  # so rough that every ball is gripped
    for velocity, spin, normal in random_impacts(50):
        v, w = bounce(params, velocity, spin, normal)
        np.testing.assert_allclose(slip(v, w, normal), -0.15 * slip(velocity, spin, normal), atol=1e-9)


def test_impacts_keep_angular_momentum_and_add_no_energy():
    """The momentum is that about the contact point."""

    def energy(v, w):
        return 0.5 * M * v @ v + 0.5 * INERTIA * w @ w

    for params in (
        SurfaceParams(0.9, 0.01, 0.2, 0.0),
        SurfaceParams(1.0, 0.0, 5.0, 0.0, tangential_restitution=1.0),
        PaddleParams(1.0, 0.0),
    ):
        for velocity, spin, normal in random_impacts():
            v, w = bounce(params, velocity, spin, normal)
            before = INERTIA * spin + M * np.cross(R * normal, velocity)
            after = INERTIA * w + M * np.cross(R * normal, v)
            np.testing.assert_allclose(after, before, atol=1e-12)
            assert energy(v, w) <= energy(velocity, spin) * (1 + 1e-12)


def test_a_table_gives_back_normal_speed_and_its_friction_opposes_slip_within_the_cone():
    mu = 0.2
    for velocity, spin, normal in random_impacts():
        v, w = bounce(SurfaceParams(0.9, 0.0, mu, 0.0), velocity, spin, normal)
        assert v @ normal == pytest.approx(-0.9 * (velocity @ normal), rel=1e-10)
        change = v - velocity
        tangential = change - (change @ normal) * normal
        assert tangential @ slip(velocity, spin, normal) <= 0.0
        assert np.linalg.norm(tangential) <= mu * (change @ normal) * (1 + 1e-9)
        assert slip(v, w, normal) @ slip(velocity, spin, normal) >= -1e-9  # Coulomb friction never reverses it


def test_rubber_scales_the_slip_by_one_minus_five_halves_of_its_gain():
    for velocity, spin, normal in random_impacts(50):
        paddle_velocity = np.array([0.5, 1.0, -0.3])
        v, w = impact(PaddleParams(), velocity, spin, normal, R, paddle_velocity)
        before = slip(velocity - paddle_velocity, spin, normal)
        after = slip(np.array(v) - paddle_velocity, np.array(w), normal)
        np.testing.assert_allclose(after, (1 - 2.5 * 0.68) * before, atol=1e-10)


def test_rubber_restitution_falls_with_speed_and_stays_physical():
    params = PaddleParams()
    assert float(restitution_at(params, -5.0)) == pytest.approx(0.917 - 0.0217 * 5.0)
    assert float(restitution_at(params, 100.0)) == 0.0


def test_box_gap_is_the_nearest_points_distance():
    rng = np.random.default_rng(4)
    for box in (TABLE, NET):
        corners = [np.array(box.centre) + s * np.array(box.half) for s in (-1, 1)]
        for point in rng.uniform(-1.6, 1.6, (100, 3)):
            nearest = np.minimum(np.maximum(point, corners[0]), corners[1])
            gap, distance = box_gap(box, 0.0, point)
            np.testing.assert_allclose(np.array(gap), point - nearest, atol=1e-12)
            assert float(distance) == pytest.approx(np.linalg.norm(point - nearest), abs=1e-9)


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.02, -0.01), (-0.3, 0.4)])
def test_a_tilted_surface_has_the_slopes_and_the_distance_of_its_plane(slopes):
    a, b = slopes
    surface = SurfaceParams(0.9, 0.0, 0.2, 0.05, a, b)
    frame = np.array(surface_frame(surface))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    np.testing.assert_allclose(frame[2], np.array([-a, -b, 1]) / np.sqrt(1 + a * a + b * b), atol=1e-12)
    rng = np.random.default_rng(5)
    for x, y, z in zip(*rng.uniform(-0.5, 0.5, (2, 20)), rng.uniform(0.6, 1.0, 20), strict=True):
        gap, distance = surface_gap(TABLE, surface, np.array([x, y, z]))
        over = z - 0.05 - a * x - b * y
        assert float(elevation(surface, np.array([x, y, z]))) == pytest.approx(over, abs=1e-12)
        assert float(distance) == pytest.approx(over / np.sqrt(1 + a * a + b * b), abs=1e-12)
        np.testing.assert_allclose(np.array(gap), frame[2] * float(distance), atol=1e-12)
