"""The arm's reference between two ticks, and its braking where no other tick follows."""

from __future__ import annotations

import numpy as np

from robot_io.contract import LIMITS
from robot_io.safety.coasting import HOLD_AFTER, PATIENCE, Coasting

PERIOD, A = 1 / 75, np.array(LIMITS.acceleration)
START, VELOCITY = np.arange(8) * 0.1, np.array([2.0, -1.0, 4.0, -4.0, 0.0, 7.0, -10.0, 0.5])


def coasting():
    made = Coasting(PERIOD, A)
    made.ticked(START, VELOCITY, 10.0)
    return made


def test_on_time_it_goes_on_at_the_velocity_that_was_commanded():
    for since in (0.0, 0.5 * PERIOD, 0.99 * PATIENCE * PERIOD):
        position, velocity = coasting().at(10.0 + since)
        np.testing.assert_allclose(position, START + VELOCITY * since, rtol=0, atol=1e-12)
        assert (velocity == VELOCITY).all()


def test_without_another_tick_it_brakes_at_the_limits_then_stays_where_it_is_measured():
    motion, step = coasting(), 1e-4
    moments = 10.0 + np.arange(0.0, 0.35, step)
    positions, velocities = (np.array(part) for part in zip(*(motion.at(now) for now in moments[:3000]), strict=True))
    assert (np.abs(np.diff(velocities, axis=0)) <= A * step * (1 + 1e-6)).all()
    moved = np.diff(positions, axis=0) / step
    np.testing.assert_allclose(moved, (velocities[1:] + velocities[:-1]) / 2, rtol=0, atol=1e-2)
    assert not velocities[-1].any()
    way = np.abs(VELOCITY) * PATIENCE * PERIOD + VELOCITY**2 / (2 * A)
    np.testing.assert_allclose(positions[-1], START + np.sign(VELOCITY) * way, rtol=0, atol=1e-12)
    longest = (np.abs(VELOCITY) / A).max()
    assert motion.at(10.0 + PATIENCE * PERIOD + longest + HOLD_AFTER - 1e-3) is not None
    assert motion.at(10.0 + PATIENCE * PERIOD + longest + HOLD_AFTER + 1e-3) is None


def test_before_the_first_tick_and_without_a_measurement_nothing_is_asked_of_the_arm():
    motion = Coasting(PERIOD, A)
    assert motion.at(10.0) is None
    motion.ticked(np.full(8, np.nan), np.zeros(8), 10.0)
    assert motion.at(10.0) is None
