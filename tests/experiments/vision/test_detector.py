"""The shipped detector on pictures that another program drew; crops: labels are where the picture has the ball."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.vision import crops, export, flights, training
from experiments.vision.pipeline import SHIPPED
from robot_io.vision.detector import AROUND, SIZE, Detector
from tests.support.discs import draw_discs

RATE = 125.0
SPEED = np.array([14.0, -6.0])  # px a frame
START = np.array([300.0, 400.0])


def test_onnx_says_what_jax_said_of_the_golden_crops():
    assert export.check_golden(SHIPPED) < export.AGREEMENT


@pytest.mark.parametrize("colour", [(220.0, 110.0, 25.0), (225.0, 225.0, 220.0)])
def test_a_disc_that_moves_is_found_with_place_and_velocity(colour):
    middles = [START + k * SPEED for k in range(8)]
    detector = Detector(SHIPPED, RATE)
    for k, frame in enumerate(draw_discs(middles, colour=colour)):
        found = detector.detect(frame)
        if k < 2:
            assert found == []
            continue
        assert len(found) == 1
        assert np.linalg.norm(found[0].centre - middles[k]) < 0.8
        assert np.linalg.norm(found[0].velocity - SPEED * RATE) < 2.5 * RATE
        assert found[0].velocity_deviation < 4 * RATE
        assert np.linalg.eigvalsh(found[0].covariance).min() > 1e-4


def test_still_discs_and_empty_pictures_are_no_balls_and_guesses_look_anywhere():
    detector = Detector(SHIPPED, RATE)
    for frame in draw_discs([START] * 6):
        assert detector.detect(frame) == []
    for frame in draw_discs([(-50.0, -50.0)] * 4):
        assert detector.detect(frame, [np.array([1.0, 1.0]), np.array([900.0, 20.0])]) == []


@pytest.mark.parametrize(("bayer", "left", "top"), [("GRBG", 1, 0), ("GBRG", 0, 1), ("BGGR", 1, 1)])
def test_other_orders_of_colours_give_the_same_balls(bayer, left, top):
    one, other = Detector(SHIPPED, RATE), Detector(SHIPPED, RATE, bayer=bayer)
    for frame in draw_discs([START + k * SPEED for k in range(4)]):
        expected = one.detect(frame)
        found = other.detect(np.pad(frame, ((top, 3), (left, 3))), [START])
    assert len(found) == len(expected) == 1
    np.testing.assert_allclose(found[0].centre, expected[0].centre + [left, top], atol=0.2)


@pytest.fixture(scope="module")
def tracks():
    return flights.fly_balls(12, 3)


@pytest.mark.slow
def test_flights_obey_gravity_where_nothing_is_touched(tracks):
    first = tracks[:, :60]  # metres, at 1 kHz
    height = first[..., 2]
    falls = np.polynomial.polynomial.polyfit(np.arange(60) / 1000.0, height.T, 2)[2] * 2
    assert tracks.shape == (12, 1000, 3)
    assert np.median(falls) == pytest.approx(-9.81, abs=3.0)  # drag and spin add some
    rest = flights.split_flights(tracks, False)
    assert len(rest) + len(flights.split_flights(tracks, True)) == 12 and len(rest) == 10


def test_a_crop_holds_what_the_frames_hold_around_its_corner():
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (200, 240), np.uint8) for _ in range(3)]
    fine, coarse = crops.cut(frames, np.array([80, 60]))
    for t in range(3):
        np.testing.assert_array_equal(fine[..., t], frames[t][60:124, 80:144])
        wide = frames[t][60 - AROUND : 124 + AROUND, 80 - AROUND : 144 + AROUND].reshape(SIZE, 2, SIZE, 2).mean((1, 3))
        assert np.abs(coarse[..., t] - wide).max() <= 1
    _, corner = crops.cut(frames, np.array([0, 136]))  # the border repeats outside
    assert (corner[:, : AROUND // 2 - 1, 0] == corner[:, :1, 0]).all() and corner[:, AROUND:, 0].std() > 5


def test_a_mirrored_crop_keeps_its_colours_and_its_label():
    count, fine = 64, np.zeros((64, SIZE, SIZE, 3), np.uint8)
    fine[:, ::2, ::2] = 200  # red everywhere
    fine[:, 20:24, 10:14] = 255
    labels = np.tile(np.array([[1, 11.5, 21.5, 6.0, 2.0, 5.0]], np.float32), (count, 1))
    out = training.augment(crops.Crops(fine, fine.copy(), labels), np.random.default_rng(0))
    mirrored = out.labels[:, 3] < 0
    assert 10 < mirrored.sum() < 54
    far = out.fine[:, 40:, :, 0].astype(int)
    assert (far[:, ::2, ::2].mean((1, 2)) > far[:, 1::2, 1::2].mean((1, 2)) + 20).all()
    for i in range(count):
        green = out.fine[i, ::2, 1::2, 0]  # bright in the square only
        _, columns = np.nonzero(green > 0.6 * green.max())
        assert columns.mean() * 2 + 1 == pytest.approx(out.labels[i, 1], abs=1.1)
    np.testing.assert_array_equal(out.labels[:, 2], labels[:, 2])
