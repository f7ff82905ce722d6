"""Paths between control ticks, against flights that are known in closed form."""

import numpy as np

from experiments.view.replay import RATE, next_landing, upsample

PERIOD, G = 1 / 75, 9.81


def falling(time: np.ndarray, bounce: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity (n, 3) of a ball that bounces without loss at z = 0.02 m at the time ``bounce``."""
    down, speed = 0.02 + 0.5 * G * bounce**2, G * bounce
    since = np.maximum(time - bounce, 0.0)
    after = time > bounce
    z = np.where(after, 0.02 + speed * since - 0.5 * G * since**2, down - 0.5 * G * time**2)
    vz = np.where(after, speed - G * since, -G * time)
    position = np.stack([0.3 * time, 1.0 - 4.0 * time, z], axis=1)
    return position, np.stack([np.full_like(time, 0.3), np.full_like(time, -4.0), vz], axis=1)


def test_between_ticks_a_ball_flies_its_parabola_and_turns_where_it_bounces():
    ticks, frames = np.arange(40) * PERIOD, np.arange(4 * 39 + 1) / RATE
    bounce = 18.3 * PERIOD
    path = upsample(*falling(ticks, bounce), PERIOD, 4)
    true, _ = falling(frames, bounce)
    free = np.abs(frames - bounce) > PERIOD
    np.testing.assert_allclose(path[free], true[free], atol=1e-9)
    np.testing.assert_allclose(path, true, atol=1.5e-3)  # straight lines along both velocities, for one tick


def test_the_next_landing_is_the_bounce_and_afterwards_the_height_of_the_table_beside_it():
    ball = falling(np.arange(0, 0.72, 1 / RATE), 0.25)[0]
    ball = np.concatenate([ball, np.array([[0.2, -1.9, 0.05], [0.2, -1.95, -0.05], [0.2, -2.0, -0.2]])])
    landing = next_landing(ball)
    np.testing.assert_allclose(landing[0], [0.3 * 0.25, 1.0 - 4.0 * 0.25], atol=0.02)
    np.testing.assert_allclose(landing[200], [0.2, -1.95])
    assert np.isnan(landing[-1]).all()
