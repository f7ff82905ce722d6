"""Initial-state fits against known truth, an independent optimiser and measured launcher balls."""

from __future__ import annotations

import numpy as np
import pytest

from ballmodel.aerodynamics import FlightParams
from ballmodel.initial_state import fit_gauss_newton, fit_nelder_mead
from ballmodel.io import read
from ballmodel.trajectory import Trajectory, free_flight
from tests.support.paths import MEASURED

K_D = 0.47 * 1.29 * 1.256e-3 / (2 * 0.0027)


def flight(start, time, magnus=0.0, spin=(0.0, 0.0, 0.0)):
    """The paper's step in NumPy, cut as the fits document it: equal steps of at most 1/300 s between samples."""
    k_m = magnus * 1.29 * 1.256e-3 * 0.02 / (2 * 0.0027)
    x, v = np.array(start[:3], float), np.array(start[3:], float)
    positions = [x]
    for gap in np.diff(time):
        n = int(np.ceil(gap * 300 - 1e-6))
        for _ in range(n):
            a = np.array([0, 0, -9.81]) - K_D * np.linalg.norm(v) * v + k_m * np.cross(spin, v)
            x, v = x + gap / n * (v + gap / n * a / 2), v + gap / n * a
        positions.append(x)
    return np.array(positions).T


def balls(n, samples, noise, seed=0, **kinds):
    rng = np.random.default_rng(seed)
    truth = rng.uniform([-0.7, 0.8, 0.1, -1.5, -8, -1], [0.7, 1.9, 0.8, 1.5, -3, 3], (n, 6))
    trajectories = []
    for i, start in enumerate(truth):
        count = samples if np.isscalar(samples) else samples[i]
        time = 100.0 + np.arange(count) / 125 + rng.uniform(0, 0.003, count)
        clean = flight(start, time, **kinds)
        trajectories.append(Trajectory("s", str(i), time, clean + rng.normal(0, noise, clean.shape)))
    return trajectories, truth.T


def unknowns(state):
    return np.concatenate([state.position, state.velocity])


def test_recovers_a_noiseless_flight_exactly():
    trajectories, truth = balls(20, [4 + 3 * i for i in range(20)], 0.0)
    result = fit_gauss_newton(trajectories, FlightParams())
    np.testing.assert_allclose(unknowns(result.state), truth, atol=1e-7)
    assert result.converged.all() and result.rms.max() < 1e-9
    assert result.state.position.dtype == np.float64


def test_gauss_newton_is_no_worse_than_nelder_mead():
    trajectories, truth = balls(25, 60, 0.002)
    result = fit_gauss_newton(trajectories, FlightParams())
    state, rms = fit_nelder_mead(trajectories, FlightParams())
    assert np.all(result.rms <= rms + 1e-12)
    for i, trajectory in enumerate(trajectories[:3]):
        away = flight(unknowns(result.state)[:, i], trajectory.time) - trajectory.position
        assert result.rms[i] == pytest.approx(np.sqrt(np.mean(np.sum(away**2, axis=0))), rel=1e-9)
    np.testing.assert_allclose(unknowns(result.state), unknowns(state), atol=1e-4)
    np.testing.assert_allclose(unknowns(state), truth, atol=0.02)


def test_covariance_predicts_the_error():
    trajectories, truth = balls(400, 40, 0.002, seed=1)
    result = fit_gauss_newton(trajectories, FlightParams())
    error = unknowns(result.state) - truth
    squared = np.einsum("in,nij,jn->n", error, np.linalg.inv(np.moveaxis(result.covariance, -1, 0)), error)
    # Six degrees of freedom: mean 6, and a standard error of sqrt(12 / 400) = 0.17 of that mean.
    assert np.mean(squared) == pytest.approx(6.0, abs=4 * 0.18)


def test_known_spin_is_used():
    spin = np.array([70.0, -20.0, 30.0])
    trajectories, truth = balls(5, 40, 0.0, magnus=0.6, spin=spin)
    params = FlightParams(magnus_coefficient=0.6)
    spins = np.tile(spin[:, None], (1, 5))
    with_spin, without = fit_gauss_newton(trajectories, params, spins), fit_gauss_newton(trajectories, params)
    np.testing.assert_allclose(unknowns(with_spin.state), truth, atol=1e-7)
    assert without.rms.min() > 1e-3
    state, _ = fit_nelder_mead(trajectories[:1], params, spins[:, :1])
    np.testing.assert_allclose(unknowns(state), truth[:, :1], atol=1e-4)


def test_huber_loss_shrugs_off_stray_samples():
    trajectories, truth = balls(10, 40, 0.001, seed=5)
    for t in trajectories:
        t.position[:, 7] += 0.4
        t.position[:, 30] -= 0.3
    plain = fit_gauss_newton(trajectories, FlightParams())
    robust = fit_gauss_newton(trajectories, FlightParams(), huber=0.005)
    errors = [np.abs(unknowns(r.state) - truth).max(axis=0) for r in (plain, robust)]
    assert np.all(errors[1] < 0.1 * errors[0])
    assert robust.converged.all()


@pytest.mark.skipif(not MEASURED.is_dir(), reason=f"no measured data in {MEASURED}")
def test_launcher_balls_and_what_their_residuals_say():
    """A drag-only flight misses a topspin ball by more than a spinless one, and Magnus lift explains the difference."""
    rms = {}
    for session in ("no_spin_robot_simple", "mn5008_topspin"):
        flights = [free_flight(t) for t in read(MEASURED / "aimy_launcher" / f"{session}.hdf5")]
        result = fit_gauss_newton(flights, FlightParams())
        assert result.converged.all()
        rms[session] = np.median(result.rms)
        assert np.all((result.state.velocity[1] > -7.5) & (result.state.velocity[1] < -3.5))
        if session == "mn5008_topspin":
            spin = np.zeros((3, len(flights)))
            spin[0] = 100.0  # [rad/s] topspin of a ball towards -y; the wheels give no number
            with_lift = fit_gauss_newton(flights, FlightParams(magnus_coefficient=0.6), spin)
            assert np.median(with_lift.rms) < 0.5 * rms[session]
    assert rms["no_spin_robot_simple"] < rms["mn5008_topspin"] < 0.03
