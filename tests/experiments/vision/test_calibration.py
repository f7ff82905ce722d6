"""Calibration of rendered cameras that stand elsewhere than their YAML says, against where they truly stand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ballmodel.kalman import Physics, move
from experiments.vision import render
from experiments.vision.calibration import edges, solve
from robot_io.vision import rig
from robot_io.vision.camera import Camera
from robot_io.vision.triangulation import intersect

pytestmark = pytest.mark.slow
SKEW = 0.0012  # [s]
GRID = np.stack(np.meshgrid([-0.7, 0.0, 0.7], [-1.3, 0.0, 1.3], [0.05, 0.4]), -1).reshape(-1, 3)


def disturb(camera: Camera, rng: np.random.Generator, focal: float = 0.02, bend: float = 0.03) -> Camera:
    change = np.concatenate([rng.normal(0, 0.015, 3), rng.normal(0, 0.04, 3), rng.normal(0, [focal, bend])])
    return solve.adjust(camera, change)


def photograph(camera: Camera, rng: np.random.Generator) -> np.ndarray:
    scene, actors = render.make_scene(camera, rng), render.Actors(rng)
    frames = [render.render(scene, render.no_ball, 0.1 * k, rng, actors.person(0.1 * k, None)).frame for k in range(7)]
    return edges.still_picture(np.stack(frames))


def throw(cameras: tuple[Camera, ...], rng: np.random.Generator, count: int) -> list[solve.Flight]:
    """Flights as cameras see them, the second ``SKEW`` later than its stamps say."""
    flights, times = [], np.arange(30) * 0.008
    while len(flights) < count:
        start = np.concatenate(
            [
                rng.uniform([-0.5, 0.6, 0.2], [0.5, 1.2, 0.4]),
                rng.uniform([-1, -5, 0.5], [1, -3, 2]),
                rng.normal(0, 50, 3),
            ]
        )
        pixels = []
        for camera, late in zip(cameras, (0.0, SKEW), strict=True):
            places = move(np.tile(start[:, None], 30), times + late, Physics(drag=0.13, lift=0.003))[:3].T
            pixels.append(camera.project(places) + rng.normal(0, 0.25, (30, 2)))
        if np.isfinite(pixels).all() and places[:, 2].min() > 0.05:
            flights.append(solve.Flight(times, np.stack(pixels)))
    return flights


def miss(truth: tuple[Camera, ...], found: tuple[Camera, ...]) -> np.ndarray:
    """Errors (n,) [m] over the table of places triangulated by the found cameras."""
    rays = np.stack([f.rays(t.project(GRID)) for t, f in zip(truth, found, strict=True)], 1)
    return np.linalg.norm(intersect(np.stack([f.centre for f in found]), rays) - GRID, axis=1)


@pytest.fixture(scope="module")
def calibrated():
    """True cameras, the rig by lines alone, the lines, and the calibration by lines and flights."""
    rng = np.random.default_rng(2)
    guesses = rig.standard()
    truth = tuple(disturb(camera, rng) for camera in guesses.cameras)
    fits = [solve.fit_edges(photograph(t, rng), guess) for t, guess in zip(truth, guesses.cameras, strict=True)]
    rough = replace(guesses, cameras=tuple(camera for camera, _ in fits))
    lines = [found for _, found in fits]
    return truth, rough, lines, solve.fit_rig(rough, lines, throw(truth, rng, 6))


def test_the_table_s_lines_alone_place_cameras_to_millimetres(calibrated):
    truth, rough, lines, _ = calibrated
    assert np.median(miss(truth, rig.standard().cameras)) > 0.02  # as they were
    assert np.percentile(miss(truth, rough.cameras), [50, 90]) == pytest.approx(0.0, abs=0.005)
    assert all((np.bincount(found.sides, minlength=4) > 20).all() for found in lines)


def test_flights_tell_skew_and_lens(calibrated):
    truth, _, _, found = calibrated
    assert found.rig.delays[1] == pytest.approx(SKEW, abs=1.5e-4) and found.drag == pytest.approx(0.13, abs=0.01)
    assert np.percentile(miss(truth, found.rig.cameras), [50, 90]) == pytest.approx(0.0, abs=0.003)
    assert not found.undetermined and max(found.rig.residuals) < 0.5


def test_a_bumped_camera_is_found_again_and_the_other_stays(calibrated):
    truth, _, _, found = calibrated
    rng = np.random.default_rng(5)
    moved = truth[0].moved(Rotation.from_rotvec([0.002, -0.001, 0.001]).as_matrix(), np.array([0.003, 0.0, 0.0]))
    camera, seen = solve.fit_edges(photograph(moved, rng), found.rig.cameras[0], lens=False)
    _, other = solve.see_edges(photograph(truth[1], rng), found.rig.cameras[1])
    rough = replace(found.rig, cameras=(camera, found.rig.cameras[1]))
    again = solve.fit_rig(rough, [seen, other], [], rough.cameras[0].name)
    after = (moved, truth[1])
    assert np.median(miss(after, found.rig.cameras)) > 0.003
    assert np.median(miss(after, again.rig.cameras)) < 0.003
    assert again.rig.cameras[1].project(GRID) == pytest.approx(found.rig.cameras[1].project(GRID))
