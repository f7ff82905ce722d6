"""Predictions against flights of an independent physics: errors, calibrated covariances, spins, and the benchmark."""

from __future__ import annotations

import csv
from functools import cache

import numpy as np
import pytest

from ballmodel.trajectory import Trajectory
from experiments import cli
from mjx_tt.diagnosis.ball.flights.spin_prior import SpinPrior
from mjx_tt.prediction import Belief, fit_states, fly_on, learn, predict
from mjx_tt.prediction.benchmark import benchmark
from mjx_tt.prediction.flight_fit import squared_miss
from mjx_tt.sim.model import SimModel, with_values
from tests.exam.generator.sessions import INTERVAL, SIGMA, draw_starts
from tests.exam.generator.world import World, fly

LIFT = {"ball.flight.magnus_coefficient": 0.6, "ball.flight.drag_coefficient": 0.40}
SPREAD = np.array([40.0, 20.0, 20.0])
MEAN = np.array([60.0, 0.0, 0.0])


@cache
def spinning(n: int = 40) -> tuple[tuple[Trajectory, ...], np.ndarray, np.ndarray]:
    """Tracks of balls with topspin and 3 mm of noise, their true places (3, T, n) and spins (3, n)."""
    rng = np.random.default_rng(5)
    start = draw_starts(rng, n, True)
    # Topspin of a ball that flies towards -y is a turn about +x.
    start[6:] = MEAN[:, None] + SPREAD[:, None] * rng.standard_normal((3, n))
    time = np.repeat(np.arange(75)[:, None] * INTERVAL, n, axis=1)
    truth = fly(World(magnus_coefficient=0.6, drag_coefficient=0.40), start, 0.65).at(time)
    measured = truth + SIGMA * rng.standard_normal(truth.shape)
    tracks = []
    for i in range(n):
        kept = np.isfinite(measured[0, :, i])
        tracks.append(Trajectory("day", str(i), time[kept, i], measured[:, kept, i]))
    return tuple(tracks), truth, start[6:]


def told(scatter: float = 1e-3) -> Belief:
    """What is true of the tracks' balls."""
    return Belief(with_values(SimModel(), LIFT), SpinPrior(MEAN, SPREAD), np.full(3, scatter))


def ahead(tracks, belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """Places (3, 1, n) and covariances at the sample 0.45 s after the first, from the first 0.15 s."""
    fitted = fit_states([t.part(0, 19) for t in tracks], belief)
    flown, covariance = fly_on(fitted, np.full((1, len(tracks)), 56 * INTERVAL))
    return flown.position[:, 1:, 0], covariance


def test_predictions_miss_by_what_their_covariances_say():
    """From 0.15 s on, 0.3 s ahead: squared errors in units of the covariance follow chi square of three."""
    tracks, truth, _ = spinning()
    places, covariance = ahead(tracks, told())
    off = truth[:, 56:57] - places
    place = covariance - SIGMA**2 * np.eye(3)  # the truth is no sample
    squares = squared_miss(off, place)
    assert 0.8 < np.nanmedian(squares) / 2.37 < 1.5  # median of chi square with three degrees
    assert np.nanmedian(np.linalg.norm(off, axis=0)) < 0.05


def test_regions_hold_what_they_promise_though_the_model_is_wrong():
    """Learnt on twenty balls under a drag that is far off, of twenty others nine in ten samples lie inside."""
    tracks, _, _ = spinning()
    wrong = with_values(SimModel(), LIFT | {"ball.flight.drag_coefficient": 0.7})
    belief = learn(tracks[::2], wrong, 0.15, (0.3,))
    held = [t for t in tracks[1::2] if len(t) > 56]
    places, covariance = ahead(held, belief)
    off = np.stack([t.position[:, 56] for t in held], axis=1)[:, None] - places
    inside = squared_miss(off, covariance) < 6.25  # 90 % of chi square with three degrees
    assert 0.75 < inside.mean() <= 1.0
    plain = squared_miss(off, covariance / np.interp(0.3, *belief.wider)) < 6.25
    assert plain.mean() < 0.6


def test_predict_is_the_same_for_one_track_and_says_when_it_cannot():
    tracks, truth, _ = spinning()
    place, covariance = predict(tracks[0].part(0, 40), told(), (12 * INTERVAL, 0.2))
    assert place.shape == (3, 2) and covariance.shape == (3, 3, 2)
    step = round(tracks[0].time[39] / INTERVAL) + 12
    assert np.linalg.norm(place[:, 0] - truth[:, step, 0]) < 0.03
    assert np.all(np.linalg.eigvalsh(np.moveaxis(covariance, 2, 0)) > 0.0)
    with pytest.raises(ValueError, match="at least 4 samples"):
        predict(tracks[0].part(0, 3))
    with pytest.raises(ValueError, match="increasing seconds above 0"):
        predict(tracks[0], horizon=(0.2, 0.1))


@pytest.mark.slow
def test_spins_are_learnt_from_the_flights():
    tracks, _, spins = spinning()
    fitted = fit_states(tracks, learn(tracks, with_values(SimModel(), LIFT)))
    found = np.asarray(fitted.start.spin)
    assert np.corrcoef(found[0], spins[0])[0, 1] > 0.8
    assert abs(found[0].mean() - spins[0].mean()) < 12.0
    assert abs(fitted.noise - SIGMA) < 0.4e-3


@pytest.mark.slow
def test_the_benchmark_prefers_what_knows_spin():
    tracks, _, _ = spinning()
    found = benchmark("made", tracks, {"true": with_values(SimModel(), LIFT)}, (0.3,))
    ours, true = (found.score(m, 0.3).rms[0] for m in ("diagnosed", "true"))
    assert ours < 1.15 * true and ours < 0.9 * found.score("nominal model", 0.3).rms[0]
    assert ours < found.score("Kalman filter", 0.3).rms[0] < found.score("parabola", 0.3).rms[0]
    assert "magnus" in found.learnt
    low, high = found.score("true", 0.3).rms[1:]
    assert low < true < high


@pytest.mark.slow
def test_commands_write_tables_and_a_page(tmp_path, capsys):
    path = tmp_path / "log.csv"
    rows = [
        f"{t.session},{t.name},{s},{x},{y},{z}"
        for t in spinning()[0][:24]
        for s, (x, y, z) in zip(t.time, t.position.T, strict=True)
    ]
    path.write_text("\n".join(["session,trajectory,t,x,y,z", *rows]) + "\n")
    assert cli.main(["predict", str(path), "--seen", "0.2", "--horizon", "0.1", "--out", str(tmp_path / "p.csv")]) == 0
    with open(tmp_path / "p.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 24 and all(0.0 < float(row["sd_y"]) < 0.2 for row in table)
    assert cli.main(["bench-ball", str(path), "--out", str(tmp_path / "bench")]) == 0
    page = (tmp_path / "bench" / "benchmark.html").read_text()
    assert "not known here" in page and "in 90 % regions" in page and "data:image/png" in page
    assert cli.main(["bench-ball", str(tmp_path), "--out", str(tmp_path / "bench")]) == 1
