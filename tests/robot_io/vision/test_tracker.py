"""Triangulation and tracking of balls that fly by the simulation's step, from detections with errors and clutter."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ballmodel import flight
from ballmodel.kalman import Physics, move
from ballmodel.state import BallState
from robot_io.vision import rig
from robot_io.vision.tracker import BallTracker
from robot_io.vision.triangulation import Detection, predict_deviation, triangulate

CAMERAS = rig.standard().cameras
PERIOD = 0.008


@cache
def fly() -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities (n, 3) at 1 kHz of a ball with spin that bounces once."""
    starts = ([0.2, 1.3, 0.3], [-0.4, -5.0, 1.8], [30.0, 5.0, -10.0])
    ball = BallState(*(jnp.array(start)[:, None] for start in starts))

    def advance(ball, _):
        return flight.step(flight.ball_params(), ball, 1e-3)[0], (ball.position[:, 0], ball.velocity[:, 0])

    _, rows = jax.jit(lambda ball: jax.lax.scan(advance, ball, None, 600))(ball)
    return tuple(np.asarray(part, float) for part in rows)


def detect(camera, place, velocity, rng, sigma=0.2, probability=0.99) -> Detection:
    speed = camera.jacobian(place) @ velocity + rng.normal(0, 100.0, 2)
    return Detection(camera.project(place) + rng.normal(0, sigma, 2), sigma**2 * np.eye(2), speed, 100.0, probability)


def see(place, velocity, rng, **how) -> list[list[Detection]]:
    """What both cameras see of one ball."""
    return [[detect(camera, place, velocity, rng, **how)] for camera in CAMERAS]


def clutter(camera, rng) -> Detection:
    return Detection(rng.uniform(0, camera.size), 0.05 * np.eye(2), rng.normal(0, 300, 2), 200.0, 0.9)


def test_places_are_off_by_what_their_covariance_says():
    rng, squared = np.random.default_rng(0), []
    for place in rng.uniform([-0.7, -1.3, 0.0], [0.7, 1.3, 0.5], (150, 3)):
        sight = triangulate(CAMERAS, [row[0] for row in see(place, np.zeros(3), rng)], floor=0.0)
        away = sight.point - place
        squared.append((away @ np.linalg.solve(sight.covariance, away), sight.deviation))
    inside, miss = np.mean(squared, axis=0)
    assert 2.4 < inside < 3.6 and 0.65 < miss < 1.4  # three and one degrees of freedom, 150 times


def test_placement_is_judged_by_predicted_deviations():
    near, far = predict_deviation(CAMERAS, np.array([[0.0, -0.9, 0.2], [0.0, 1.2, 0.2]]), 0.5)
    assert 0.0 < near < far < 0.005
    assert np.isinf(predict_deviation(CAMERAS, np.array([[0.0, -6.0, 0.2]]), 0.5)).all()


@pytest.fixture(scope="module")
def tracked() -> np.ndarray:
    """Of each frame with a ball: time [ms], place error [m], velocity error [m/s], number; one camera goes blind."""
    places, velocities = fly()
    rng, tracker, rows = np.random.default_rng(1), BallTracker(CAMERAS), []
    for k in range(0, len(places), 8):
        seen = [[clutter(c, rng) for _ in range(rng.poisson(0.3))] for c in CAMERAS]
        for i, camera in enumerate(CAMERAS):
            blind = i == 0 and 200 <= k < 232
            if camera.sees(places[k]) and rng.random() < 0.97 and not blind:
                seen[i].append(detect(camera, places[k], velocities[k], rng))
        ball = tracker.update(1.0 + k * 1e-3, seen)
        if ball is not None:
            errors = (ball.position - places[k], ball.velocity - velocities[k])
            rows.append((k, *np.linalg.norm(errors, axis=1), ball.number))
    return np.array(rows)


def test_a_ball_is_found_at_once_and_followed_through_its_bounce(tracked):
    places, velocities = fly()
    assert velocities[-1, 2] > velocities[100, 2] and places[:, 2].min() < 0.025  # it bounced
    times, place, velocity, number = tracked.T
    assert times[0] <= 32 and (np.diff(times) == 8).all() and times[-1] == 592 and (number == 1).all()
    assert np.percentile(place, 90) < 0.002
    assert np.percentile(velocity[times > times[0] + 30], 75) < 0.1


def test_a_stroke_is_another_ball_from_its_first_place_on():
    places, velocities = fly()
    rng, tracker, numbers = np.random.default_rng(2), BallTracker(CAMERAS), []
    struck = np.concatenate([places[160], [0.3, 6.0, 1.5], np.zeros(3)])[:, None]
    for k in range(0, 320, 8):
        place, velocity = places[k], velocities[k]
        if k > 160:
            state = move(struck, (k - 160) * 1e-3, Physics(drag=0.141))[:, 0]
            place, velocity = state[:3], state[3:6]
        ball = tracker.update(k * 1e-3, see(place, velocity, rng))
        if ball is not None:
            numbers.append((k, ball.number, np.linalg.norm(ball.position - place)))
    time, number, error = np.array(numbers).T
    assert (number == np.where(time > 160, 2, 1)).all() and error[time > 160].max() < 0.005


def test_clutter_alone_and_hands_are_no_balls():
    rng, tracker = np.random.default_rng(3), BallTracker(CAMERAS)
    for k in range(250):
        hand = np.array([0.3 * np.sin(0.05 * k), 1.5, 0.3 + 0.1 * np.cos(0.04 * k)])
        seen = [[clutter(c, rng) for _ in range(rng.poisson(0.5))] for c in CAMERAS]
        for i, camera in enumerate(CAMERAS):
            seen[i].append(detect(camera, hand, np.zeros(3), rng, 1.0, 0.9))
        assert tracker.update(k * PERIOD, seen) is None


def test_guesses_lie_where_the_ball_will_be():
    places, velocities = fly()
    rng, tracker = np.random.default_rng(4), BallTracker(CAMERAS)
    for k in range(0, 80, 8):
        tracker.update(k * 1e-3, see(places[k], velocities[k], rng))
    for camera, guesses in zip(CAMERAS, tracker.guesses(0.080), strict=True):
        assert guesses[0] == pytest.approx(camera.project(places[80]), abs=2.0)


@pytest.mark.parametrize("blind", [0, 1])
def test_what_one_camera_sees_alone_is_sought_along_its_ray_by_the_other(blind):
    rng = np.random.default_rng(5)
    places = rng.uniform([-0.95, -1.7, 0.05], [0.95, 2.2, 1.1], (100, 3))
    places = [place for place in places if all(camera.sees(place, 5.0) for camera in CAMERAS)]
    assert len(places) > 60
    for place in places:
        seen, tracker = see(place, np.zeros(3), rng), BallTracker(CAMERAS)
        seen[blind] = []
        assert tracker.update(0.0, seen) is None
        guesses = tracker.guesses(PERIOD)
        assert not guesses[1 - blind]
        # Half of a window reaches 32 px to each side.
        ball = CAMERAS[blind].project(place)
        assert min(np.abs(guess - ball).max() for guess in guesses[blind]) < 32.0


def test_a_ball_that_is_unsure_everywhere_but_where_it_was_expected_is_believed():
    places, velocities = fly()
    rng, tracker, found = np.random.default_rng(6), BallTracker(CAMERAS), []
    for k in range(0, 80, 8):
        seen = see(places[k], velocities[k], rng, probability=0.9)
        if k % 32 == 16:
            seen[0] = []  # hidden from one camera
        found.append(tracker.update(k * 1e-3, seen) is not None)
    assert all(found[6:])
