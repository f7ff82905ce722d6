"""Rubber, delay and zeros from returns of other code: MuJoCo C's kinematics, SciPy's flight, the rubber by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjx_tt.diagnosis.hits.paddle_path import JointPath, joint_path
from mjx_tt.diagnosis.together import balls, hits
from tests.mjx_tt.diagnosis.test_hits import HITS, MODEL, Rubber, play

pytestmark = pytest.mark.optimised

FLIGHTS = {"ball.flight.drag_coefficient": (0.47, 0.03)}
PRIOR = {
    "ball.paddle.restitution": (0.9, 0.05),
    "ball.paddle.tangential_gain": (0.66, 0.1),
    "latency.ball_observation": (0.040, 0.01),
    "drives.joint_5.joint_offset": (0.0, 0.01),
}
TRUTH = Rubber(restitution=0.84, gain=0.55, late=0.008)
WANTED = {
    "ball.paddle.restitution": 0.84,
    "ball.paddle.tangential_gain": 0.55,
    "latency.ball_observation": 0.048,
    "drives.joint_5.joint_offset": 0.006,
}


def fitted(rubber: Rubber, seed: int):
    measured, records = play(rubber, seed)
    path = joint_path(records, MODEL)
    moved = [q + 0.006 if i == 6 else q for i, q in enumerate(path.position)]  # joint_5 reads 6 mrad too much
    return measured, JointPath(path.time, tuple(moved))


@pytest.mark.slow
def test_all_of_it_is_found_together_within_its_errors():
    measured, path = fitted(TRUTH, 7)
    found = hits.fit(balls.fit(measured, MODEL, FLIGHTS), measured, path, PRIOR)
    errors = np.sqrt(np.diagonal(found.covariance))
    for name, value in WANTED.items():
        i = found.paths.index(name)
        assert abs(found.mean[i] - value) < 3.0 * errors[i], (name, found.mean[i], errors[i])
        assert errors[i] < 0.5 * PRIOR[name][1]
    drawn, lift = found.samples({name: (m - 9 * d, m + 9 * d) for name, (m, d) in PRIOR.items()})
    assert drawn.paths == tuple(WANTED) and lift.shape == (hits.DRAWS,)
    np.testing.assert_allclose(np.cov(drawn.values.T), found.covariance[:-1, :-1], rtol=0.6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("jitter", [0.009, 0.015])
def test_delays_that_differ_from_hit_to_hit_lead_nothing_astray(jitter):
    """A robot that plays strokes as late as it sees the ball: how late and how fast go together."""
    measured, path = fitted(replace(TRUTH, jitter=jitter), 11)
    axes = {hits.AXES: (0.033, 0.014)}
    found = hits.fit(balls.fit(measured, MODEL, FLIGHTS), measured, path, {**PRIOR, **axes})
    error = dict(zip(found.paths, np.sqrt(np.diagonal(found.covariance)), strict=True))
    for name, value in {**WANTED, hits.AXES: 0.033}.items():
        at = found.mean[found.paths.index(name)]
        assert abs(at - value) < 2.5 * error[name], (name, at, error[name])
    # Two delays differ; HITS of them tell their mean by so much, which is stated WIDER.
    mean_of_hits = jitter * (2.0 / HITS) ** 0.5
    assert error["ball.paddle.restitution"] < 0.01
    assert all(error[name] < 1.2 * hits.WIDER * mean_of_hits for name in hits.DELAYS)


@pytest.mark.slow
def test_axes_that_are_measured_later_than_the_arm_are_not_taken_for_zeros():
    late, zeros = 0.015, {f"drives.gantry_{axis}.joint_offset": (0.0, 0.004) for axis in "xy"}
    measured, records = play(Rubber(), 7)
    path = joint_path(records, MODEL)
    path = JointPath(tuple(t + late if i < 2 else t for i, t in enumerate(path.time)), path.position)
    prior = {**PRIOR, **zeros, hits.AXES: (0.033, 0.014)}
    found = hits.fit(balls.fit(measured, MODEL, FLIGHTS), measured, path, prior)
    at, errors = dict(zip(found.paths, found.mean, strict=True)), np.sqrt(np.diagonal(found.covariance))
    error = dict(zip(found.paths, errors, strict=True))
    assert error[hits.AXES] < 0.006 and abs(at[hits.AXES] - 0.033 - late) < 2.5 * error[hits.AXES]
    assert all(abs(at[name]) < 2.5 * error[name] for name in zeros)
    assert abs(at["latency.ball_observation"] - 0.040) < 2.5 * error["latency.ball_observation"]


def test_a_hit_that_is_met_or_missed_within_a_difference_decides_nothing():
    columns = np.random.default_rng(0).normal(size=(3, 6, 40))
    columns[1, 4, 17] = 60.0
    columns[2, :3, 5] = 60.0  # place alone: a return through a point near by
    assert np.flatnonzero(~hits.smooth(columns)).tolist() == [17]
    columns[2] = 0.0  # shows nowhere
    assert np.flatnonzero(~hits.smooth(columns)).tolist() == [17]
