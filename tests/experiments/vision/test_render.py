"""Frames against closed forms: where the streak is, how long, how much noise; a ball is tracked in them."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.vision import render
from experiments.vision.pipeline import SHIPPED
from experiments.vision.rendered_rig import RenderedCameras
from robot_io.emulator.config import RigParams
from robot_io.emulator.tracker import TrackerEmulator, TrackerParams
from robot_io.vision import rig
from robot_io.vision.camera import look_at
from tests.support.lockstep_play import throws
from tests.support.lockstep_play import world as shared_world

CAMERA = look_at("side", (-2.3, -0.9, 1.8))
START, VELOCITY = np.array([0.1, -0.2, 0.3]), np.array([1.0, 6.0, 0.5])


def fly(times):
    return START + np.asarray(times)[:, None] * VELOCITY


def flat(level: int, gain: float = 0.0, brightness: float = 1.0) -> render.Scene:
    """A hall in one grey, with a grey ball."""
    width, height = CAMERA.size
    image, net = np.full((height, width, 3), level, np.uint8), np.zeros((height, width), np.uint8)
    return render.Scene(CAMERA, image, net, np.full(3, 200.0), 0.002, gain, brightness, blur=0.7)


@pytest.fixture
def scene():
    return flat(1)


def see(scene, window=None):
    """The mean of noisy frames."""
    rng = np.random.default_rng(0)
    return np.mean([render.render(scene, fly, 0.0, rng, window=window).frame for _ in range(40)], 0)


def test_the_streak_is_centred_at_mid_exposure_and_as_long_as_the_flight(scene):
    pixels = CAMERA.project(fly(np.array([-0.002, 0.0, 0.002])))
    scene.exposure = 0.004
    ys, xs = np.nonzero(see(scene) - 1.0 > 5)
    assert np.hypot(xs.mean() - pixels[1][0], ys.mean() - pixels[1][1]) < 0.35
    length = np.linalg.norm(pixels[2] - pixels[0])
    along = np.stack([xs, ys], 1) @ (pixels[2] - pixels[0]) / length
    radius = CAMERA.matrix[0, 0] * 0.02 / CAMERA.depth(START)
    assert np.ptp(along) == pytest.approx(length + 2 * radius, abs=2.0)


@pytest.mark.parametrize(("level", "gain", "brightness"), [(40, 0.3, 1.0), (120, 0.3, 1.0), (120, 0.1, 0.5)])
def test_noise_grows_with_the_light_as_counted_photons_do(level, gain, brightness):
    scene, rng = flat(level, gain, brightness), np.random.default_rng(1)
    frame = render.render(scene, render.no_ball, 0.0, rng).frame.astype(float)
    assert frame.mean() == pytest.approx(level * brightness, abs=0.1)
    # A rounded level adds a twelfth.
    assert frame.var() == pytest.approx(gain * brightness * level + render.READ_NOISE + 1 / 12, rel=0.03)


def test_a_window_shows_what_the_whole_frame_shows_there(scene):
    x, y = (np.round(CAMERA.project(START) / 2) * 2 - 40).astype(int)
    whole = see(scene)[y : y + 80, x : x + 80]
    part = see(scene, window=(int(x), int(y), 80, 80))
    assert np.abs(whole - part).max() < 2.0 and part.max() > 100


def test_a_ball_behind_something_or_outside_is_not_seen(scene):
    rng, towards = np.random.default_rng(0), CAMERA.centre - START
    beside = START + 0.3 * towards / np.linalg.norm(towards)
    for radius, seen in ((0.2, 0.0), (0.0005, 1.0)):
        wall = render.Capsule(beside, beside + [0.0, 0.0, 0.01], radius, np.zeros(3))
        assert render.render(scene, fly, 0.0, rng, [wall]).seen == pytest.approx(seen, abs=0.25)
    behind = render.Capsule(START - towards, START - towards, 0.2, np.zeros(3))
    assert render.render(scene, fly, 0.0, rng, [behind]).seen == 1.0
    for nowhere in (lambda times: fly(times) + [0.0, 40.0, 0.0], render.no_ball):
        assert render.render(scene, nowhere, 0.0, rng).seen == 0.0


def test_the_mosaic_keeps_the_colour_of_each_pixel():
    image = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    pattern = [[0, 1], [1, 2]]  # red green, green blue
    expected = [[image[y, x, pattern[y % 2][x % 2]] for x in range(6)] for y in range(4)]
    np.testing.assert_array_equal(render.mosaic(image), expected)


def test_rendered_cameras_are_for_lock_step():
    with pytest.raises(ValueError, match="'rendered'; it is for lock-step"):
        TrackerEmulator(TrackerParams(cameras="rendered"), 0)


@pytest.mark.slow
def test_a_thrown_ball_is_tracked_in_its_pictures():
    params = RigParams(tracker=TrackerParams(cameras="rendered"))
    world = shared_world()
    world.reset()
    tracker = RenderedCameras(rig.standard(), SHIPPED).open(params.tracker, world, 1)
    balls, errors = throws(), []
    world.throw(balls.position[:, 0], balls.velocity[:, 0], balls.spin[:, 0])
    for _ in range(40):
        world.advance(np.zeros(8), 0.008)
        if not world.in_play:
            break
        tracker.step(world.time, 1, world.ball)
        ball = tracker.tracker.reported
        errors.append(np.inf if ball is None else float(np.linalg.norm(ball.ball.mean[:3] - world.ball)))
    assert np.median(errors) < 0.005
    assert len(tracker.due(world.time + 1.0)) == len(errors)
