"""The shipped detector on pictures that another program drew, and its golden crops."""

import numpy as np
import pytest

from experiments.vision import export
from experiments.vision.pipeline import SHIPPED
from robot_io.vision.detector import Detector
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
