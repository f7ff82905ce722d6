"""Crops: what the labels say is where the picture has it, mirrored ones too."""

import numpy as np
import pytest

from experiments.vision import crops, flights, training
from robot_io.vision.detector import AROUND, SIZE


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
