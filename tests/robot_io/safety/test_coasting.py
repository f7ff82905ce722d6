"""The arm's reference between two ticks, and its braking where no other tick follows."""

from __future__ import annotations

import numpy as np

from robot_io.limits import LIMITS
from robot_io.safety.coasting import HOLD_AFTER, Coasting

PERIOD, PATIENCE, STEP = 1 / 75, 0.03, np.array(LIMITS.acceleration) / 75
START, VELOCITY = np.arange(8) * 0.1, np.array([2.0, -1.0, 4.0, -4.0, 0.0, 7.0, -10.0, 0.5])


def coasting():
    made = Coasting(PERIOD, PATIENCE, STEP / PERIOD)
    made.ticked(START, VELOCITY, 10.0)
    return made


def test_on_time_it_goes_on_at_the_velocity_that_was_commanded():
    for since in (0.0, 0.5 * PERIOD, 0.99 * PATIENCE):
        position, velocity = coasting().at(10.0 + since)
        np.testing.assert_allclose(position, START + VELOCITY * since, rtol=0, atol=1e-12)
        assert (velocity == VELOCITY).all() and not coasting().missed(10.0 + since)


def test_without_another_tick_it_brakes_as_the_gate_does_then_stays_where_it_is_measured():
    """By one step of the acceleration limit a period; in straight stretches, period by period, by hand."""
    position, speed = START + VELOCITY * PATIENCE, np.abs(VELOCITY)
    time, periods = 10.0 + PATIENCE, 0
    while speed.max() > 1e-9:
        speed = np.maximum(speed - STEP, 0.0)
        for share in (0.01, 0.5, 0.99):
            told, velocity = coasting().at(time + share * PERIOD)
            moved = np.sign(VELOCITY) * speed * share * PERIOD
            np.testing.assert_allclose(told, position + moved, rtol=0, atol=1e-12)
            np.testing.assert_allclose(velocity, np.sign(VELOCITY) * speed, rtol=0, atol=1e-12)
        position, time, periods = position + np.sign(VELOCITY) * speed * PERIOD, time + PERIOD, periods + 1
    assert periods == np.ceil((np.abs(VELOCITY) / STEP).max()) and coasting().missed(time)
    told, velocity = coasting().at(time + HOLD_AFTER - 1e-3)
    np.testing.assert_allclose(told, position, rtol=0, atol=1e-12)
    assert not velocity.any() and coasting().at(time + HOLD_AFTER + 1e-3) is None


def test_before_the_first_tick_and_without_a_measurement_nothing_is_asked_of_the_arm():
    motion = Coasting(PERIOD, PATIENCE, STEP / PERIOD)
    assert motion.at(10.0) is None
    motion.ticked(np.full(8, np.nan), np.zeros(8), 10.0)
    assert motion.at(10.0) is None
