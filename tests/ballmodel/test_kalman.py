"""Flight in NumPy against the simulation, and the filter on it."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ballmodel import flight
from ballmodel.kalman import Kalman, Physics, move
from ballmodel.state import BallState

STATES = np.array(
    [
        [0.2, 1.3, 0.3, -0.5, -5.0, 1.5, 60.0, -20.0, 30.0],
        [-0.3, 1.2, 0.4, 0.4, -4.0, -2.0, -80.0, 10.0, 0.0],  # bounces
        [0.0, -1.3, 0.25, 0.2, 4.5, 2.0, 0.0, 0.0, 0.0],
    ]
).T


def simulate(physics: Physics, seconds: float) -> np.ndarray:
    params = flight.ball_params()
    air = params.flight
    drag = physics.drag * 2.0 * air.mass / (air.air_density * air.area)
    lift = physics.lift * 2.0 * air.mass / (air.air_density * air.area * air.radius)
    air = replace(air, drag_coefficient=drag, magnus_coefficient=lift, integrator="midpoint")
    table = replace(params.table, restitution=physics.restitution, friction=physics.friction)
    params = replace(params, flight=air, table=table)
    ball = BallState(*(np.float32(part) for part in (STATES[:3], STATES[3:6], STATES[6:])))

    def advance(ball, _):
        return flight.step(params, ball, 1e-3, with_net=False)[0], None

    ball, _ = jax.jit(lambda ball: jax.lax.scan(advance, ball, None, round(seconds * 1000)))(ball)
    return np.concatenate([ball.position, ball.velocity, ball.spin])


def test_flight_and_bounce_are_the_simulation_s():
    physics = Physics(drag=0.14, lift=0.003)
    found, truth = move(STATES, 0.2, physics), simulate(physics, 0.2)
    assert truth[5, 1] > 0.0 > STATES[5, 1]  # it bounced
    assert found[:3] == pytest.approx(truth[:3], abs=5e-4)
    assert found[3:6] == pytest.approx(truth[3:6], abs=5e-3)
    assert found[6:] == pytest.approx(truth[6:], abs=0.5)


def test_errors_are_what_the_covariance_says():
    physics, rng, squared = Physics(wander=0.0), np.random.default_rng(0), []
    for _ in range(60):
        truth = STATES[:, :1] + rng.normal(0, [[0.1]] * 3 + [[0.5]] * 3 + [[40.0]] * 3)
        start = truth[:, 0] + rng.normal(0, [0.01] * 3 + [1.0] * 3 + [50.0] * 3)
        ball = Kalman(start, np.diag([0.01**2] * 3 + [1.0] * 3 + [50.0**2] * 3), physics)
        for _ in range(15):
            truth = move(truth, 0.008, physics)
            ball.predict(0.008)
            ball.correct(truth[:3, 0] + rng.normal(0, 0.002, 3) - ball.mean[:3], np.eye(3, 9), np.eye(3) * 4e-6)
        away = truth[:, 0] - ball.mean
        squared.append(away @ np.linalg.solve(ball.covariance, away))
    assert 7.5 < np.mean(squared) < 10.5  # of nine degrees of freedom, 60 times: 9 +- 0.55
